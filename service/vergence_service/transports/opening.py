"""The opening message of a call, as the choices of a stream."""

from vergence_proto import codec
from vergence_proto.errors import Quota
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.principals import Principal
from vergence_service.streams.stream import StreamConfig


def stream_config(
    request: pb.OpenStream, caller: Principal, *, most_iterations: int
) -> StreamConfig:
    """Return the choices of a stream.

    Raises BadCalibration or BadShape if one is not possible, and Quota if a principal with a
    credential asks for more than ``most_iterations``.
    """
    config = StreamConfig(
        rig=codec.rig_from_proto(request.rig),
        axes=codec.axes_from_proto(request.axes),
        delivery=codec.delivery_from_proto(request.delivery),
        output=codec.output_format_from_proto(request.output),
        iterations=request.iterations,
        cold_iterations=request.cold_iterations,
        weights_sha256=request.weights_sha256,
        opening_id=request.opening_id,
    )
    asked = max(config.iterations, config.cold_iterations)
    if caller.proven and asked > most_iterations:
        raise Quota(
            f"expected at most {most_iterations} iterations of one principal, got {asked}; ask for "
            "fewer (the server's setting limits.iterations)"
        )
    return config
