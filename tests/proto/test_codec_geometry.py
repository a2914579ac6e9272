"""Poses and rigs travel whole; what is none is refused on both sides."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.strategies import NOT_FINITE, POSES, RIG, RIGS, assert_same_pose
from vergence_proto import codec
from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Distortion, Intrinsics, PoseSample, StereoRig
from vergence_proto.v1 import depth_pb2 as pb


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
