"""Films: what a browser plays, frame by frame as it was added."""

import sys
from pathlib import Path

import av
import numpy as np
import pytest

from vergence_proto import film
from vergence_proto.film import CannotFilm, FilmWriter

RED, BLUE = (220, 30, 30), (30, 30, 220)
BOXES = 8  # the number of a frame is the place of the red box in it


def picture(
    index: int, height: int = 48, width: int = 160
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    pixels = np.full((height, width, 3), BLUE, np.uint8)
    step = width // BOXES
    pixels[:, index * step : (index + 1) * step] = RED
    return pixels


@pytest.mark.parametrize("encoder", ["libx264", "libvpx-vp9"])
def test_browsers_play_it_and_no_frame_is_lost(
    encoder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film, "_ENCODERS", {encoder: film._ENCODERS[encoder]})  # noqa: SLF001
    path = tmp_path / "film.mp4"
    with FilmWriter(path, fps=29.97) as writer:
        for index in range(BOXES):
            writer.add(picture(index))
    with av.open(str(path)) as found:
        stream = found.streams.video[0]
        assert stream.codec_context.name in {"h264", "vp9", "libvpx-vp9"}
        assert (stream.codec_context.name == "h264") == (encoder == "libx264")
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == pytest.approx(29.97)
        frames = [frame.to_ndarray(format="rgb24") for frame in found.decode(video=0)]
    assert len(frames) == BOXES
    for index, frame in enumerate(frames):
        np.testing.assert_allclose(frame.astype(int), picture(index), atol=60)
        assert np.abs(frame.astype(int) - picture(index)).mean() < 6


def test_the_index_is_in_front_so_that_a_browser_can_start_at_once(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    with FilmWriter(path, fps=30) as writer:
        for index in range(BOXES):
            writer.add(picture(index))
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_an_odd_size_loses_its_last_row_and_column(tmp_path: Path) -> None:
    with FilmWriter(tmp_path / "film.mp4", fps=30) as writer:
        writer.add(picture(0, 49, 161))
    with av.open(str(tmp_path / "film.mp4")) as found:
        context = found.streams.video[0].codec_context
        assert (context.width, context.height) == (160, 48)


def test_a_film_without_frames_ends_too(tmp_path: Path) -> None:
    with FilmWriter(tmp_path / "film.mp4", fps=30):
        pass


def test_a_file_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    with pytest.raises(CannotFilm, match=r"cannot write the video .*none/film.mp4: No such file"):
        FilmWriter(tmp_path / "none" / "film.mp4", fps=30)


def test_what_is_missing_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "_ENCODERS", {"libnothing": {}})
    with pytest.raises(CannotFilm, match="none of the encoders libnothing"):
        FilmWriter(tmp_path / "film.mp4", fps=30)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(CannotFilm, match=r"PyAV.*pip install 'vergence\[cli\]'"):
        FilmWriter(tmp_path / "film.mp4", fps=30)
