from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import Any as _Any, ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class NoticeKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    NOTICE_KIND_UNSPECIFIED: _ClassVar[NoticeKind]
    NOTICE_KIND_DRAINING: _ClassVar[NoticeKind]
    NOTICE_KIND_EXPIRING: _ClassVar[NoticeKind]

class Origin(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ORIGIN_UNSPECIFIED: _ClassVar[Origin]
    ORIGIN_WARM: _ClassVar[Origin]
    ORIGIN_COLD_START: _ClassVar[Origin]
    ORIGIN_RESUMED: _ClassVar[Origin]
    ORIGIN_RESET_REQUESTED: _ClassVar[Origin]
    ORIGIN_RESET_POSE_LOST: _ClassVar[Origin]
    ORIGIN_RESET_POSE_JUMP: _ClassVar[Origin]
    ORIGIN_RESET_GAP: _ClassVar[Origin]
    ORIGIN_RESET_TIME_BACKWARDS: _ClassVar[Origin]
    ORIGIN_RESET_NON_FINITE: _ClassVar[Origin]

class ImageEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    IMAGE_ENCODING_UNSPECIFIED: _ClassVar[ImageEncoding]
    IMAGE_ENCODING_MONO8: _ClassVar[ImageEncoding]
    IMAGE_ENCODING_RGB8: _ClassVar[ImageEncoding]
    IMAGE_ENCODING_JPEG: _ClassVar[ImageEncoding]
    IMAGE_ENCODING_PNG: _ClassVar[ImageEncoding]

class PlaneEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PLANE_ENCODING_UNSPECIFIED: _ClassVar[PlaneEncoding]
    PLANE_ENCODING_UINT16: _ClassVar[PlaneEncoding]
    PLANE_ENCODING_FLOAT16: _ClassVar[PlaneEncoding]
    PLANE_ENCODING_FLOAT32: _ClassVar[PlaneEncoding]
    PLANE_ENCODING_UINT8: _ClassVar[PlaneEncoding]

class Compression(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    COMPRESSION_UNSPECIFIED: _ClassVar[Compression]
    COMPRESSION_NONE: _ClassVar[Compression]
    COMPRESSION_DELTA_ZSTD: _ClassVar[Compression]
    COMPRESSION_DELTA_DEFLATE: _ClassVar[Compression]

class Delivery(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DELIVERY_UNSPECIFIED: _ClassVar[Delivery]
    DELIVERY_NEWEST: _ClassVar[Delivery]
    DELIVERY_EVERY: _ClassVar[Delivery]

class Axes(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    AXES_UNSPECIFIED: _ClassVar[Axes]
    AXES_OPENCV: _ClassVar[Axes]
    AXES_OPENXR: _ClassVar[Axes]
    AXES_UNITY: _ClassVar[Axes]
    AXES_NED: _ClassVar[Axes]
    AXES_ROS: _ClassVar[Axes]

class Distortion(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DISTORTION_UNSPECIFIED: _ClassVar[Distortion]
    DISTORTION_NONE: _ClassVar[Distortion]
    DISTORTION_BROWN_CONRADY: _ClassVar[Distortion]
    DISTORTION_KANNALA_BRANDT: _ClassVar[Distortion]
NOTICE_KIND_UNSPECIFIED: NoticeKind
NOTICE_KIND_DRAINING: NoticeKind
NOTICE_KIND_EXPIRING: NoticeKind
ORIGIN_UNSPECIFIED: Origin
ORIGIN_WARM: Origin
ORIGIN_COLD_START: Origin
ORIGIN_RESUMED: Origin
ORIGIN_RESET_REQUESTED: Origin
ORIGIN_RESET_POSE_LOST: Origin
ORIGIN_RESET_POSE_JUMP: Origin
ORIGIN_RESET_GAP: Origin
ORIGIN_RESET_TIME_BACKWARDS: Origin
ORIGIN_RESET_NON_FINITE: Origin
IMAGE_ENCODING_UNSPECIFIED: ImageEncoding
IMAGE_ENCODING_MONO8: ImageEncoding
IMAGE_ENCODING_RGB8: ImageEncoding
IMAGE_ENCODING_JPEG: ImageEncoding
IMAGE_ENCODING_PNG: ImageEncoding
PLANE_ENCODING_UNSPECIFIED: PlaneEncoding
PLANE_ENCODING_UINT16: PlaneEncoding
PLANE_ENCODING_FLOAT16: PlaneEncoding
PLANE_ENCODING_FLOAT32: PlaneEncoding
PLANE_ENCODING_UINT8: PlaneEncoding
COMPRESSION_UNSPECIFIED: Compression
COMPRESSION_NONE: Compression
COMPRESSION_DELTA_ZSTD: Compression
COMPRESSION_DELTA_DEFLATE: Compression
DELIVERY_UNSPECIFIED: Delivery
DELIVERY_NEWEST: Delivery
DELIVERY_EVERY: Delivery
AXES_UNSPECIFIED: Axes
AXES_OPENCV: Axes
AXES_OPENXR: Axes
AXES_UNITY: Axes
AXES_NED: Axes
AXES_ROS: Axes
DISTORTION_UNSPECIFIED: Distortion
DISTORTION_NONE: Distortion
DISTORTION_BROWN_CONRADY: Distortion
DISTORTION_KANNALA_BRANDT: Distortion

class StreamDepthRequest(_message.Message):
    __slots__ = ("open", "frame", "ping", "reset", "end")
    OPEN_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    PING_FIELD_NUMBER: _ClassVar[int]
    RESET_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    open: OpenStream
    frame: Frame
    ping: Ping
    reset: Reset
    end: End
    def __init__(self, open: _Optional[_Union[OpenStream, _Mapping[str, _Any]]] = ..., frame: _Optional[_Union[Frame, _Mapping[str, _Any]]] = ..., ping: _Optional[_Union[Ping, _Mapping[str, _Any]]] = ..., reset: _Optional[_Union[Reset, _Mapping[str, _Any]]] = ..., end: _Optional[_Union[End, _Mapping[str, _Any]]] = ...) -> None: ...

class StreamDepthResponse(_message.Message):
    __slots__ = ("opened", "disparity", "frame_error", "frames_dropped", "pong", "notice")
    OPENED_FIELD_NUMBER: _ClassVar[int]
    DISPARITY_FIELD_NUMBER: _ClassVar[int]
    FRAME_ERROR_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    PONG_FIELD_NUMBER: _ClassVar[int]
    NOTICE_FIELD_NUMBER: _ClassVar[int]
    opened: StreamOpened
    disparity: DisparityMap
    frame_error: FrameError
    frames_dropped: FramesDropped
    pong: Pong
    notice: Notice
    def __init__(self, opened: _Optional[_Union[StreamOpened, _Mapping[str, _Any]]] = ..., disparity: _Optional[_Union[DisparityMap, _Mapping[str, _Any]]] = ..., frame_error: _Optional[_Union[FrameError, _Mapping[str, _Any]]] = ..., frames_dropped: _Optional[_Union[FramesDropped, _Mapping[str, _Any]]] = ..., pong: _Optional[_Union[Pong, _Mapping[str, _Any]]] = ..., notice: _Optional[_Union[Notice, _Mapping[str, _Any]]] = ...) -> None: ...

class OpenStream(_message.Message):
    __slots__ = ("stream_id", "resume_token", "rig", "axes", "delivery", "output", "iterations", "cold_iterations", "weights_sha256", "opening_id", "paces")
    STREAM_ID_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    RIG_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    COLD_ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_SHA256_FIELD_NUMBER: _ClassVar[int]
    OPENING_ID_FIELD_NUMBER: _ClassVar[int]
    PACES_FIELD_NUMBER: _ClassVar[int]
    stream_id: str
    resume_token: bytes
    rig: StereoRig
    axes: Axes
    delivery: Delivery
    output: OutputFormat
    iterations: int
    cold_iterations: int
    weights_sha256: str
    opening_id: bytes
    paces: bool
    def __init__(self, stream_id: _Optional[str] = ..., resume_token: _Optional[bytes] = ..., rig: _Optional[_Union[StereoRig, _Mapping[str, _Any]]] = ..., axes: _Optional[_Union[Axes, str]] = ..., delivery: _Optional[_Union[Delivery, str]] = ..., output: _Optional[_Union[OutputFormat, _Mapping[str, _Any]]] = ..., iterations: _Optional[int] = ..., cold_iterations: _Optional[int] = ..., weights_sha256: _Optional[str] = ..., opening_id: _Optional[bytes] = ..., paces: bool = ...) -> None: ...

class StreamOpened(_message.Message):
    __slots__ = ("stream_id", "resume_token", "credit", "rig", "model", "resumed", "detach_grace_s", "idle_timeout_s", "last_frame_id", "silent_s", "max_frame_scale", "paced_credit", "left_from_rectified", "snapshots")
    STREAM_ID_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    CREDIT_FIELD_NUMBER: _ClassVar[int]
    RIG_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    RESUMED_FIELD_NUMBER: _ClassVar[int]
    DETACH_GRACE_S_FIELD_NUMBER: _ClassVar[int]
    IDLE_TIMEOUT_S_FIELD_NUMBER: _ClassVar[int]
    LAST_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    SILENT_S_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAME_SCALE_FIELD_NUMBER: _ClassVar[int]
    PACED_CREDIT_FIELD_NUMBER: _ClassVar[int]
    LEFT_FROM_RECTIFIED_FIELD_NUMBER: _ClassVar[int]
    SNAPSHOTS_FIELD_NUMBER: _ClassVar[int]
    stream_id: str
    resume_token: bytes
    credit: int
    rig: RectifiedRig
    model: ModelInfo
    resumed: bool
    detach_grace_s: float
    idle_timeout_s: float
    last_frame_id: int
    silent_s: float
    max_frame_scale: int
    paced_credit: int
    left_from_rectified: Pose
    snapshots: bool
    def __init__(self, stream_id: _Optional[str] = ..., resume_token: _Optional[bytes] = ..., credit: _Optional[int] = ..., rig: _Optional[_Union[RectifiedRig, _Mapping[str, _Any]]] = ..., model: _Optional[_Union[ModelInfo, _Mapping[str, _Any]]] = ..., resumed: bool = ..., detach_grace_s: _Optional[float] = ..., idle_timeout_s: _Optional[float] = ..., last_frame_id: _Optional[int] = ..., silent_s: _Optional[float] = ..., max_frame_scale: _Optional[int] = ..., paced_credit: _Optional[int] = ..., left_from_rectified: _Optional[_Union[Pose, _Mapping[str, _Any]]] = ..., snapshots: bool = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("frame_id", "capture_ns", "left", "right", "pose", "max_age_s", "scale", "map_step")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_NS_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    MAX_AGE_S_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    MAP_STEP_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    capture_ns: int
    left: Image
    right: Image
    pose: PoseSample
    max_age_s: float
    scale: int
    map_step: int
    def __init__(self, frame_id: _Optional[int] = ..., capture_ns: _Optional[int] = ..., left: _Optional[_Union[Image, _Mapping[str, _Any]]] = ..., right: _Optional[_Union[Image, _Mapping[str, _Any]]] = ..., pose: _Optional[_Union[PoseSample, _Mapping[str, _Any]]] = ..., max_age_s: _Optional[float] = ..., scale: _Optional[int] = ..., map_step: _Optional[int] = ...) -> None: ...

class Reset(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class End(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Ping(_message.Message):
    __slots__ = ("client_ns",)
    CLIENT_NS_FIELD_NUMBER: _ClassVar[int]
    client_ns: int
    def __init__(self, client_ns: _Optional[int] = ...) -> None: ...

class Pong(_message.Message):
    __slots__ = ("client_ns", "server_hold_ns", "unanswered_frame_ids", "received_ns")
    CLIENT_NS_FIELD_NUMBER: _ClassVar[int]
    SERVER_HOLD_NS_FIELD_NUMBER: _ClassVar[int]
    UNANSWERED_FRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_NS_FIELD_NUMBER: _ClassVar[int]
    client_ns: int
    server_hold_ns: int
    unanswered_frame_ids: _containers.RepeatedScalarFieldContainer[int]
    received_ns: int
    def __init__(self, client_ns: _Optional[int] = ..., server_hold_ns: _Optional[int] = ..., unanswered_frame_ids: _Optional[_Iterable[int]] = ..., received_ns: _Optional[int] = ...) -> None: ...

class Notice(_message.Message):
    __slots__ = ("kind", "message", "in_s")
    KIND_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    IN_S_FIELD_NUMBER: _ClassVar[int]
    kind: NoticeKind
    message: str
    in_s: float
    def __init__(self, kind: _Optional[_Union[NoticeKind, str]] = ..., message: _Optional[str] = ..., in_s: _Optional[float] = ...) -> None: ...

class FrameError(_message.Message):
    __slots__ = ("frame_id", "reason", "message", "retry_after_s")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    RETRY_AFTER_S_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    reason: str
    message: str
    retry_after_s: float
    def __init__(self, frame_id: _Optional[int] = ..., reason: _Optional[str] = ..., message: _Optional[str] = ..., retry_after_s: _Optional[float] = ...) -> None: ...

class FramesDropped(_message.Message):
    __slots__ = ("frame_ids",)
    FRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    frame_ids: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, frame_ids: _Optional[_Iterable[int]] = ...) -> None: ...

class DisparityMap(_message.Message):
    __slots__ = ("frame_id", "capture_ns", "disparity", "confidence", "sigma", "world_from_left", "origin", "step_count", "iterations", "frames_skipped", "timings", "max_disparity_px", "map_step", "received_ns", "saved_frame_id")
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_NS_FIELD_NUMBER: _ClassVar[int]
    DISPARITY_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    SIGMA_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_LEFT_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    STEP_COUNT_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_SKIPPED_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    MAX_DISPARITY_PX_FIELD_NUMBER: _ClassVar[int]
    MAP_STEP_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_NS_FIELD_NUMBER: _ClassVar[int]
    SAVED_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    frame_id: int
    capture_ns: int
    disparity: Plane
    confidence: Plane
    sigma: Plane
    world_from_left: Pose
    origin: Origin
    step_count: int
    iterations: int
    frames_skipped: int
    timings: Timings
    max_disparity_px: float
    map_step: int
    received_ns: int
    saved_frame_id: int
    def __init__(self, frame_id: _Optional[int] = ..., capture_ns: _Optional[int] = ..., disparity: _Optional[_Union[Plane, _Mapping[str, _Any]]] = ..., confidence: _Optional[_Union[Plane, _Mapping[str, _Any]]] = ..., sigma: _Optional[_Union[Plane, _Mapping[str, _Any]]] = ..., world_from_left: _Optional[_Union[Pose, _Mapping[str, _Any]]] = ..., origin: _Optional[_Union[Origin, str]] = ..., step_count: _Optional[int] = ..., iterations: _Optional[int] = ..., frames_skipped: _Optional[int] = ..., timings: _Optional[_Union[Timings, _Mapping[str, _Any]]] = ..., max_disparity_px: _Optional[float] = ..., map_step: _Optional[int] = ..., received_ns: _Optional[int] = ..., saved_frame_id: _Optional[int] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("decode_us", "queue_us", "model_us", "encode_us", "total_us")
    DECODE_US_FIELD_NUMBER: _ClassVar[int]
    QUEUE_US_FIELD_NUMBER: _ClassVar[int]
    MODEL_US_FIELD_NUMBER: _ClassVar[int]
    ENCODE_US_FIELD_NUMBER: _ClassVar[int]
    TOTAL_US_FIELD_NUMBER: _ClassVar[int]
    decode_us: int
    queue_us: int
    model_us: int
    encode_us: int
    total_us: int
    def __init__(self, decode_us: _Optional[int] = ..., queue_us: _Optional[int] = ..., model_us: _Optional[int] = ..., encode_us: _Optional[int] = ..., total_us: _Optional[int] = ...) -> None: ...

class Image(_message.Message):
    __slots__ = ("encoding", "width", "height", "data")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    encoding: ImageEncoding
    width: int
    height: int
    data: bytes
    def __init__(self, encoding: _Optional[_Union[ImageEncoding, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class Plane(_message.Message):
    __slots__ = ("encoding", "compression", "width", "height", "data", "denominator")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    COMPRESSION_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    DENOMINATOR_FIELD_NUMBER: _ClassVar[int]
    encoding: PlaneEncoding
    compression: Compression
    width: int
    height: int
    data: bytes
    denominator: int
    def __init__(self, encoding: _Optional[_Union[PlaneEncoding, str]] = ..., compression: _Optional[_Union[Compression, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., data: _Optional[bytes] = ..., denominator: _Optional[int] = ...) -> None: ...

class OutputFormat(_message.Message):
    __slots__ = ("encoding", "denominator", "compression", "confidence", "sigma", "map_step")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    DENOMINATOR_FIELD_NUMBER: _ClassVar[int]
    COMPRESSION_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    SIGMA_FIELD_NUMBER: _ClassVar[int]
    MAP_STEP_FIELD_NUMBER: _ClassVar[int]
    encoding: PlaneEncoding
    denominator: int
    compression: Compression
    confidence: bool
    sigma: bool
    map_step: int
    def __init__(self, encoding: _Optional[_Union[PlaneEncoding, str]] = ..., denominator: _Optional[int] = ..., compression: _Optional[_Union[Compression, str]] = ..., confidence: bool = ..., sigma: bool = ..., map_step: _Optional[int] = ...) -> None: ...

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("x", "y", "z", "w")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    W_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    w: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., w: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("orientation", "position_m")
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    POSITION_M_FIELD_NUMBER: _ClassVar[int]
    orientation: Quaternion
    position_m: Vector3
    def __init__(self, orientation: _Optional[_Union[Quaternion, _Mapping[str, _Any]]] = ..., position_m: _Optional[_Union[Vector3, _Mapping[str, _Any]]] = ...) -> None: ...

class PoseSample(_message.Message):
    __slots__ = ("world_from_left", "orientation_valid", "position_valid", "tracked")
    WORLD_FROM_LEFT_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_VALID_FIELD_NUMBER: _ClassVar[int]
    POSITION_VALID_FIELD_NUMBER: _ClassVar[int]
    TRACKED_FIELD_NUMBER: _ClassVar[int]
    world_from_left: Pose
    orientation_valid: bool
    position_valid: bool
    tracked: bool
    def __init__(self, world_from_left: _Optional[_Union[Pose, _Mapping[str, _Any]]] = ..., orientation_valid: bool = ..., position_valid: bool = ..., tracked: bool = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("width", "height", "fx", "fy", "cx", "cy", "distortion", "coefficients")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_FIELD_NUMBER: _ClassVar[int]
    COEFFICIENTS_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion
    coefficients: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., distortion: _Optional[_Union[Distortion, str]] = ..., coefficients: _Optional[_Iterable[float]] = ...) -> None: ...

class StereoRig(_message.Message):
    __slots__ = ("left", "right", "left_from_right")
    LEFT_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    LEFT_FROM_RIGHT_FIELD_NUMBER: _ClassVar[int]
    left: Camera
    right: Camera
    left_from_right: Pose
    def __init__(self, left: _Optional[_Union[Camera, _Mapping[str, _Any]]] = ..., right: _Optional[_Union[Camera, _Mapping[str, _Any]]] = ..., left_from_right: _Optional[_Union[Pose, _Mapping[str, _Any]]] = ...) -> None: ...

class RectifiedRig(_message.Message):
    __slots__ = ("width", "height", "fx", "fy", "cx_left", "cx_right", "cy", "baseline_m")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_LEFT_FIELD_NUMBER: _ClassVar[int]
    CX_RIGHT_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    BASELINE_M_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    fx: float
    fy: float
    cx_left: float
    cx_right: float
    cy: float
    baseline_m: float
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx_left: _Optional[float] = ..., cx_right: _Optional[float] = ..., cy: _Optional[float] = ..., baseline_m: _Optional[float] = ...) -> None: ...

class ModelInfo(_message.Message):
    __slots__ = ("name", "weights_sha256", "iterations", "max_disparity_px", "recurrent")
    NAME_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_SHA256_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    MAX_DISPARITY_PX_FIELD_NUMBER: _ClassVar[int]
    RECURRENT_FIELD_NUMBER: _ClassVar[int]
    name: str
    weights_sha256: str
    iterations: _containers.RepeatedScalarFieldContainer[int]
    max_disparity_px: int
    recurrent: bool
    def __init__(self, name: _Optional[str] = ..., weights_sha256: _Optional[str] = ..., iterations: _Optional[_Iterable[int]] = ..., max_disparity_px: _Optional[int] = ..., recurrent: bool = ...) -> None: ...

class GetServerInfoRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetServerInfoResponse(_message.Message):
    __slots__ = ("version", "model", "provider", "streams_open", "streams_max", "max_message_bytes", "max_pixels", "engine", "instruction_set", "capabilities")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    PROVIDER_FIELD_NUMBER: _ClassVar[int]
    STREAMS_OPEN_FIELD_NUMBER: _ClassVar[int]
    STREAMS_MAX_FIELD_NUMBER: _ClassVar[int]
    MAX_MESSAGE_BYTES_FIELD_NUMBER: _ClassVar[int]
    MAX_PIXELS_FIELD_NUMBER: _ClassVar[int]
    ENGINE_FIELD_NUMBER: _ClassVar[int]
    INSTRUCTION_SET_FIELD_NUMBER: _ClassVar[int]
    CAPABILITIES_FIELD_NUMBER: _ClassVar[int]
    version: str
    model: ModelInfo
    provider: str
    streams_open: int
    streams_max: int
    max_message_bytes: int
    max_pixels: int
    engine: str
    instruction_set: str
    capabilities: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, version: _Optional[str] = ..., model: _Optional[_Union[ModelInfo, _Mapping[str, _Any]]] = ..., provider: _Optional[str] = ..., streams_open: _Optional[int] = ..., streams_max: _Optional[int] = ..., max_message_bytes: _Optional[int] = ..., max_pixels: _Optional[int] = ..., engine: _Optional[str] = ..., instruction_set: _Optional[str] = ..., capabilities: _Optional[_Iterable[str]] = ...) -> None: ...

class GetStreamRequest(_message.Message):
    __slots__ = ("stream_id", "resume_token")
    STREAM_ID_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    stream_id: str
    resume_token: bytes
    def __init__(self, stream_id: _Optional[str] = ..., resume_token: _Optional[bytes] = ...) -> None: ...

class GetStreamResponse(_message.Message):
    __slots__ = ("stream_id", "attached", "rig", "frames_stepped", "frames_dropped", "frames_failed", "last_frame_id", "step_count", "idle_s", "state_bytes")
    STREAM_ID_FIELD_NUMBER: _ClassVar[int]
    ATTACHED_FIELD_NUMBER: _ClassVar[int]
    RIG_FIELD_NUMBER: _ClassVar[int]
    FRAMES_STEPPED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FAILED_FIELD_NUMBER: _ClassVar[int]
    LAST_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_COUNT_FIELD_NUMBER: _ClassVar[int]
    IDLE_S_FIELD_NUMBER: _ClassVar[int]
    STATE_BYTES_FIELD_NUMBER: _ClassVar[int]
    stream_id: str
    attached: bool
    rig: RectifiedRig
    frames_stepped: int
    frames_dropped: int
    frames_failed: int
    last_frame_id: int
    step_count: int
    idle_s: float
    state_bytes: int
    def __init__(self, stream_id: _Optional[str] = ..., attached: bool = ..., rig: _Optional[_Union[RectifiedRig, _Mapping[str, _Any]]] = ..., frames_stepped: _Optional[int] = ..., frames_dropped: _Optional[int] = ..., frames_failed: _Optional[int] = ..., last_frame_id: _Optional[int] = ..., step_count: _Optional[int] = ..., idle_s: _Optional[float] = ..., state_bytes: _Optional[int] = ...) -> None: ...

class ResetStreamRequest(_message.Message):
    __slots__ = ("stream_id", "resume_token")
    STREAM_ID_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    stream_id: str
    resume_token: bytes
    def __init__(self, stream_id: _Optional[str] = ..., resume_token: _Optional[bytes] = ...) -> None: ...

class ResetStreamResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class CloseStreamRequest(_message.Message):
    __slots__ = ("stream_id", "resume_token")
    STREAM_ID_FIELD_NUMBER: _ClassVar[int]
    RESUME_TOKEN_FIELD_NUMBER: _ClassVar[int]
    stream_id: str
    resume_token: bytes
    def __init__(self, stream_id: _Optional[str] = ..., resume_token: _Optional[bytes] = ...) -> None: ...

class CloseStreamResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
