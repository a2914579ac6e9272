"""Live stereo depth over the network: the client.

Depth of one pair::

    import vergence

    depth_m = vergence.depth(left, right, rig).depth_m

A moving camera, live: one task submits frames, another reads results::

    async def film(session):
        async for left, right, world_from_left in camera:
            session.submit(left, right, world_from_left)

    async with vergence.DepthClient("grpc://127.0.0.1:50051") as client:
        async with client.open_session(rig) as session:
            filming = asyncio.create_task(film(session))
            async for result in session:
                print(result.depth_m.shape, result.age_s)

Everything public is in ``__all__``, :mod:`vergence.ros` and :mod:`vergence.depth_formats`; the
other modules may change. The errors that a server
raises are those of :mod:`vergence_proto.errors`; :class:`NotOpen`, :class:`WrongDelivery` and
:class:`ConnectionLost` are the client's own.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vergence import public
    from vergence.public import *  # noqa: F403  its list is ours

    __all__ = public.__all__
    __version__: str
    """The version of the installed package."""
else:
    # The names are loaded when the first of them is used: gRPC, NumPy and OpenCV would take most of
    # the time in which `vergence --help` answers.
    def __getattr__(name):
        if name == "__version__":
            return import_module("importlib.metadata").version("vergence")
        names = vars(import_module("vergence.public"))
        if name == "__all__" or name in names["__all__"]:
            return names[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return [*globals(), *import_module("vergence.public").__all__]
