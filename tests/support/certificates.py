"""Certificates of a throwaway authority, made by the program ``openssl``."""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Issued:
    """A certificate and its key."""

    cert: Path
    key: Path


class Authority:
    """Signs certificates; ``ca`` is its own."""

    def __init__(self, folder: Path) -> None:
        if shutil.which("openssl") is None:
            pytest.skip("needs openssl")
        self._folder = folder
        self.ca = folder / "ca.pem"
        _openssl("req", "-x509", *_KEY, "-keyout", folder / "ca.key", "-out", self.ca, *_AUTHORITY)

    def issue(self, name: str, *, subject: str = "localhost") -> Issued:
        """A certificate for this machine, in files of this name."""
        cert, key = self._folder / f"{name}.pem", self._folder / f"{name}.key"
        _openssl(
            *("req", "-x509", *_KEY, "-CA", self.ca, "-CAkey", self._folder / "ca.key"),
            *("-keyout", key, "-out", cert, "-subj", f"/CN={subject}", "-days", "2"),
            *("-addext", f"subjectAltName=DNS:{subject},DNS:localhost,IP:127.0.0.1"),
            *("-addext", "basicConstraints=critical,CA:FALSE"),
        )
        return Issued(cert, key)


_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
_AUTHORITY = ("-subj", "/CN=tests", "-days", "2")


def _openssl(*words: str | Path) -> None:
    done = subprocess.run(["openssl", *map(str, words)], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
