"""Errors of the SDK itself; those that a server raises are in :mod:`vergence_proto.errors`."""


class NotOpen(RuntimeError):
    """A client or session was used before its ``async with`` (or ``with``) or after its end.

    No request was sent. The message says what to open.
    """


class WrongDelivery(RuntimeError):
    """A session was asked for what its delivery excludes: ``submit`` may drop a frame, EVERY not.

    Nothing was sent. The message says which method to use.
    """
