"""Whatever is wrong in a SceneFlow tree, the error names the file and says what was expected."""

from pathlib import Path

import pytest

from tests.support import dataset_trees as trees
from tests.support.sources import Change, cut, opening

SCENEFLOW = [
    ("half a PFM", "disparity/TRAIN/A/0000/left/0007.pfm", cut, "0007.pfm: 24x16 needs 1536 bytes"),
    (
        "empty cameras",
        "camera_data/TRAIN/A/0000/camera_data.txt",
        lambda path: path.write_text("\n"),
        "camera_data.txt: expected blocks of 'Frame N', found none",
    ),
    (
        "half the cameras",
        "camera_data/TRAIN/A/0000/camera_data.txt",
        lambda path: path.write_text("Frame 1\nL 1 0 0\n"),
        "camera_data.txt: expected 'Frame N', 'L ...', 'R ...'",
    ),
    ("no right image", "frames_finalpass/TRAIN/A/0000/right/0008.png", Path.unlink, "not found"),
]


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [pytest.param(*case[1:], id=case[0]) for case in SCENEFLOW],
)
def test_sceneflow_names_the_file(file: str, change: Change, message: str, tmp_path: Path) -> None:
    folder = trees.sceneflow_sequence(tmp_path)
    change(tmp_path / file)
    said = opening(f"sceneflow:{folder}?fx=20")
    assert message in said
    assert str(tmp_path / file) in said


def test_sceneflow_asks_for_a_focal_length_it_cannot_know(tmp_path: Path) -> None:
    folder = trees.sceneflow_sequence(tmp_path)
    said = opening(f"sceneflow:{folder}")
    assert "24x16 are not SceneFlow's own, and no file states the focal length" in said
    assert f"add it: sceneflow:{folder}?fx=PIXELS" in said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[]", "expected a JSON object, got list"),
        ('{"fx": "wide"}', "expected a number for 'fx'"),
        ('{"fx": 20, "fps": 0}', "expected a positive fps"),
    ],
)
def test_sceneflow_names_intrinsics_it_cannot_use(text: str, message: str, tmp_path: Path) -> None:
    folder = trees.sceneflow_sequence(tmp_path)
    beside = tmp_path / "camera_data" / "TRAIN" / "A" / "0000" / "intrinsics.json"
    beside.write_text(text)
    said = opening(f"sceneflow:{folder}")
    assert message in said
    assert str(beside) in said


def test_sceneflow_is_known_by_its_passes(tmp_path: Path) -> None:
    assert "expected a sequence under frames_cleanpass or frames_finalpass" in opening(
        f"sceneflow:{tmp_path}?fx=20"
    )
