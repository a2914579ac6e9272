"""Freed memory is used again and not faulted in for every frame."""

import ctypes
import subprocess
import sys

import pytest

from vergence_service.process.malloc import keep_freed_memory

FRAMES = 20
SCRIPT = f"""
import resource
import numpy as np
from vergence_service.process.malloc import keep_freed_memory

assert keep_freed_memory()

def faults_of_frames():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range({FRAMES}):
        pieces = [np.ones(3_000_000, np.uint8) for _ in range(4)]
        del pieces
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults_of_frames()
print(faults_of_frames())
"""


def test_frames_are_not_faulted_in_again() -> None:
    run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert int(run.stdout) < FRAMES  # every frame has some 3,000 pages


def test_a_system_without_glibc_keeps_its_own_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str | None) -> object:
        raise TypeError("LoadLibrary() argument 1 must be str, not None")  # as on Windows

    monkeypatch.setattr(ctypes, "CDLL", load)
    assert keep_freed_memory() is False
