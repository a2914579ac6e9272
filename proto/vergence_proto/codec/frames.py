"""Stereo frames, disparity maps, and the errors and settings that travel with them."""

import math

import numpy as np

from vergence_proto.codec.enums import (
    COMPRESSION,
    DELIVERY,
    DISPARITY_ENCODING,
    ORIGIN,
    number_of,
    value_of,
)
from vergence_proto.codec.images import check_image, image_from_proto, image_to_wire
from vergence_proto.codec.planes import (
    bytes_plane_from_proto,
    bytes_plane_to_proto,
    check_denominator,
    compression_of,
    plane_from_proto,
    plane_to_proto,
)
from vergence_proto.codec.requests import ReceivedFrame, ReceivedImage
from vergence_proto.codec.rigs import (
    pose_from_proto,
    pose_sample_from_proto,
    pose_sample_to_proto,
    pose_to_proto,
)
from vergence_proto.codec.steps import (
    FRAME_SCALES,
    check_map_step,
    enlarge_image,
    reduce_image,
    reduced,
    widen_bytes,
    widen_plane,
)
from vergence_proto.codec.wire import Piece, delimited
from vergence_proto.errors import BadImage, BadShape, DepthError, FrameTooLarge, error_from_wire
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import (
    Delivery,
    DisparityMap,
    Image,
    ImageEncoding,
    Origin,
    OutputFormat,
    ReceivedPlanes,
    StereoFrame,
    Timings,
)
from vergence_proto.v1 import depth_pb2 as pb

_MICROSECONDS = 1e6
# The largest image file of a size: a PNG with alpha and 16 bits per channel, and its metadata.
_BYTES_A_PIXEL = 8
_BYTES_BESIDE_PIXELS = 1 << 18
_LARGEST_UINT32 = 2**32 - 1


def frame_to_request(
    frame: StereoFrame,
    *,
    encoding: ImageEncoding,
    jpeg_quality: int = 90,
    scale: int = 1,
    map_step: int = 0,
    max_age_s: float | None = None,
) -> bytes:
    """Encode a pair as the bytes of a ``pb.StreamDepthRequest``; images are copied only once.

    With ``scale`` 2 the images are sent at half size. ``map_step`` is that of the answer; 0: the
    stream's.

    Raises BadImage: an image is not uint8 [H, W, 3] or [H, W], is empty, or does not fit its
    encoding.
    Raises BadPose: the pose is not finite, or its matrix is no rotation.
    """
    message = pb.Frame(frame_id=frame.frame_id, capture_ns=frame.capture_ns, max_age_s=max_age_s)
    if scale != 1:
        message.scale = scale
    if map_step:
        message.map_step = map_step
    if frame.pose is not None:
        message.pose.CopyFrom(pose_sample_to_proto(frame.pose))
    pieces: list[Piece] = [message.SerializeToString()]
    for image, number in (
        (frame.left, pb.Frame.LEFT_FIELD_NUMBER),
        (frame.right, pb.Frame.RIGHT_FIELD_NUMBER),
    ):
        sent = image if scale == 1 else reduce_image(check_image(image), scale)
        pieces += delimited(number, *image_to_wire(sent, encoding, jpeg_quality=jpeg_quality))
    return b"".join(delimited(pb.StreamDepthRequest.FRAME_FIELD_NUMBER, *pieces))


def frame_from_proto(
    message: pb.Frame, *, size: tuple[int, int] | None = None, max_bytes: int | None = None
) -> StereoFrame:
    """Check and decode a frame, as :func:`check_frame` and :func:`decode_frame` do."""
    received = ReceivedFrame.of(message)
    check_frame(received, size=size, max_bytes=max_bytes)
    return decode_frame(received, size=size)


def check_frame(
    received: ReceivedFrame, *, size: tuple[int, int] | None = None, max_bytes: int | None = None
) -> None:
    """Check a frame without decoding it.

    ``size`` is the (width, height) of the stream's images, ``max_bytes`` the limit on the bytes of
    both together.

    Raises FrameTooLarge: the images have more than ``max_bytes``, or far more than their pixels.
    Raises BadShape: the frame id is 0, the sizes differ from ``size``, reduced by the scale, or
    from each other, the scale is not 1 or 2, the map_step is not 1, 2 or 4, or the maximum age is
    negative or not finite.
    """
    message = received.fields
    if message.frame_id == 0:
        raise BadShape("expected a frame_id from 1 upwards, got 0")
    if message.HasField("max_age_s") and not 0 <= message.max_age_s < math.inf:
        raise BadShape(f"expected a max_age_s from 0 upwards, got {message.max_age_s}")
    left, right = received.left.header, received.right.header
    if (left.width, left.height) != (right.width, right.height):
        raise BadShape(
            f"both images must have one size, got left {left.width}x{left.height} "
            f"and right {right.width}x{right.height}"
        )
    scale = message.scale or 1
    if scale not in FRAME_SCALES:
        raise BadShape(f"expected a scale of 1 or 2, got {scale}")
    check_map_step(message.map_step or 1)
    if size is not None and (left.width, left.height) != (sent := reduced(size, scale)):
        reduction = "" if scale == 1 else f" at scale {scale}"
        raise BadShape(
            f"expected images of {sent[0]}x{sent[1]}, as the stream was opened with{reduction}, "
            f"got {left.width}x{left.height}"
        )
    left_bytes, right_bytes = len(received.left.data), len(received.right.data)
    most = _BYTES_BESIDE_PIXELS + _BYTES_A_PIXEL * left.width * left.height
    if max_bytes is not None and left_bytes + right_bytes > max_bytes:
        raise FrameTooLarge(
            f"expected a frame of at most {max_bytes} bytes, got {left_bytes} and {right_bytes}; "
            "send JPEG, or start the server with a larger limits.max_frame_mib"
        )
    if max(left_bytes, right_bytes) > most:
        raise FrameTooLarge(
            f"expected at most {most} bytes for {left.width}x{left.height} pixels, got "
            f"{left_bytes} and {right_bytes}"
        )


def decode_frame(received: ReceivedFrame, *, size: tuple[int, int] | None = None) -> StereoFrame:
    """Decode both images and the pose of a frame that :func:`check_frame` accepts.

    Images that were sent smaller are enlarged to ``size``, if it is given.

    Raises BadImage: an image is not whole, or not of the stated encoding and size.
    Raises BadPose: a valid part of the pose is not finite, or its quaternion is not of unit length.
    """
    message = received.fields
    left, right = _side(received.left, "left"), _side(received.right, "right")
    if size is not None and message.scale > 1:
        left, right = enlarge_image(left, size), enlarge_image(right, size)
    return StereoFrame(
        frame_id=message.frame_id,
        capture_ns=message.capture_ns,
        left=left,
        right=right,
        pose=pose_sample_from_proto(message.pose) if message.HasField("pose") else None,
    )


def disparity_to_proto(
    disparity: DisparityMap, output: OutputFormat, *, into: pb.DisparityMap | None = None
) -> pb.DisparityMap:
    """Encode a map. ``into`` may be a field of a larger message, which saves a copy.

    The pose is sent unchanged, so the caller must have converted it to the stream's axes.
    Raises BadPose: the pose is not finite, or its matrix is no rotation.
    """
    message = pb.DisparityMap() if into is None else into
    message.frame_id, message.capture_ns = disparity.frame_id, disparity.capture_ns
    step = output.resolved().map_step
    if step != 1:
        message.map_step = step
    plane_to_proto(disparity.disparity_px[::step, ::step], output, into=message.disparity)
    message.origin = origin_to_proto(disparity.origin)
    message.step_count, message.iterations = disparity.step_count, disparity.iterations
    message.frames_skipped = disparity.frames_skipped
    message.timings.CopyFrom(timings_to_proto(disparity.timings))
    if math.isfinite(disparity.max_disparity_px):
        message.max_disparity_px = disparity.max_disparity_px
    if output.confidence and disparity.confidence is not None:
        bytes_plane_to_proto(
            np.ascontiguousarray(disparity.confidence[::step, ::step]),
            compression=compression_of(output),
            into=message.confidence,
        )
    if output.sigma and disparity.sigma_px is not None:
        plane_to_proto(disparity.sigma_px[::step, ::step], output, into=message.sigma)
    if disparity.world_from_left is not None:
        message.world_from_left.CopyFrom(pose_to_proto(disparity.world_from_left))
    return message


def received_planes_from_proto(message: pb.DisparityMap, rig: RectifiedRig) -> ReceivedPlanes:
    """Decode the planes of a map of ``rig`` as they were sent, every step-th pixel.

    Raises BadShape: a plane has another size than the rig, reduced by the map's step, or the step
    is not 1, 2 or 4.
    Raises BadImage: a plane is not whole, or not of the stated encoding, compression and size.
    """
    step = check_map_step(message.map_step or 1)
    size = reduced((rig.width, rig.height), step)
    for name in ("disparity", "confidence", "sigma"):
        plane: pb.Plane = getattr(message, name)
        wanted = name == "disparity" or message.HasField(name)
        if wanted and (plane.width, plane.height) != size:
            raise BadShape(
                f"expected a {name} plane of {size[0]}x{size[1]}, for the stream's rig and a step "
                f"of {step}, got {plane.width}x{plane.height}"
            )
    return ReceivedPlanes(
        step=step,
        disparity_px=plane_from_proto(message.disparity),
        sigma_px=plane_from_proto(message.sigma) if message.HasField("sigma") else None,
        confidence=bytes_plane_from_proto(message.confidence)
        if message.HasField("confidence")
        else None,
    )


def disparity_from_proto(
    message: pb.DisparityMap, rig: RectifiedRig, received: ReceivedPlanes | None = None
) -> DisparityMap:
    """Decode a map of ``rig``, the rectified rig in the answer to the stream's opening.

    The map has the size of the rig, also if fewer pixels were sent. ``received`` are its planes, if
    the caller has decoded them already.

    Raises BadShape: a plane has another size than the rig, reduced by the map's step, or the origin
    is unknown.
    Raises BadImage: a plane is not whole, or not of the stated encoding, compression and size.
    Raises BadPose: the pose is not finite, or its quaternion is not of unit length.
    """
    received = received or received_planes_from_proto(message, rig)
    step, size, sigma_px = received.step, (rig.width, rig.height), received.sigma_px
    confidence = received.confidence
    return DisparityMap(
        frame_id=message.frame_id,
        capture_ns=message.capture_ns,
        rig=rig,
        disparity_px=widen_plane(received.disparity_px, step, size),
        sigma_px=None if sigma_px is None else widen_plane(sigma_px, step, size),
        confidence=None if confidence is None else widen_bytes(confidence, step, size),
        world_from_left=pose_from_proto(message.world_from_left)
        if message.HasField("world_from_left")
        else None,
        origin=origin_from_proto(message.origin),
        step_count=message.step_count,
        iterations=message.iterations,
        frames_skipped=message.frames_skipped,
        timings=timings_from_proto(message.timings),
        max_disparity_px=message.max_disparity_px or math.inf,  # 0: an older server
    )


def output_format_to_proto(output: OutputFormat) -> pb.OutputFormat:
    """Encode the format. Raises BadShape: the denominator is not 4 to 64, or the step not 1, 2, 4.

    Zeros become the values for exact messages; see :meth:`OutputFormat.resolved`.
    """
    output = output.resolved()
    return pb.OutputFormat(
        encoding=number_of(DISPARITY_ENCODING, output.encoding),
        denominator=check_denominator(output.denominator),
        map_step=check_map_step(output.map_step),
        compression=compression_of(output),
        confidence=output.confidence,
        sigma=output.sigma,
    )


def output_format_from_proto(message: pb.OutputFormat) -> OutputFormat:
    """Decode the format; unspecified fields have the values for exact messages.

    Raises BadShape: the denominator is not 4 to 64, the step is not 1, 2 or 4, or depth.proto has
    no such number.
    """
    exact = OutputFormat().resolved()
    compressed, deflate = value_of(COMPRESSION, message.compression, "output compression")
    return OutputFormat(
        encoding=value_of(DISPARITY_ENCODING, message.encoding, "output encoding"),
        denominator=check_denominator(message.denominator or exact.denominator),
        map_step=check_map_step(message.map_step or exact.map_step),
        compressed=compressed,
        deflate=deflate,
        confidence=message.confidence,
        sigma=message.sigma,
    )


def delivery_to_proto(delivery: Delivery) -> pb.Delivery:
    return number_of(DELIVERY, delivery)


def delivery_from_proto(delivery: pb.Delivery) -> Delivery:
    """Decode; unspecified means newest. Raises BadShape: depth.proto has no such number."""
    return value_of(DELIVERY, delivery, "delivery")


def origin_to_proto(origin: Origin) -> pb.Origin:
    return number_of(ORIGIN, origin)


def origin_from_proto(origin: pb.Origin) -> Origin:
    """Decode; unspecified means warm. Raises BadShape: depth.proto has no such number."""
    return value_of(ORIGIN, origin, "origin")


def timings_to_proto(timings: Timings) -> pb.Timings:
    return pb.Timings(
        decode_us=_microseconds(timings.decode_s),
        queue_us=_microseconds(timings.queue_s),
        model_us=_microseconds(timings.model_s),
        encode_us=_microseconds(timings.encode_s),
        total_us=_microseconds(timings.total_s),
    )


def timings_from_proto(message: pb.Timings) -> Timings:
    return Timings(
        decode_s=message.decode_us / _MICROSECONDS,
        queue_s=message.queue_us / _MICROSECONDS,
        model_s=message.model_us / _MICROSECONDS,
        encode_s=message.encode_us / _MICROSECONDS,
        total_s=message.total_us / _MICROSECONDS,
    )


def error_to_frame_error(frame_id: int, error: DepthError) -> pb.FrameError:
    return pb.FrameError(
        frame_id=frame_id,
        reason=error.code,
        message=str(error),
        retry_after_s=error.retry_after_s,
    )


def error_from_frame_error(message: pb.FrameError) -> DepthError:
    """Return the error that the server raised about one frame, with the same class."""
    retry_after_s = message.retry_after_s if message.HasField("retry_after_s") else None
    return error_from_wire(message.reason, message.message, retry_after_s)


def _side(received: ReceivedImage, side: str) -> Image:
    try:
        return image_from_proto(received.header, received.data)
    except BadImage as error:
        raise BadImage(f"{side} image: {error}") from None


def _microseconds(seconds: float) -> int:
    return min(max(round(seconds * _MICROSECONDS), 0), _LARGEST_UINT32)
