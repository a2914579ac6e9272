"""The error that a caller gets for a failure that the caller did not cause."""

import errno
import logging

from vergence_proto.errors import DepthError, ModelFailed, NotReady, StateMemory

_NO_DESCRIPTORS = frozenset({errno.EMFILE, errno.ENFILE})


def error_of(error: Exception, log: logging.Logger, what: str) -> DepthError:
    """Return the error to report. An unexpected one is logged; ``what`` says what failed.

    A shortage of memory or of file descriptors is expected: the limits of the process may be low.
    """
    if isinstance(error, DepthError):
        return error
    leaves = _leaves(error)
    if any(isinstance(leaf, MemoryError) for leaf in leaves):
        return out_of_memory()
    if any(isinstance(leaf, OSError) and leaf.errno in _NO_DESCRIPTORS for leaf in leaves):
        return NotReady("the server has too many open files; try again later", retry_after_s=1.0)
    log.error("%s failed with an unexpected error", what, exc_info=error)
    return ModelFailed("the server failed; its log has the reason")


def out_of_memory() -> StateMemory:
    """Return the error for work that the process has no memory for."""
    return StateMemory(
        "the server has no memory left for this, and nothing has changed; try again later, or with "
        "smaller images"
    )


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for each in error.exceptions for leaf in _leaves(each)]
    return [error]
