"""Pictures of disparity: colours by value, scales that fit, files that can be read back."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from vergence.cli.pictures import ERROR_SCALE, Row, Scale, Video, disparity_scale, sheet
from vergence_proto.geometry import RectifiedRig

HEIGHT, WIDTH = 60, 80
SCALE = Scale("disparity", 32.0, cv2.COLORMAP_TURBO)


def make_row(*, with_truth: bool, offset_px: float = 0.0, sigma_px: float | None = None) -> Row:
    disparity_px = np.tile(np.linspace(1, 30, WIDTH, dtype=np.float32), (HEIGHT, 1))
    left = np.full((HEIGHT, WIDTH, 3), (200, 20, 20), np.uint8)
    truth_px = disparity_px + np.float32(offset_px) if with_truth else None
    sigma = None if sigma_px is None else np.full((HEIGHT, WIDTH), sigma_px, np.float32)
    return Row("frame 0", left, disparity_px, truth_px, sigma)


def test_no_value_has_a_colour_of_its_own() -> None:
    values = np.array([[0.0, 16.0, 32.0, np.nan]], np.float32)
    colours = SCALE.paint(values)[0]
    assert len({tuple(colour) for colour in colours}) == 4
    every_level = np.linspace(0, 32, 1000, dtype=np.float32)[None]
    assert not (SCALE.paint(every_level) == colours[3]).all(axis=2).any()


def test_what_is_above_the_scale_takes_its_last_colour() -> None:
    top, above, infinite = SCALE.paint(np.array([[32.0, 1e6, np.inf]], np.float32))[0]
    np.testing.assert_array_equal(above, top)
    assert infinite.shape == (3,)


def test_the_scale_holds_the_scene_and_not_its_outliers() -> None:
    plane = np.full((100, 100), 20.0, np.float32)
    plane[0, 0] = 500.0
    plane[1, 1] = np.nan
    assert disparity_scale(plane).top_px == 32
    assert disparity_scale(np.full((4, 4), np.nan, np.float32)).top_px > 0


def test_a_right_frame_is_dark_in_the_error_panel_and_a_wrong_one_bright() -> None:
    right = make_row(with_truth=True).panels(SCALE)[2].picture
    wrong = make_row(with_truth=True, offset_px=5.0).panels(SCALE)[2].picture
    assert right.max() < 30 < wrong.mean()


def test_a_missing_answer_is_an_error_where_there_is_truth() -> None:
    row = make_row(with_truth=True)
    row.disparity_px[:] = np.nan
    expected = ERROR_SCALE.paint(np.abs(make_row(with_truth=False).disparity_px))
    np.testing.assert_array_equal(row.panels(SCALE)[2].picture, expected)


def test_sparse_truth_is_enlarged_until_it_can_be_seen() -> None:
    row = make_row(with_truth=True, offset_px=5.0)
    assert row.truth_px is not None
    row.truth_px[np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 997 > 0] = np.nan
    unknown = ERROR_SCALE.paint(np.full((1, 1), np.nan, np.float32))[0, 0]
    painted = (row.panels(SCALE)[2].picture != unknown).any(axis=2)
    assert painted.mean() > 0.1  # of what is known in one pixel of a thousand


@pytest.mark.parametrize("with_truth", [True, False], ids=["truth", "no-truth"])
def test_a_sheet_shows_every_row_in_red_for_a_red_room(with_truth: bool) -> None:
    one, three = (
        sheet("a room", [make_row(with_truth=with_truth)] * rows, panel_width=80) for rows in (1, 3)
    )
    assert three.shape[1] == one.shape[1]
    assert three.shape[0] - one.shape[0] == 2 * (HEIGHT + 30)
    red = (three == (20, 20, 200)).all(axis=2)  # BGR
    assert red.sum() == 3 * HEIGHT * WIDTH


def test_a_video_has_every_frame(tmp_path: Path) -> None:
    row = make_row(with_truth=True)
    with Video(tmp_path / "room.mp4", row, title="a room", fps=30) as video:
        for _ in range(5):
            video.add(row)
    film = cv2.VideoCapture(str(tmp_path / "room.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 5
    assert film.get(cv2.CAP_PROP_FPS) == 30


def test_a_video_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="cannot write the video"):
        Video(tmp_path / "missing" / "room.mp4", make_row(with_truth=True), title="", fps=30)


def test_sigma_has_the_colour_of_an_error_of_its_size() -> None:
    row = make_row(with_truth=True, offset_px=2.0, sigma_px=2.0)
    *_, error, sigma = row.panels(SCALE)
    assert (error.name, sigma.name) == ("error", "sigma")
    np.testing.assert_array_equal(error.picture, sigma.picture)


def test_a_scale_in_metres_has_the_depth_of_its_disparity() -> None:
    rig = RectifiedRig(WIDTH, HEIGHT, 100, 100, 40, 44, 30, 0.16)
    disparity_px = np.full((4, 4), 16.0, np.float32)
    scale = disparity_scale(disparity_px, rig)
    assert scale.depth_m is not None
    # Principal points that are 4 px apart: an offset of 4 px in the images is 8 px of disparity.
    assert scale.depth_m(4.0) == pytest.approx(100 * 0.16 / 8)
    assert np.isinf(scale.depth_m(-4.0))
    plain = disparity_scale(disparity_px)
    assert (scale.bar(200) != plain.bar(200)).any()
