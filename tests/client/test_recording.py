"""The law of recordings: a replay gives the bits that were recorded."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from rich.console import Console

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.scene import scene
from tests.support.server import running_server
from tests.support.session_frames import EXACT, step, submit
from tests.support.shipped_model import shipped_model
from vergence import (
    Axes,
    Delivery,
    DepthClient,
    DepthResult,
    ImageEncoding,
    NotOpen,
    Origin,
    Pose,
)
from vergence.cli.demo import bundled_sample
from vergence.cli.footage_session import answered_frames, first_frames, pace_of, session_for
from vergence.cli.record import record
from vergence.cli.sources import CalibrationFlags, footage_at
from vergence_proto import codec, recordings
from vergence_proto.datasets import DatasetError, RecordedSource, SourceFrame, open_source
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.inference.model import StereoModel

FRAMES = 5
RESET_BEFORE = 3
BLACK = np.zeros((RIG.height, RIG.width), np.uint8)


@pytest.fixture(scope="module")
def model() -> StereoModel:
    return shipped_model()


@pytest.fixture
async def client(model: StereoModel) -> AsyncIterator[DepthClient]:
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        yield client


def room() -> list[SourceFrame]:
    return list(islice(open_source(bundled_sample()), FRAMES))


async def recorded(client: DepthClient, path: Path, **choices: Any) -> list[DepthResult]:
    """Record the room, with a reset on the way; returns the results."""
    results = []
    axes = choices.get("axes", Axes.OPENCV)
    rig = open_source(bundled_sample()).rig
    async with client.open_session(rig, cold_iterations=2, **choices) as session:
        with session.record(path) as recording:
            for index, source in enumerate(room()):
                if index == RESET_BEFORE:
                    session.reset()
                frame = source.frame
                assert frame.pose is not None
                pose = axes.from_opencv(frame.pose.world_from_left)
                results.append(
                    await session.step(frame.left, frame.right, pose, capture_ns=frame.capture_ns)
                )
        assert recording.frames == FRAMES
    return results


@pytest.mark.parametrize(
    "choices",
    [
        {"axes": Axes.OPENXR, "encoding": ImageEncoding.JPEG, "delivery": Delivery.NEWEST},
        {"axes": Axes.UNITY, "encoding": ImageEncoding.RAW, "delivery": Delivery.EVERY},
    ],
    ids=["live, JPEG, OpenXR", "lossless, raw, Unity"],
)
async def test_a_replay_gives_the_bits_that_were_recorded(
    choices: dict[str, Any], client: DepthClient, tmp_path: Path
) -> None:
    path = tmp_path / "walk.mcap"
    results = await recorded(client, path, output=EXACT, **choices)
    footage = footage_at([str(path)], CalibrationFlags())
    pace = pace_of("max", footage)
    async with session_for(client, footage, pace, EXACT, 0) as session:
        frames = first_frames(footage, None)
        again = [each async for each in answered_frames(session, footage, pace, frames)]
    assert len(again) == FRAMES
    for result, answered in zip(results, again, strict=True):
        np.testing.assert_array_equal(result.disparity_px, answered.result.disparity_px)
        assert result.iterations == answered.result.iterations
    assert again[RESET_BEFORE].result.origin is Origin.RESET_REQUESTED


async def test_a_replay_sends_the_poses_that_were_sent_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    random = np.random.default_rng(0)
    async with scene() as quiet, quiet.open_session(Delivery.EVERY) as session:
        with session.record(path):
            for _ in range(8):
                pose = Pose.from_xyzw(random.normal(size=4), random.normal(size=3))
                await session.step(BLACK, BLACK, pose)
    source = open_source(f"mcap:{path}")
    assert isinstance(source, RecordedSource)
    sent = []
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages([recordings.FRAME]):
            sent.append(pb.Frame.FromString(message.data).pose)
    for source_frame, expected in zip(replace(source, as_sent=True), sent, strict=True):
        assert source_frame.frame.pose is not None
        assert codec.pose_sample_to_proto(source_frame.frame.pose) == expected


async def test_a_viewer_finds_images_calibration_poses_and_depth(
    client: DepthClient, tmp_path: Path
) -> None:
    results = await recorded(client, tmp_path / "walk.mcap", encoding=ImageEncoding.JPEG)
    depth: list[Any] = []
    with (tmp_path / "walk.mcap").open("rb") as file:
        found = {}
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            found[channel.topic] = schema.name
            if channel.topic == recordings.DEPTH_IMAGE:
                from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

                depth.append(RawImage.FromString(message.data))
    assert {topic: name for topic, name in found.items() if name.startswith("foxglove")} == {
        recordings.LEFT_IMAGE: "foxglove.CompressedImage",
        recordings.RIGHT_IMAGE: "foxglove.CompressedImage",
        recordings.LEFT_CALIBRATION: "foxglove.CameraCalibration",
        recordings.RIGHT_CALIBRATION: "foxglove.CameraCalibration",
        recordings.DEPTH_CALIBRATION: "foxglove.CameraCalibration",
        recordings.DEPTH_IMAGE: "foxglove.RawImage",
        recordings.TRANSFORMS: "foxglove.FrameTransform",
    }
    for result, image in zip(results, depth, strict=True):
        millimetres = np.frombuffer(image.data, "<u2").reshape(image.height, image.width)
        known = result.valid & (result.depth_m < 65)
        assert np.abs(millimetres[known] / 1000 - result.depth_m[known]).max() < 6e-4


async def test_a_recording_is_a_source_with_opencv_axes(
    client: DepthClient, tmp_path: Path
) -> None:
    path = tmp_path / "walk.mcap"
    await recorded(client, path, axes=Axes.NED, delivery=Delivery.EVERY)
    source = open_source(f"mcap:{path}")
    assert isinstance(source, RecordedSource)
    assert not source.notes
    for ours, theirs in zip(source, room(), strict=True):
        assert ours.frame.capture_ns == theirs.frame.capture_ns
        np.testing.assert_array_equal(ours.frame.left, theirs.frame.left)
        assert ours.frame.pose is not None
        assert theirs.frame.pose is not None
        np.testing.assert_allclose(
            ours.frame.pose.world_from_left.matrix,
            theirs.frame.pose.world_from_left.matrix,
            atol=1e-8,  # the poses on disk have nine digits
        )


async def test_frames_without_an_answer_are_not_recorded(tmp_path: Path) -> None:
    async with scene() as quiet, quiet.open_session() as session:
        await step(session, 1)
        with session.record(tmp_path / "live.mcap") as recording:
            with pytest.raises(RuntimeError, match="close that recording first"):
                session.record(tmp_path / "other.mcap")
            for frame_id in range(2, 30):
                submit(session, frame_id)
            session.end()
            answered = [result.frame_id async for result in session]
    source = open_source(f"mcap:{tmp_path / 'live.mcap'}")
    assert len(source) == recording.frames == len(answered) + session.drops.unread
    assert "begins in the middle of a stream" in source.notes[0]


async def test_a_session_that_is_not_open_cannot_be_recorded(tmp_path: Path) -> None:
    async with scene() as quiet:
        session = quiet.open_session()
        with pytest.raises(NotOpen):
            session.record(tmp_path / "never.mcap")
    assert not (tmp_path / "never.mcap").exists()


async def test_a_file_that_cannot_be_written_leaves_the_session_alone(tmp_path: Path) -> None:
    async with scene() as quiet, quiet.open_session(Delivery.EVERY) as session:
        with pytest.raises(FileNotFoundError):
            session.record(tmp_path / "nowhere" / "walk.mcap")
        assert (await step(session, 1)).step_count == 1


async def test_the_command_records_a_source(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    console = Console(record=True, quiet=True)
    async with running_server(RecallModel()) as server:
        await record(
            [bundled_sample()],
            path,
            CalibrationFlags(),
            server=server.grpc_address,
            rate="max",
            frames=3,
            console=console,
        )
    assert len(open_source(f"mcap:{path}")) == 3


async def record_two_frames(path: Path) -> None:
    async with scene() as quiet, quiet.open_session(Delivery.EVERY) as session:
        with session.record(path):
            for frame_id in (1, 2):
                await step(session, frame_id)


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged") / "walk.mcap"


@pytest.fixture(scope="module")
def whole(damaged: Path) -> Path:
    path = damaged.with_name("whole.mcap")
    asyncio.run(record_two_frames(path))
    return path


@settings(max_examples=60, deadline=None)
@given(keep=st.floats(0, 1), at=st.floats(0, 0.999), byte=st.integers(0, 255))
@example(keep=0.5, at=0.0, byte=0)
@example(keep=1.0, at=0.3, byte=255)
def test_a_damaged_recording_is_refused_in_one_line_or_read(
    keep: float, at: float, byte: int, whole: Path, damaged: Path
) -> None:
    content = bytearray(whole.read_bytes())
    del content[int(len(content) * keep) :]
    if content:
        content[int(len(content) * at)] = byte
    damaged.write_bytes(content)
    message = str(damaged)
    try:
        for each in open_source(f"mcap:{damaged}"):
            assert each.frame.left.shape == (RIG.height, RIG.width, 3)
    except DatasetError as error:
        message = str(error)
    assert str(damaged) in message
    assert "\n" not in message


def test_an_mcap_of_something_else_is_named(tmp_path: Path) -> None:
    path = tmp_path / "lidar.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]  # mcap states no type here
    with pytest.raises(DatasetError, match="expected a recording of a session"):
        open_source(f"mcap:{path}")
    for content in (b"not an MCAP file", b"\x89MCAP0\r\n", b"\x89MCAP0\r\nabc"):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match="was cut or is damaged"):
            open_source(f"mcap:{path}")
