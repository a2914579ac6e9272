"""Reading of a calibration file of any known format."""

from pathlib import Path

from vergence_proto.calibration import basalt, euroc, kalibr, monado, opencv, own, ros
from vergence_proto.calibration.fields import read_fields
from vergence_proto.calibration.parts import Calibration, Fields
from vergence_proto.errors import BadCalibration

_PAIRS = (
    # What a folder may hold, left and right.
    ("cam0/sensor.yaml", "cam1/sensor.yaml"),
    ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml"),
    ("left.yaml", "right.yaml"),
    ("left.yml", "right.yml"),
    ("intrinsics.yml", "extrinsics.yml"),
)


def load_calibration(
    path: Path | str,
    right: Path | str | None = None,
    *,
    size: tuple[int, int] | None = None,
    unit_m: float = 1.0,
) -> Calibration:
    """Read a stereo rig from the file of a calibration tool; the format is recognised.

    Parameters
    ----------
    path
        The file; or the left camera's, where each camera has its own; or a folder that holds both
        under their usual names.
    right
        The right camera's file; or OpenCV's extrinsics, where ``path`` has the intrinsics.
    size
        Width and height of the images in pixels, for files that do not state them.
    unit_m
        Metres in a unit of length of the file, for OpenCV's (0.001: millimetres).

    Raises
    ------
    BadCalibration
        There is no such file, its format is not known, or a value is missing or wrong.
    """
    first, second = Path(path), None if right is None else Path(right)
    if first.is_dir() and second is None:
        first, second = _in_folder(first)
    files = [read_fields(each) for each in (first, second) if each is not None]
    kinds = [_kind(file) for file in files]
    match kinds:
        case ["ros", "ros"]:
            return ros.read(*files)
        case ["euroc", "euroc"]:
            return euroc.read(*files)
        case ["ros" | "euroc"]:
            raise BadCalibration(
                f"{first}: this is one camera of two; give the right camera's file too"
            )
        case ["opencv", *_]:
            values = {key: value for file in files for key, value in file.values.items()}
            return opencv.read(Fields(files[0].where, values), size, unit_m)
        case ["vergence" | "kalibr" | "basalt" | "monado" as kind]:
            readers = {
                "vergence": own.read,
                "kalibr": kalibr.read,
                "basalt": basalt.read,
                "monado": monado.read,
            }
            return readers[kind](files[0])
        case [None, *_] | [_, None]:
            file = files[kinds.index(None)]
            found = ", ".join(map(str, file.values))[:200] or "an empty file"
            raise BadCalibration(
                f"{file.where}: expected a calibration of vergence, Kalibr, Basalt, Monado, "
                f"OpenCV, ROS or EuRoC, got {found}"
            )
    raise BadCalibration(
        f"{second}: expected one file, or two of one format; got {kinds[0]} and {kinds[1]}"
    )


def _kind(file: Fields) -> str | None:
    values = file.values
    checks = {
        "vergence": values.get("format") == own.FORMAT,
        "kalibr": "cam0" in values,
        "basalt": "value0" in values,
        "monado": "opencv_stereo_calibrate" in values,
        "euroc": euroc.is_sensor(file),
        "ros": ros.is_camera_info(file),
        "opencv": opencv.has_matrices(values) or ("R" in values and "T" in values),
    }
    return next((kind for kind, found in checks.items() if found), None)


def _in_folder(folder: Path) -> tuple[Path, Path]:
    for left, right in _PAIRS:
        if (folder / left).is_file() and (folder / right).is_file():
            return folder / left, folder / right
    raise BadCalibration(
        f"{folder}: expected a calibration file, or a folder with "
        f"{', '.join(' and '.join(pair) for pair in _PAIRS)}"
    )
