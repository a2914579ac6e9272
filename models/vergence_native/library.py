"""The compiled library: where it is, which instructions it uses, and its functions."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from ctypes import POINTER, c_char_p, c_float, c_int, c_int8, c_int32, c_size_t, c_void_p
from pathlib import Path

_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY_NAME = f"vergence_native{_SUFFIX}"

_OK, _BAD_ARGUMENT, _BAD_WEIGHTS, _INCOMPLETE, _NO_MEMORY, _NOT_FINITE = range(6)


class NativeUnavailable(RuntimeError):
    """The library was not built, cannot be loaded, or lacks the instructions asked for."""


class NotFinite(ArithmeticError):
    """The result of a step is not finite."""


_FUNCTIONS: dict[str, tuple[object, list[object]]] = {
    "vn_variant": (c_char_p, [c_int]),
    "vn_pool_new": (c_void_p, [c_int]),
    "vn_pool_free": (None, [c_void_p]),
    "vn_pool_threads": (c_int, [c_void_p]),
    "vn_model_new": (c_void_p, [c_int]),
    "vn_model_free": (None, [c_void_p]),
    "vn_model_conv": (
        c_int,
        [c_void_p, c_int, c_int, POINTER(c_int32), POINTER(c_int8), POINTER(c_float),
         POINTER(c_int32), c_float, c_int, c_float, c_int],
    ),
    "vn_model_sum": (
        c_int,
        [c_void_p, c_int, c_int, c_float, c_int, c_float, c_int, c_float, c_int],
    ),
    "vn_model_floats": (c_int, [c_void_p, c_int, c_int, POINTER(c_float), c_int]),
    "vn_model_finish": (c_int, [c_void_p]),
    "vn_workspace_new": (c_void_p, [c_int, c_int, c_int]),
    "vn_workspace_free": (None, [c_void_p]),
    "vn_workspace_bytes": (c_size_t, [c_void_p]),
    "vn_step": (c_int, [c_int, *[c_void_p] * 12]),
}  # fmt: skip


@functools.cache
def library() -> ctypes.CDLL:
    """Load the library. Raises NativeUnavailable with the reason."""
    path = Path(__file__).with_name(LIBRARY_NAME)
    if not path.exists():
        raise NativeUnavailable(
            f"{path.name} was not built when vergence was installed: there was no C compiler. "
            "Install gcc or clang and install vergence again, or use onnxruntime"
        )
    try:
        loaded = ctypes.CDLL(os.fspath(path))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(loaded, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise NativeUnavailable(f"{path} cannot be loaded: {error}") from None
    return loaded


def available() -> bool:
    """Return True if steps can run natively on this machine."""
    try:
        library()
    except NativeUnavailable:
        return False
    return True


@functools.cache
def variants() -> tuple[str, ...]:
    """The sets of instructions that this CPU has kernels for, fastest first; `scalar` is the last.

    Raises NativeUnavailable.
    """
    found: list[str] = []
    while name := library().vn_variant(len(found)):
        found.append(name.decode())
    return tuple(found)
