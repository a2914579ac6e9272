"""Frames and their answers travel whole; what is wrong with one is said by its part."""

import numpy as np
import pytest
from hypothesis import given

from tests.support.strategies import NOT_FINITE, POSES, RIG, assert_same_pose
from vergence_proto import codec
from vergence_proto.errors import BadImage, BadShape, FrameTooLarge
from vergence_proto.geometry import Pose
from vergence_proto.types import (
    DisparityMap,
    ImageEncoding,
    Origin,
    OutputFormat,
    PlaneEncoding,
    PoseSample,
    StereoFrame,
    Timings,
)
from vergence_proto.v1 import depth_pb2 as pb


def a_frame(pose: Pose | None = None) -> StereoFrame:
    left = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    sample = None if pose is None else PoseSample(pose)
    return StereoFrame(7, -5, left, left[::-1].copy(), sample)


def sent(
    frame: StereoFrame,
    encoding: ImageEncoding = ImageEncoding.RAW,
    max_age_s: float | None = None,
) -> pb.Frame:
    request = codec.frame_to_request(frame, encoding=encoding, max_age_s=max_age_s)
    return pb.StreamDepthRequest.FromString(request).frame


def a_frame_message() -> pb.Frame:
    return sent(a_frame(Pose.identity()))


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
        max_disparity_px=96.5,
    )


class TestFrames:
    @given(POSES)
    def test_a_frame_arrives_as_it_was_sent(self, pose: Pose) -> None:
        frame = a_frame(pose)
        message = sent(frame, max_age_s=0.25)
        back = codec.frame_from_proto(message)
        assert (back.frame_id, back.capture_ns, message.max_age_s) == (7, -5, 0.25)
        np.testing.assert_array_equal(back.left, frame.left)
        np.testing.assert_array_equal(back.right, frame.right)
        assert back.pose is not None
        assert_same_pose(back.pose.world_from_left, pose)

    def test_a_frame_without_a_pose_stays_without(self) -> None:
        message = sent(a_frame(), ImageEncoding.PNG)
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
    def test_a_damaged_image_is_reported_by_its_side(self, side: str) -> None:
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
        assert back.max_disparity_px == 96.5
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
    def test_a_plane_of_another_size_is_reported_by_its_name(self, plane: str) -> None:
        output = OutputFormat(confidence=True, sigma=True)
        message = codec.disparity_to_proto(a_map(), output)
        getattr(message, plane).width = 9
        with pytest.raises(BadShape, match=f"{plane} plane of 8x6, .* got 9x6"):
            codec.disparity_from_proto(message, RIG)

    def test_a_map_without_disparity_is_none(self) -> None:
        with pytest.raises(BadShape, match="disparity plane"):
            codec.disparity_from_proto(pb.DisparityMap(frame_id=1), RIG)


class TestTimings:
    def test_microseconds_are_kept_and_the_impossible_is_clamped(self) -> None:
        sent = Timings(decode_s=1e-6, queue_s=-1, model_s=1e9, encode_s=0.25, total_s=0)
        back = codec.timings_from_proto(codec.timings_to_proto(sent))
        assert back == Timings(1e-6, 0, (2**32 - 1) / 1e6, 0.25, 0)
