"""What a client shows to a server, and what it trusts: a token, certificates, an authority."""

import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

TOKEN_VARIABLE = "VERGENCE_TOKEN"
TOKEN_FILE_VARIABLE = "VERGENCE_TOKEN_FILE"
CA_VARIABLE = "VERGENCE_CA"


@dataclass(frozen=True, slots=True)
class Credentials:
    """The credentials of a client. Its repr has no secret."""

    token: str = field(default="", repr=False)
    ca: Path | None = None  # PEM file; None: the authorities of this system
    cert: Path | None = None
    key: Path | None = None

    @classmethod
    def of(
        cls,
        token: str | None,
        ca: str | Path | None,
        cert: str | Path | None,
        key: str | Path | None,
        *,
        private: bool,
    ) -> Self:
        """Take what was given, and for the rest the variables of the environment.

        ``private``: nobody on the way can read what is sent. A token of the environment is not
        sent otherwise. Raises ValueError: a token was given and would be sent in the clear, or a
        file cannot be read.
        """
        if token and not private:
            raise ValueError(
                "the token would be sent unencrypted; write grpcs:// or https:// as the address"
            )
        if token is None and private:
            token = _of_environment()
        if ca is None:
            ca = os.environ.get(CA_VARIABLE) or None
        if (cert is None) != (key is None):
            raise ValueError("a client's certificate and its key need each other")
        files = [None if each is None else Path(each) for each in (ca, cert, key)]
        for file in files:
            if file is not None and not file.is_file():
                raise ValueError(f"there is no file {file}")
        return cls((token or "").strip(), *files)

    @property
    def headers(self) -> Mapping[str, str]:
        """The headers of a request, in lower case as gRPC needs them."""
        return {"authorization": f"Bearer {self.token}"} if self.token else {}

    def tls(self) -> ssl.SSLContext:
        """Make the context of HTTP connections. Raises ValueError: a file is no certificate."""
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.cert is not None:
                context.load_cert_chain(self.cert, self.key)
        except ssl.SSLError as error:
            raise ValueError(f"cannot use the certificates {self}: {error.reason}") from None
        return context


def use_files(*, token_file: Path | None, ca: Path | None) -> None:
    """Let every client of this process use these files, where it names none itself."""
    if token_file is not None:
        os.environ[TOKEN_FILE_VARIABLE] = str(token_file)
        os.environ.pop(TOKEN_VARIABLE, None)
    if ca is not None:
        os.environ[CA_VARIABLE] = str(ca)


def _of_environment() -> str:
    if token := os.environ.get(TOKEN_VARIABLE):
        return token
    file = os.environ.get(TOKEN_FILE_VARIABLE)
    if not file:
        return ""
    try:
        return Path(file).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read the token in {file}: {error}") from None
