"""``vergence calib``: what a calibration file says, and the same rig in our own format."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from vergence.cli.app import app
from vergence.cli.errors import CliError
from vergence_proto.errors import BadCalibration
from vergence_proto.types import StereoRig

KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.7, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  timeshift_cam_imu: -0.0021
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
"""


def test_a_calibration_is_shown_and_written(tmp_path: Path) -> None:
    path, out = tmp_path / "camchain.yaml", tmp_path / "rig.json"
    path.write_text(KALIBR)
    shown = CliRunner().invoke(app, ["calib", str(path), "--out", str(out)])
    assert shown.exit_code == 0, shown.output
    for words in ("kalibr", "752x480", "110.0 mm", "no: the server rectifies", "-2.10 ms"):
        assert words in shown.output
    assert StereoRig.load(out).left == StereoRig.load(path).left


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (["none.yaml"], BadCalibration, "not found"),
        (["none.yaml", "--size", "640"], CliError, "WIDTHxHEIGHT, as 640x480"),
    ],
)
def test_a_mistake_is_one_sentence(
    arguments: list[str], error: type[Exception], words: str
) -> None:
    ended = CliRunner().invoke(app, ["calib", *arguments])
    assert isinstance(ended.exception, error)
    assert words in str(ended.exception)
