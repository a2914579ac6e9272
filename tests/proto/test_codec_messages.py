import math

import numpy as np
import pytest
from google.rpc import error_details_pb2
from hypothesis import given
from hypothesis import strategies as st

from tests.proto.strategies import POSES, RIGS, assert_same_pose
from vergence_proto import codec
from vergence_proto.codec import enums
from vergence_proto.errors import (
    ERROR_CLASSES,
    BadCalibration,
    BadImage,
    BadPose,
    BadShape,
    DepthError,
    ErrorCode,
    FrameTooLarge,
)
from vergence_proto.geometry import Axes, Pose, RectifiedRig
from vergence_proto.types import (
    Delivery,
    DisparityMap,
    Distortion,
    ImageEncoding,
    Intrinsics,
    Origin,
    OutputFormat,
    PlaneEncoding,
    PoseSample,
    StereoFrame,
    StereoRig,
    Timings,
)
from vergence_proto.v1 import depth_pb2 as pb

RIG = RectifiedRig(8, 6, 10.0, 11.0, 3.5, 3.0, 2.5, 0.1)
NOT_FINITE = [float("nan"), float("inf"), -float("inf")]


def a_frame(pose: Pose | None = None) -> StereoFrame:
    left = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    sample = None if pose is None else PoseSample(pose)
    return StereoFrame(7, -5, left, left[::-1].copy(), sample)


def a_frame_message() -> pb.Frame:
    return codec.frame_to_proto(a_frame(Pose.identity()), encoding=ImageEncoding.RAW)


def a_map(pose: Pose | None = None) -> DisparityMap:
    disparity_px = np.linspace(1, 9, 48, dtype=np.float32).reshape(6, 8)
    disparity_px[2, 3] = np.nan
    return DisparityMap(
        frame_id=7,
        capture_ns=-5,
        rig=RIG,
        disparity_px=disparity_px,
        sigma_px=(disparity_px / 10).astype(np.float32),
        confidence=np.arange(48, dtype=np.uint8).reshape(6, 8),
        world_from_left=pose,
        origin=Origin.RESUMED,
        step_count=3,
        iterations=2,
        frames_skipped=1,
        timings=Timings(0.001, 0.002, 0.003, 0.004, 0.01),
    )


class TestFrames:
    @given(POSES)
    def test_a_frame_arrives_as_it_was_sent(self, pose: Pose) -> None:
        sent = a_frame(pose)
        message = codec.frame_to_proto(sent, encoding=ImageEncoding.RAW, max_age_s=0.25)
        back = codec.frame_from_proto(pb.Frame.FromString(message.SerializeToString()))
        assert (back.frame_id, back.capture_ns, message.max_age_s) == (7, -5, 0.25)
        np.testing.assert_array_equal(back.left, sent.left)
        np.testing.assert_array_equal(back.right, sent.right)
        assert back.pose is not None
        assert_same_pose(back.pose.world_from_left, pose)

    def test_a_frame_without_a_pose_stays_without(self) -> None:
        message = codec.frame_to_proto(a_frame(), encoding=ImageEncoding.PNG)
        assert codec.frame_from_proto(message).pose is None
        assert not message.HasField("max_age_s")

    def test_both_images_must_have_one_size(self) -> None:
        message = a_frame_message()
        message.right.width = 4
        with pytest.raises(BadShape, match="left 8x6 and right 4x6"):
            codec.frame_from_proto(message)

    def test_another_size_than_the_stream_s_is_refused_without_decoding(self) -> None:
        message = a_frame_message()
        message.left.data = message.right.data = b"never looked at"
        with pytest.raises(BadShape, match=r"expected images of 640x480, .* got 8x6"):
            codec.frame_from_proto(message, size=(640, 480))

    def test_a_frame_of_too_many_bytes_is_refused_without_decoding(self) -> None:
        message = a_frame_message()
        assert codec.frame_from_proto(message, max_bytes=2 * 144).left.shape == (6, 8, 3)
        message.right.data += b"!"
        with pytest.raises(FrameTooLarge, match="at most 288 bytes, got 144 and 145"):
            codec.frame_from_proto(message, max_bytes=2 * 144)

    @pytest.mark.parametrize("side", ["left", "right"])
    def test_a_damaged_image_is_told_by_its_side(self, side: str) -> None:
        message = a_frame_message()
        getattr(message, side).data = b"short"
        with pytest.raises(BadImage, match=f"^{side} image: .*got 5"):
            codec.frame_from_proto(message)

    def test_frames_count_from_one(self) -> None:
        message = a_frame_message()
        message.frame_id = 0
        with pytest.raises(BadShape, match="frame_id"):
            codec.frame_from_proto(message)

    @pytest.mark.parametrize("age_s", [-0.1, *NOT_FINITE])
    def test_a_maximum_age_is_a_length_of_time(self, age_s: float) -> None:
        message = a_frame_message()
        message.max_age_s = age_s
        with pytest.raises(BadShape, match="max_age_s"):
            codec.frame_from_proto(message)


class TestPoses:
    @given(POSES)
    def test_round_trip(self, pose: Pose) -> None:
        assert_same_pose(codec.pose_from_proto(codec.pose_to_proto(pose)), pose)

    @pytest.mark.parametrize("value", NOT_FINITE)
    @pytest.mark.parametrize("component", "xyzw")
    def test_an_orientation_must_be_finite(self, component: str, value: float) -> None:
        message = codec.pose_to_proto(Pose.identity())
        setattr(message.orientation, component, value)
        with pytest.raises(BadPose, match="finite orientation"):
            codec.pose_from_proto(message)

    @pytest.mark.parametrize("value", NOT_FINITE)
    @pytest.mark.parametrize("component", "xyz")
    def test_a_position_must_be_finite(self, component: str, value: float) -> None:
        message = codec.pose_to_proto(Pose.identity())
        setattr(message.position_m, component, value)
        with pytest.raises(BadPose, match="finite position"):
            codec.pose_from_proto(message)

    @pytest.mark.parametrize("length", [0.0, 0.9, 0.998, 1.002, 2.0])
    def test_a_quaternion_must_be_of_unit_length(self, length: float) -> None:
        message = pb.Pose(orientation=pb.Quaternion(w=length))
        with pytest.raises(BadPose, match="unit quaternion"):
            codec.pose_from_proto(message)

    @pytest.mark.parametrize("length", [0.9995, 1.0005])
    def test_rounding_is_forgiven_and_normalised(self, length: float) -> None:
        half = math.sqrt(0.5) * length
        pose = codec.pose_from_proto(pb.Pose(orientation=pb.Quaternion(x=half, w=half)))
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)

    def test_an_empty_message_is_no_pose(self) -> None:
        with pytest.raises(BadPose):
            codec.pose_from_proto(pb.Pose())

    @pytest.mark.parametrize(
        "rotation",
        [
            pytest.param(np.diag([1.0, 1.0, -1.0]), id="mirrored"),
            pytest.param(np.eye(3) * 1.1, id="scaled"),
            pytest.param(np.full((3, 3), np.nan), id="nan"),
        ],
    )
    def test_a_matrix_that_is_no_rotation_is_not_sent(self, rotation: np.ndarray) -> None:
        with pytest.raises(BadPose, match="orthonormal"):
            codec.pose_to_proto(Pose(rotation, np.zeros(3)))

    @given(POSES, st.booleans(), st.booleans(), st.booleans())
    def test_flags_travel(
        self, pose: Pose, orientation: bool, position: bool, tracked: bool
    ) -> None:
        sample = PoseSample(pose, orientation, position, tracked)
        back = codec.pose_sample_from_proto(codec.pose_sample_to_proto(sample))
        assert (back.orientation_valid, back.position_valid) == (orientation, position)
        assert back.tracked == tracked
        expected = Pose(
            pose.rotation if orientation else np.eye(3),
            pose.translation_m if position else np.zeros(3),
        )
        assert_same_pose(back.world_from_left, expected)

    def test_what_is_flagged_invalid_may_hold_anything(self) -> None:
        message = pb.PoseSample(world_from_left=codec.pose_to_proto(Pose.identity()))
        message.world_from_left.orientation.w = math.nan
        message.world_from_left.position_m.x = math.inf
        assert_same_pose(codec.pose_sample_from_proto(message).world_from_left, Pose.identity())
        message.position_valid = True
        with pytest.raises(BadPose):
            codec.pose_sample_from_proto(message)


CAMERAS = [
    pytest.param(Distortion.NONE, (), id="pinhole"),
    pytest.param(Distortion.BROWN_CONRADY, (0.1, -0.2, 0.001, 0.002), id="brown-conrady 4"),
    pytest.param(Distortion.BROWN_CONRADY, (0.1,) * 5, id="brown-conrady 5"),
    pytest.param(Distortion.BROWN_CONRADY, (0.1,) * 8, id="brown-conrady 8"),
    pytest.param(Distortion.KANNALA_BRANDT, (0.1,) * 4, id="kannala-brandt"),
]


def a_rig_message() -> pb.StereoRig:
    return codec.rig_to_proto(StereoRig.from_rectified(RIG))


class TestRigs:
    @pytest.mark.parametrize(("distortion", "coefficients"), CAMERAS)
    @given(pose=POSES.filter(lambda pose: np.linalg.norm(pose.translation_m) > 1e-3))
    def test_round_trip(
        self, distortion: Distortion, coefficients: tuple[float, ...], pose: Pose
    ) -> None:
        camera = Intrinsics(640, 480, 400, 410, 320, 240, distortion, coefficients)
        back = codec.rig_from_proto(codec.rig_to_proto(StereoRig(camera, camera, pose)))
        assert (back.left, back.right) == (camera, camera)
        assert_same_pose(back.left_from_right, pose)

    @given(RIGS)
    def test_rectified_round_trip(self, rig: RectifiedRig) -> None:
        assert codec.rectified_rig_from_proto(codec.rectified_rig_to_proto(rig)) == rig

    @pytest.mark.parametrize("part", ["left", "right", "left_from_right"])
    def test_a_missing_part_is_named(self, part: str) -> None:
        message = a_rig_message()
        message.ClearField(part)
        with pytest.raises(BadCalibration, match=f"no {part}"):
            codec.rig_from_proto(message)

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            pytest.param("fx", 0.0, id="no focal length"),
            pytest.param("fy", -400.0, id="negative focal length"),
            pytest.param("cx", math.nan, id="nan"),
            pytest.param("width", 0, id="no width"),
            pytest.param("height", 7, id="two sizes"),
            pytest.param("distortion", 99, id="unknown distortion"),
            pytest.param("distortion", pb.DISTORTION_KANNALA_BRANDT, id="no coefficients"),
        ],
    )
    def test_a_camera_that_cannot_be_is_refused(self, field: str, value: float) -> None:
        message = a_rig_message()
        setattr(message.left, field, value)
        with pytest.raises(BadCalibration):
            codec.rig_from_proto(message)

    def test_distortion_must_say_its_model(self) -> None:
        message = a_rig_message()
        message.left.coefficients.extend([0.1] * 4)
        with pytest.raises(BadCalibration, match=r"left camera: .*got 4"):
            codec.rig_from_proto(message)

    @pytest.mark.parametrize("baseline_m", [0.0, *NOT_FINITE])
    def test_a_baseline_must_be_a_length(self, baseline_m: float) -> None:
        message = a_rig_message()
        message.left_from_right.position_m.x = baseline_m
        with pytest.raises(BadCalibration):
            codec.rig_from_proto(message)

    def test_a_rotation_between_the_cameras_must_be_one(self) -> None:
        message = a_rig_message()
        message.left_from_right.orientation.w = 3
        with pytest.raises(BadCalibration, match="left_from_right"):
            codec.rig_from_proto(message)

    def test_a_rig_of_a_mirror_is_not_sent(self) -> None:
        rig = StereoRig.from_rectified(RIG)
        mirrored = Pose(np.diag([1.0, 1.0, -1.0]), rig.left_from_right.translation_m)
        with pytest.raises(BadCalibration, match="left_from_right"):
            codec.rig_to_proto(StereoRig(rig.left, rig.right, mirrored))

    @pytest.mark.parametrize(
        ("field", "value"),
        [("fx", 0.0), ("fy", math.nan), ("width", 0), ("baseline_m", 0.0), ("baseline_m", -0.1)],
    )
    def test_a_rectified_rig_that_cannot_be_is_refused(self, field: str, value: float) -> None:
        message = codec.rectified_rig_to_proto(RIG)
        setattr(message, field, value)
        with pytest.raises(BadCalibration):
            codec.rectified_rig_from_proto(message)


class TestDisparity:
    @pytest.mark.parametrize("encoding", PlaneEncoding)
    @given(pose=POSES)
    def test_a_map_arrives_as_it_was_sent(self, encoding: PlaneEncoding, pose: Pose) -> None:
        sent = a_map(pose)
        output = OutputFormat(encoding, confidence=True, sigma=True)
        message = codec.disparity_to_proto(sent, output)
        back = codec.disparity_from_proto(
            pb.DisparityMap.FromString(message.SerializeToString()), RIG
        )
        assert (back.frame_id, back.capture_ns, back.rig) == (7, -5, RIG)
        assert (back.origin, back.step_count, back.iterations) == (Origin.RESUMED, 3, 2)
        assert (back.frames_skipped, back.timings) == (1, sent.timings)
        half_a_step = 1 / 128
        assert back.sigma_px is not None
        assert sent.sigma_px is not None
        np.testing.assert_allclose(back.disparity_px, sent.disparity_px, atol=half_a_step)
        np.testing.assert_allclose(back.sigma_px, sent.sigma_px, atol=half_a_step)
        np.testing.assert_array_equal(back.valid, sent.valid)
        np.testing.assert_array_equal(back.confidence, sent.confidence)
        assert back.world_from_left is not None
        assert_same_pose(back.world_from_left, pose)

    def test_only_what_was_asked_for_is_sent(self) -> None:
        back = codec.disparity_from_proto(codec.disparity_to_proto(a_map(), OutputFormat()), RIG)
        assert back.confidence is None
        assert back.sigma_px is None
        assert back.world_from_left is None

    @pytest.mark.parametrize("plane", ["disparity", "confidence", "sigma"])
    def test_a_plane_of_another_size_is_told_by_its_name(self, plane: str) -> None:
        output = OutputFormat(confidence=True, sigma=True)
        message = codec.disparity_to_proto(a_map(), output)
        getattr(message, plane).width = 9
        with pytest.raises(BadShape, match=f"{plane} plane of 8x6, .* got 9x6"):
            codec.disparity_from_proto(message, RIG)

    def test_a_map_without_disparity_is_none(self) -> None:
        with pytest.raises(BadShape, match="disparity plane"):
            codec.disparity_from_proto(pb.DisparityMap(frame_id=1), RIG)


class TestSettings:
    @given(
        st.sampled_from(PlaneEncoding),
        st.integers(16, 64),
        st.booleans(),
        st.booleans(),
        st.booleans(),
    )
    def test_output_round_trip(
        self,
        encoding: PlaneEncoding,
        denominator: int,
        compressed: bool,
        confidence: bool,
        sigma: bool,
    ) -> None:
        output = OutputFormat(encoding, denominator, compressed, confidence, sigma)
        assert codec.output_format_from_proto(codec.output_format_to_proto(output)) == output

    def test_an_empty_format_is_the_default(self) -> None:
        assert codec.output_format_from_proto(pb.OutputFormat()) == OutputFormat()

    @pytest.mark.parametrize("denominator", [1, 15, 65, 1000])
    def test_a_denominator_out_of_range_is_refused_on_both_sides(self, denominator: int) -> None:
        with pytest.raises(BadShape, match="16 to 64"):
            codec.output_format_from_proto(pb.OutputFormat(denominator=denominator))
        with pytest.raises(BadShape, match="16 to 64"):
            codec.output_format_to_proto(OutputFormat(denominator=denominator))

    @pytest.mark.parametrize("encoding", [pb.PLANE_ENCODING_UINT8, 99])
    def test_disparity_is_not_sent_in_bytes_or_the_unknown(
        self, encoding: pb.PlaneEncoding
    ) -> None:
        with pytest.raises(BadShape, match="output encoding"):
            codec.output_format_from_proto(pb.OutputFormat(encoding=encoding))

    def test_unspecified_means_the_documented_default(self) -> None:
        assert codec.axes_from_proto(pb.AXES_UNSPECIFIED) is Axes.OPENCV
        assert codec.delivery_from_proto(pb.DELIVERY_UNSPECIFIED) is Delivery.NEWEST

    @pytest.mark.parametrize("axes", Axes)
    def test_axes_round_trip(self, axes: Axes) -> None:
        assert codec.axes_from_proto(codec.axes_to_proto(axes)) is axes

    @pytest.mark.parametrize("delivery", Delivery)
    def test_delivery_round_trip(self, delivery: Delivery) -> None:
        assert codec.delivery_from_proto(codec.delivery_to_proto(delivery)) is delivery

    @pytest.mark.parametrize("origin", Origin)
    def test_origin_round_trip(self, origin: Origin) -> None:
        assert codec.origin_from_proto(codec.origin_to_proto(origin)) is origin

    @pytest.mark.parametrize(
        ("table", "wire"),
        [
            pytest.param(enums.AXES, pb.Axes, id="axes"),
            pytest.param(enums.DISTORTION, pb.Distortion, id="distortion"),
            pytest.param(enums.DELIVERY, pb.Delivery, id="delivery"),
            pytest.param(enums.COMPRESSED, pb.Compression, id="compression"),
            pytest.param(enums.ORIGIN, pb.Origin, id="origin"),
        ],
    )
    def test_no_number_of_the_wire_is_forgotten(
        self, table: dict[int, object], wire: type[pb.Axes]
    ) -> None:
        assert set(table) == set(wire.values())

    @pytest.mark.parametrize("decode", ["axes", "delivery", "origin"])
    def test_a_number_from_a_newer_peer_is_refused(self, decode: str) -> None:
        with pytest.raises(BadShape, match=f"{decode}: expected one of .* got 99"):
            getattr(codec, f"{decode}_from_proto")(99)


class TestTimings:
    def test_microseconds_are_kept_and_the_impossible_is_clamped(self) -> None:
        sent = Timings(decode_s=1e-6, queue_s=-1, model_s=1e9, encode_s=0.25, total_s=0)
        back = codec.timings_from_proto(codec.timings_to_proto(sent))
        assert back == Timings(1e-6, 0, (2**32 - 1) / 1e6, 0.25, 0)


@pytest.mark.parametrize("code", ErrorCode)
@pytest.mark.parametrize("retry_after_s", [None, 0.5])
def test_the_error_of_a_frame_keeps_its_class(code: ErrorCode, retry_after_s: float | None) -> None:
    raised = ERROR_CLASSES[code]("the reason", retry_after_s=retry_after_s)
    message = codec.error_to_frame_error(7, raised)
    back = codec.error_from_frame_error(pb.FrameError.FromString(message.SerializeToString()))
    assert message.frame_id == 7
    assert type(back) is type(raised)
    assert isinstance(back, DepthError)
    assert (str(back), back.retry_after_s) == ("the reason", retry_after_s)


@pytest.mark.parametrize("code", ErrorCode)
@pytest.mark.parametrize("retry_after_s", [None, 0.5])
def test_an_error_keeps_its_class_as_a_status(code: ErrorCode, retry_after_s: float | None) -> None:
    status = codec.error_to_status(ERROR_CLASSES[code]("why", retry_after_s=retry_after_s), 3)
    back = codec.error_from_status(type(status).FromString(status.SerializeToString()))
    assert status.code == 3
    assert type(back) is ERROR_CLASSES[code]
    assert (str(back), back.retry_after_s) == ("why", retry_after_s)


def test_a_status_of_another_program_is_not_ours() -> None:
    status = codec.error_to_status(BadPose("why"), 3)
    info = error_details_pb2.ErrorInfo(reason="BAD_POSE", domain="example.com")
    status.details[0].Pack(info)
    assert codec.error_from_status(status) is None
    del status.details[:]
    assert codec.error_from_status(status) is None


def test_the_list_of_public_names_is_sorted_and_complete() -> None:
    public = {name for name in vars(codec) if "_to_" in name or "_from_" in name}
    assert codec.__all__ == sorted(public)
