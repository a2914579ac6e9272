"""Stereo frames, disparity maps, and the errors and settings that travel with them."""

import math

from vergence_proto.codec.enums import (
    COMPRESSED,
    DELIVERY,
    DISPARITY_ENCODING,
    ORIGIN,
    number_of,
    value_of,
)
from vergence_proto.codec.images import image_from_proto, image_to_wire
from vergence_proto.codec.planes import (
    bytes_plane_from_proto,
    bytes_plane_to_proto,
    check_denominator,
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
    max_age_s: float | None = None,
) -> bytes:
    """Encode a pair as the bytes of a ``pb.StreamDepthRequest``; images are copied only once.

    Raises BadImage: an image is not uint8 [H, W, 3] or [H, W], is empty, or does not fit its
    encoding.
    Raises BadPose: the pose is not finite, or its matrix is no rotation.
    """
    message = pb.Frame(frame_id=frame.frame_id, capture_ns=frame.capture_ns, max_age_s=max_age_s)
    if frame.pose is not None:
        message.pose.CopyFrom(pose_sample_to_proto(frame.pose))
    pieces: list[Piece] = [message.SerializeToString()]
    for image, number in (
        (frame.left, pb.Frame.LEFT_FIELD_NUMBER),
        (frame.right, pb.Frame.RIGHT_FIELD_NUMBER),
    ):
        pieces += delimited(number, *image_to_wire(image, encoding, jpeg_quality=jpeg_quality))
    return b"".join(delimited(pb.StreamDepthRequest.FRAME_FIELD_NUMBER, *pieces))


def frame_from_proto(
    message: pb.Frame, *, size: tuple[int, int] | None = None, max_bytes: int | None = None
) -> StereoFrame:
    """Check and decode a frame, as :func:`check_frame` and :func:`decode_frame` do."""
    received = ReceivedFrame.of(message)
    check_frame(received, size=size, max_bytes=max_bytes)
    return decode_frame(received)


def check_frame(
    received: ReceivedFrame, *, size: tuple[int, int] | None = None, max_bytes: int | None = None
) -> None:
    """Check a frame without decoding it.

    ``size`` is the required (width, height) of both images, ``max_bytes`` the limit on the bytes of
    both together.

    Raises FrameTooLarge: the images have more than ``max_bytes``, or far more than their pixels.
    Raises BadShape: the frame id is 0, the sizes differ from ``size`` or from each other, or the
    maximum age is negative or not finite.
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
    if size is not None and (left.width, left.height) != size:
        raise BadShape(
            f"expected images of {size[0]}x{size[1]}, as the stream was opened with, "
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


def decode_frame(received: ReceivedFrame) -> StereoFrame:
    """Decode both images and the pose of a frame that :func:`check_frame` accepts.

    Raises BadImage: an image is not whole, or not of the stated encoding and size.
    Raises BadPose: a valid part of the pose is not finite, or its quaternion is not of unit length.
    """
    message = received.fields
    return StereoFrame(
        frame_id=message.frame_id,
        capture_ns=message.capture_ns,
        left=_side(received.left, "left"),
        right=_side(received.right, "right"),
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
    plane_to_proto(disparity.disparity_px, output, into=message.disparity)
    message.origin = origin_to_proto(disparity.origin)
    message.step_count, message.iterations = disparity.step_count, disparity.iterations
    message.frames_skipped = disparity.frames_skipped
    message.timings.CopyFrom(timings_to_proto(disparity.timings))
    if math.isfinite(disparity.max_disparity_px):
        message.max_disparity_px = disparity.max_disparity_px
    if output.confidence and disparity.confidence is not None:
        bytes_plane_to_proto(
            disparity.confidence, compressed=output.compressed, into=message.confidence
        )
    if output.sigma and disparity.sigma_px is not None:
        plane_to_proto(disparity.sigma_px, output, into=message.sigma)
    if disparity.world_from_left is not None:
        message.world_from_left.CopyFrom(pose_to_proto(disparity.world_from_left))
    return message


def disparity_from_proto(message: pb.DisparityMap, rig: RectifiedRig) -> DisparityMap:
    """Decode a map of ``rig``, the rectified rig in the answer to the stream's opening.

    Raises BadShape: a plane has another size than the rig, or the origin is unknown.
    Raises BadImage: a plane is not whole, or not of the stated encoding, compression and size.
    Raises BadPose: the pose is not finite, or its quaternion is not of unit length.
    """
    for name in ("disparity", "confidence", "sigma"):
        plane: pb.Plane = getattr(message, name)
        wanted = name == "disparity" or message.HasField(name)
        if wanted and (plane.width, plane.height) != (rig.width, rig.height):
            raise BadShape(
                f"expected a {name} plane of {rig.width}x{rig.height}, the stream's rig, "
                f"got {plane.width}x{plane.height}"
            )
    return DisparityMap(
        frame_id=message.frame_id,
        capture_ns=message.capture_ns,
        rig=rig,
        disparity_px=plane_from_proto(message.disparity),
        sigma_px=plane_from_proto(message.sigma) if message.HasField("sigma") else None,
        confidence=bytes_plane_from_proto(message.confidence)
        if message.HasField("confidence")
        else None,
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
    """Encode the format. Raises BadShape: the denominator is not 16 to 64."""
    return pb.OutputFormat(
        encoding=number_of(DISPARITY_ENCODING, output.encoding),
        denominator=check_denominator(output.denominator),
        compression=number_of(COMPRESSED, output.compressed),
        confidence=output.confidence,
        sigma=output.sigma,
    )


def output_format_from_proto(message: pb.OutputFormat) -> OutputFormat:
    """Decode the format; an unspecified field becomes the default of :class:`OutputFormat`.

    Raises BadShape: the denominator is not 16 to 64, or depth.proto has no such number.
    """
    return OutputFormat(
        encoding=value_of(DISPARITY_ENCODING, message.encoding, "output encoding"),
        denominator=check_denominator(message.denominator or OutputFormat().denominator),
        compressed=value_of(COMPRESSED, message.compression, "output compression"),
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
