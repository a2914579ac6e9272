"""What `vergence run` takes for a source, and the calibration that comes with it."""

import json
from collections.abc import AsyncGenerator
from contextlib import aclosing
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.mjpeg_camera import mjpeg_camera
from tests.support.textured_wall import HEIGHT, WIDTH, write_pair, write_wall
from vergence.cli.errors import CliError
from vergence.cli.sources import CalibrationFlags, Footage, footage_at
from vergence_proto.calibration import write_rig
from vergence_proto.datasets import SourceFrame

NONE = CalibrationFlags()
METRES = CalibrationFlags(fx_px=200.0, baseline_m=0.1)


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    return write_wall(tmp_path / "wall", frames=3)


@pytest.fixture
def pair(tmp_path: Path) -> list[str]:
    folder = write_pair(tmp_path / "pair")
    return [str(folder / "left.png"), str(folder / "right.png")]


@pytest.fixture
def video(wall: Path, tmp_path: Path) -> Path:
    """The wall as a film of both views side by side."""
    path = tmp_path / "both.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (2 * WIDTH, HEIGHT))
    for index in range(3):
        views = [
            cv2.imread(str(wall / f"frame_{index:04d}_{side}.png")) for side in ("left", "right")
        ]
        writer.write(np.hstack(views))  # type: ignore[arg-type]  # both are there
    writer.release()
    return path


async def read(footage: Footage) -> list[SourceFrame]:
    frames: AsyncGenerator[tuple[int, SourceFrame], None] = footage.frames()
    async with aclosing(frames):
        return [frame async for _, frame in frames]


def test_a_folder_needs_no_kind(wall: Path) -> None:
    with_kind, without = (footage_at([text], NONE) for text in (f"vergence:{wall}", str(wall)))
    assert (with_kind.name, with_kind.count) == (without.name, without.count) == ("wall", 3)
    assert without.metric
    assert not without.has_depth  # its disparity can be converted by its own calibration


def test_two_images_without_a_calibration_have_no_metres(pair: list[str]) -> None:
    footage = footage_at(pair, NONE)
    assert footage.alone
    assert not footage.metric
    assert not footage.has_depth


def test_two_images_with_a_calibration_have_depth(pair: list[str]) -> None:
    footage = footage_at(pair, METRES)
    assert footage.has_depth
    rig = footage.rig.as_rectified()
    assert rig is not None
    assert (rig.fx, rig.cx_left, rig.cx_right) == (200, (WIDTH - 1) / 2, (WIDTH - 1) / 2)
    assert rig.baseline_m == pytest.approx(0.1)


def test_a_calibration_file_is_read_and_must_fit_the_images(
    pair: list[str], tmp_path: Path
) -> None:
    rig = footage_at(pair, METRES).rig
    write_rig(tmp_path / "rig.json", rig)
    found = footage_at(pair, CalibrationFlags(file=tmp_path / "rig.json"))
    assert found.rig.left == rig.left
    other = json.loads((tmp_path / "rig.json").read_text())
    text = json.dumps(other).replace(str(WIDTH), str(WIDTH + 2))
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(CliError, match=f"{WIDTH + 2}x{HEIGHT}, these are {WIDTH}x{HEIGHT}"):
        footage_at(pair, CalibrationFlags(file=tmp_path / "other.json"))


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (CalibrationFlags(fx_px=1.0), "both --fx PIXELS and --baseline METRES"),
        (CalibrationFlags(Path("f"), 1.0), "either --calib or --fx and --baseline"),
    ],
    ids=["half", "both"],
)
def test_flags_that_contradict_each_other_are_refused(
    pair: list[str], flags: CalibrationFlags, says: str
) -> None:
    with pytest.raises(CliError, match=says):
        footage_at(pair, flags)


def test_a_data_set_keeps_its_own_calibration(wall: Path) -> None:
    with pytest.raises(CliError, match="has a calibration of its own"):
        footage_at([str(wall)], METRES)


async def test_a_video_of_both_views_is_split(video: Path, wall: Path) -> None:
    for text in (f"camera:{video}", str(video)):
        footage = footage_at([text], METRES)
        assert (footage.name, footage.count, footage.fps) == ("both", 3, 25)
        assert (footage.live, footage.has_depth) == (False, True)
        frames = await read(footage)
        assert len(frames) == 3
        assert [each.frame.capture_ns for each in frames] == [0, 40_000_000, 80_000_000]
        for index, each in enumerate(frames):
            for side in ("left", "right"):
                expected = cv2.imread(str(wall / f"frame_{index:04d}_{side}.png"))
                assert expected is not None
                found = getattr(each.frame, side)[..., ::-1].astype(int)
                assert np.abs(found - expected).mean() < 12  # JPEG's loss on noise


async def test_a_camera_is_live_and_stamps_its_pictures() -> None:
    with mjpeg_camera(WIDTH, HEIGHT) as address:
        footage = footage_at([f"camera:{address}"], NONE)
        assert footage.live
        assert footage.count is None
        times_ns: list[int] = []
        async with aclosing(footage.frames()) as frames:
            async for _, each in frames:
                assert each.frame.left.shape == each.frame.right.shape == (HEIGHT, WIDTH, 3)
                times_ns.append(each.frame.capture_ns)
                if len(times_ns) == 3:
                    break
    assert times_ns == sorted(set(times_ns))


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["nowhere"], "no such file or folder; expected one of vergence:PATH"),
        (["TMP"], "no data set in a known layout"),
        (["TMP/a.zip"], "use vergence batch"),
        (["TMP/a.png"], "expected two images, LEFT and RIGHT"),
        (["TMP/a.png", "TMP/b.png"], "b.png: not found"),
        (["TMP/a.png"] * 3, "expected one source or two images, got 3"),
        (["camera:TMP/a.zip"], "cannot be opened; expected a video"),
        (["camera:TMP/none"], "cannot be opened; expected a camera"),
        (["camera:TMP/a.png"], "96x96: expected the left and the right view side by side"),
    ],
)
def test_what_is_no_source_is_reported(texts: list[str], says: str, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((96, 96, 3), np.uint8))
    (tmp_path / "a.zip").write_bytes(b"PK")
    with pytest.raises(CliError, match=says):
        footage_at([text.replace("TMP", str(tmp_path)) for text in texts], NONE)


def test_a_folder_of_several_sources_names_them(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_wall(tmp_path / name, frames=1)
    with pytest.raises(CliError, match=r"holds 2 sources; name one of them: vergence:.*one, .*two"):
        footage_at([str(tmp_path)], NONE)
