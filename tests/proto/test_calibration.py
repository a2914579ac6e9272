"""Calibration files: a rig written as each tool writes it reads back as the same rig."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vergence_proto.calibration import load_calibration, write_rig
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Pose
from vergence_proto.types import Distortion, Intrinsics, StereoRig

Writer = Callable[[Path, StereoRig], list[Path]]


def camera(kind: Distortion, count: int, scale: float = 1.0) -> Intrinsics:
    coefficients = tuple(scale * 0.01 * (i + 1) for i in range(count))
    return Intrinsics(640, 400, 380.5, 381.25, 320.5, 199.75, kind, coefficients)


def rig_of(kind: Distortion, count: int) -> StereoRig:
    left_from_right = Pose.from_xyzw(np.array([0.01, -0.02, 0.005, 1]), np.array([0.11, 0.002, 0]))
    return StereoRig(camera(kind, count), camera(kind, count, 0.5), left_from_right)


RADTAN4 = rig_of(Distortion.BROWN_CONRADY, 4)
RADTAN5 = rig_of(Distortion.BROWN_CONRADY, 5)
RADTAN8 = rig_of(Distortion.BROWN_CONRADY, 8)
FISHEYE = rig_of(Distortion.KANNALA_BRANDT, 4)
PINHOLE = rig_of(Distortion.NONE, 0)


def saved(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8-sig")  # with a byte order mark, as some editors write
    return path


def as_own(folder: Path, rig: StereoRig) -> list[Path]:
    write_rig(folder / "rig.json", rig)
    return [folder / "rig.json"]


def as_kalibr(folder: Path, rig: StereoRig) -> list[Path]:
    models = {
        Distortion.BROWN_CONRADY: "radtan",
        Distortion.KANNALA_BRANDT: "equidistant",
        Distortion.NONE: "none",
    }

    def values(each: Intrinsics) -> dict[str, Any]:
        return {
            "camera_model": "pinhole",
            "intrinsics": [each.fx, each.fy, each.cx, each.cy],
            "distortion_model": models[each.distortion],
            "distortion_coeffs": list(each.coefficients),
            "resolution": [each.width, each.height],
            "rostopic": "/cam0/image_raw",
            "timeshift_cam_imu": -0.004,
        }

    right = {**values(rig.right), "T_cn_cnm1": rig.left_from_right.inverse().matrix.tolist()}
    text = yaml.safe_dump({"cam0": values(rig.left), "cam1": right})
    return [saved(folder / "camchain.yaml", text)]


def as_basalt(folder: Path, rig: StereoRig) -> list[Path]:
    imu_from_left = Pose.from_xyzw(np.array([0.1, 0.7, 0, 0.7]), np.array([0.01, 0.02, 0.03]))

    def place(pose: Pose) -> dict[str, float]:
        names = ("px", "py", "pz", "qx", "qy", "qz", "qw")
        return dict(zip(names, [*pose.translation_m, *pose.orientation_xyzw], strict=True))

    def lens(each: Intrinsics) -> dict[str, Any]:
        kind, names = {
            Distortion.BROWN_CONRADY: (
                "pinhole-radtan8",
                ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
            ),
            Distortion.KANNALA_BRANDT: ("kb4", ("k1", "k2", "k3", "k4")),
            Distortion.NONE: ("pinhole", ()),
        }[each.distortion]
        numbers = dict(zip(names, each.coefficients, strict=True))
        focal = {"fx": each.fx, "fy": each.fy, "cx": each.cx, "cy": each.cy}
        return {"camera_type": kind, "intrinsics": {**focal, **numbers}}

    values = {
        "T_imu_cam": [place(imu_from_left), place(imu_from_left @ rig.left_from_right)],
        "intrinsics": [lens(rig.left), lens(rig.right)],
        "resolution": [[rig.left.width, rig.left.height]] * 2,
        "cam_time_offset_ns": -4_000_000,
    }
    return [saved(folder / "calibration.json", json.dumps({"value0": values}))]


def as_monado(folder: Path, rig: StereoRig) -> list[Path]:
    def values(each: Intrinsics) -> dict[str, Any]:
        model, names = {
            (Distortion.BROWN_CONRADY, 5): ("pinhole_radtan5", ("k1", "k2", "p1", "p2", "k3")),
            (Distortion.KANNALA_BRANDT, 4): ("fisheye_equidistant4", ("k1", "k2", "k3", "k4")),
        }[each.distortion, len(each.coefficients)]
        return {
            "model": model,
            "intrinsics": {"fx": each.fx, "fy": each.fy, "cx": each.cx, "cy": each.cy},
            "distortion": dict(zip(names, each.coefficients, strict=True)),
            "resolution": {"width": each.width, "height": each.height},
        }

    right_from_left = rig.left_from_right.inverse()
    text = json.dumps(
        {
            "metadata": {"version": 2},
            "cameras": [values(rig.left), values(rig.right)],
            "opencv_stereo_calibrate": {
                "rotation": right_from_left.rotation.ravel().tolist(),
                "translation": right_from_left.translation_m.tolist(),
            },
        }
    )
    return [saved(folder / "calibration.json", text)]


def as_opencv(folder: Path, rig: StereoRig, suffix: str = "yml") -> list[Path]:
    right_from_left = rig.left_from_right.inverse()
    paths = [folder / f"intrinsics.{suffix}", folder / f"extrinsics.{suffix}"]
    storage = cv2.FileStorage(str(paths[0]), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", rig.left.width)
    storage.write("image_height", rig.left.height)
    for number, each in (("1", rig.left), ("2", rig.right)):
        coefficients = np.zeros(14)  # OpenCV pads them
        coefficients[: len(each.coefficients)] = each.coefficients
        storage.write(f"M{number}", each.matrix)
        storage.write(f"D{number}", coefficients[None])
    storage.release()
    storage = cv2.FileStorage(str(paths[1]), cv2.FILE_STORAGE_WRITE)
    storage.write("R", right_from_left.rotation)
    storage.write("T", right_from_left.translation_m[:, None])
    storage.release()
    return paths


def as_ros(folder: Path, rig: StereoRig) -> list[Path]:
    """As ``camera_calibration`` writes them, with R and P of cv2.stereoRectify."""
    right_from_left = rig.left_from_right.inverse()
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        rig.left.matrix,
        np.array(rig.left.coefficients),
        rig.right.matrix,
        np.array(rig.right.coefficients),
        (rig.left.width, rig.left.height),
        right_from_left.rotation,
        right_from_left.translation_m[:, None],
    )

    def matrix(values: np.ndarray) -> dict[str, Any]:
        return {"rows": len(values), "cols": values.shape[1], "data": values.ravel().tolist()}

    paths = []
    for name, each, r, p in (("left", rig.left, r1, p1), ("right", rig.right, r2, p2)):
        values = {
            "image_width": each.width,
            "image_height": each.height,
            "camera_name": name,
            "camera_matrix": matrix(each.matrix),
            "distortion_model": "plumb_bob",
            "distortion_coefficients": matrix(np.array([each.coefficients])),
            "rectification_matrix": matrix(r),
            "projection_matrix": matrix(p),
        }
        paths.append(saved(folder / f"{name}.yaml", yaml.safe_dump(values)))
    return paths


def as_euroc(folder: Path, rig: StereoRig) -> list[Path]:
    body_from_left = Pose.from_xyzw(np.array([0, 0, 0.7, 0.7]), np.array([-0.02, -0.06, 0.01]))
    models = {
        Distortion.BROWN_CONRADY: "radial-tangential",
        Distortion.KANNALA_BRANDT: "equidistant",
    }
    places = (body_from_left, body_from_left @ rig.left_from_right)
    paths = []
    for number, each, place in zip((0, 1), (rig.left, rig.right), places, strict=True):
        values = {
            "sensor_type": "camera",
            "T_BS": {"cols": 4, "rows": 4, "data": place.matrix.ravel().tolist()},
            "resolution": [each.width, each.height],
            "intrinsics": [each.fx, each.fy, each.cx, each.cy],
            "distortion_model": models[each.distortion],
            "distortion_coefficients": list(each.coefficients),
        }
        (folder / f"cam{number}").mkdir(exist_ok=True)
        paths.append(saved(folder / f"cam{number}" / "sensor.yaml", yaml.safe_dump(values)))
    return paths


WRITTEN = [
    *(pytest.param(as_own, rig, "vergence") for rig in (PINHOLE, RADTAN4, RADTAN8, FISHEYE)),
    *(pytest.param(as_kalibr, rig, "kalibr") for rig in (PINHOLE, RADTAN4, FISHEYE)),
    *(pytest.param(as_basalt, rig, "basalt") for rig in (PINHOLE, RADTAN8, FISHEYE)),
    *(pytest.param(as_monado, rig, "monado") for rig in (RADTAN5, FISHEYE)),
    *(pytest.param(as_opencv, rig, "opencv") for rig in (PINHOLE, RADTAN4, RADTAN5, RADTAN8)),
    *(pytest.param(as_ros, rig, "ros") for rig in (RADTAN4, RADTAN5)),
    *(pytest.param(as_euroc, rig, "euroc") for rig in (RADTAN4, FISHEYE)),
]


def assert_same_rig(read: StereoRig, expected: StereoRig) -> None:
    for each, other in ((read.left, expected.left), (read.right, expected.right)):
        assert (each.width, each.height) == (other.width, other.height)
        assert each.distortion is other.distortion
        np.testing.assert_allclose(each.matrix, other.matrix, rtol=1e-12)
        np.testing.assert_allclose(each.coefficients, other.coefficients, rtol=1e-12)
    np.testing.assert_allclose(
        read.left_from_right.matrix, expected.left_from_right.matrix, atol=1e-9
    )


@pytest.mark.parametrize(("write", "rig", "name"), WRITTEN)
def test_a_rig_reads_back(tmp_path: Path, write: Writer, rig: StereoRig, name: str) -> None:
    paths = write(tmp_path, rig)
    read = load_calibration(*paths)
    assert read.format == name
    assert_same_rig(read.rig, rig)
    assert_same_rig(StereoRig.load(*paths), rig)
    if name in ("kalibr", "basalt"):
        assert read.camera_time_offset_s == pytest.approx(-0.004)


@pytest.mark.parametrize("write", [as_euroc, as_ros, as_opencv])
def test_a_folder_with_both_files_is_enough(tmp_path: Path, write: Writer) -> None:
    write(tmp_path, RADTAN4)
    assert_same_rig(StereoRig.load(tmp_path), RADTAN4)


@pytest.mark.parametrize("suffix", ["xml", "json"])
def test_opencv_writes_xml_and_json_too(tmp_path: Path, suffix: str) -> None:
    assert_same_rig(StereoRig.load(*as_opencv(tmp_path, RADTAN5, suffix)), RADTAN5)


@given(
    focal=st.floats(50, 5000),
    shift=st.floats(-100, 100),
    baseline_m=st.floats(1e-3, 2),
    quaternion=st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_our_own_file_is_exact_to_the_bit(
    tmp_path: Path, focal: float, shift: float, baseline_m: float, quaternion: list[float]
) -> None:
    lens = Intrinsics(64, 48, focal, focal / 3, 32 + shift, 24.1, Distortion.NONE)
    pose = Pose.from_xyzw(np.array([*quaternion, 1]), np.array([baseline_m, 0.1, -0.2]))
    write_rig(tmp_path / "rig.json", StereoRig(lens, lens, pose))
    read = StereoRig.load(tmp_path / "rig.json")
    assert read.left == read.right == lens
    np.testing.assert_array_equal(read.left_from_right.matrix, pose.matrix)


def zeros(rig: StereoRig) -> StereoRig:
    lens = Intrinsics(
        640, 400, 380.0, 380.0, 320.0, 200.0, Distortion.BROWN_CONRADY, (0.0, 0.0, 0.0, 0.0, 0.0)
    )
    return StereoRig(lens, lens, Pose(np.eye(3), np.array([0.1, 0, 0])))


@pytest.mark.parametrize("write", [as_own, as_kalibr, as_monado, as_opencv, as_ros, as_euroc])
def test_distortion_of_zeros_is_none(tmp_path: Path, write: Writer) -> None:
    rig = zeros(RADTAN5)
    assert rig.as_rectified() is not None
    rectified = StereoRig.load(*write(tmp_path, rig)).as_rectified()
    assert rectified is not None
    assert rectified.baseline_m == pytest.approx(0.1)


def test_a_printed_message_is_a_camera_info_too(tmp_path: Path) -> None:
    def text(p3: float) -> str:
        return (
            "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\nheight: 400\n"
            "width: 640\ndistortion_model: plumb_bob\nd:\n- 0.0\n- 0.0\n- 0.0\n- 0.0\n- 0.0\n"
            "k: [380.0, 0.0, 320.0, 0.0, 380.0, 200.0, 0.0, 0.0, 1.0]\n"
            "r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
            f"p: [380.0, 0.0, 320.0, {p3}, 0.0, 380.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]\n---\n"
        )

    left, right = saved(tmp_path / "l.yaml", text(0.0)), saved(tmp_path / "r.yaml", text(-38.0))
    rectified = StereoRig.load(left, right).as_rectified()
    assert rectified is not None
    assert rectified.baseline_m == pytest.approx(0.1)
    with pytest.raises(BadCalibration, match="give the left camera's file first"):
        StereoRig.load(right, left)
    with pytest.raises(BadCalibration, match="one camera of two"):
        StereoRig.load(left)


def test_opencv_is_asked_for_what_it_does_not_say(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for number in "12":
        storage.write(f"K{number}", RADTAN5.left.matrix)
        storage.write(f"distCoeffs{number}", np.zeros((1, 5)))
    storage.write("R", np.eye(3))
    storage.write("T", np.array([[-110.0], [0], [0]]))
    storage.release()
    with pytest.raises(BadCalibration, match=r"size of the images.*size=\(640, 480\)"):
        StereoRig.load(path)
    with pytest.raises(BadCalibration, match=r"110 m is not plausible.*unit_m=0\.001"):
        StereoRig.load(path, size=(640, 400))
    rig = StereoRig.load(path, size=(640, 400), unit_m=0.001)
    np.testing.assert_allclose(rig.left_from_right.translation_m, [0.11, 0, 0])


def test_opencv_of_a_rectified_pair_has_projections_alone(tmp_path: Path) -> None:
    path = tmp_path / "rectified.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    projection = np.array([[380.0, 0, 320, 0], [0, 380, 200, 0], [0, 0, 1, 0]])
    storage.write("P1", projection)
    projection[0, 3] = -38.0
    storage.write("P2", projection)
    storage.release()
    rectified = StereoRig.load(path, size=(640, 400)).as_rectified()
    assert rectified is not None
    assert rectified.baseline_m == pytest.approx(0.1)


# Ten references to the line above in each line: 10 ** 8 values in 300 bytes.
NESTED = "".join(
    f"{name}: &{name} [{', '.join(10 * [f'*{above}'])}]\n"
    for above, name in itertools.pairwise("abcdefghi")
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "expected named values"),
        ("just a sentence", "expected named values"),
        ("a: 1\nb: 2\n", "expected a calibration of vergence, Kalibr"),
        ("{ broken", "neither YAML nor JSON"),
        ("a: [1, 2\nb: }", "neither YAML nor JSON"),
        ("%YAML:1.0\n---\nM1: 3\n", "size of the images"),
        ("cam0: 5\n", "cam0: expected named values"),
        ("cam0: {camera_model: ds}\ncam1: {}\n", "expected the camera_model pinhole, got 'ds'"),
        ("cam0: {camera_model: pinhole, distortion_model: fov}\ncam1: {}\n", "got 'fov'"),
        ('{"value0": {"intrinsics": []}}', "expected a list of at least 2"),
        ('{"format": "vergence-rig", "version": 99}', "newer version"),
        ('{"format": "vergence-rig", "version": 1}', "expected 'left'"),
        ("a: &a [1]\n" + NESTED + "cam0: *i\n", "got more than 262144 values"),
        ("a: &a {k: 1}\ncam0: {<<: *a}\n", "got a merge key <<"),
        ("cam0: &a [*a]\n", "got more than 262144 values"),
        ('<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "document type"),
        ("cam0: " + 5000 * "9", "neither YAML nor JSON"),
        ("cam0: 2026-99-99", "neither YAML nor JSON"),
        (5000 * "[", "neither YAML nor JSON"),
    ],
)
def test_a_bad_file_is_named_with_what_is_wrong(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "calibration"
    path.write_text(text)
    with pytest.raises(BadCalibration, match=expected) as raised:
        StereoRig.load(path)
    assert str(path) in str(raised.value)


def test_values_that_cannot_be_are_named_with_their_place(tmp_path: Path) -> None:
    (path,) = as_kalibr(tmp_path, RADTAN4)
    values = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    for key, value, expected in (
        ("intrinsics", [1.0, 2.0], "intrinsics: expected 4 numbers, got 2"),
        ("intrinsics", ["a", 1, 2, 3], "intrinsics: expected numbers"),
        ("resolution", [0, 400], "cam1.*sizes must be positive|cam1.*positive"),
        ("T_cn_cnm1", [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "orthonormal"),
        ("T_cn_cnm1", [[1, 0], [0, 1]], "4x4"),
    ):
        changed = {**values, "cam1": {**values["cam1"], key: value}}
        path.write_text(yaml.safe_dump(changed))
        with pytest.raises(BadCalibration, match=expected):
            StereoRig.load(path)


def test_a_missing_file_and_two_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadCalibration, match="not found"):
        StereoRig.load(tmp_path / "none.yaml")
    with pytest.raises(BadCalibration, match="folder with cam0"):
        StereoRig.load(tmp_path)
    (kalibr,), (own,) = as_kalibr(tmp_path, RADTAN4), as_own(tmp_path, RADTAN4)
    with pytest.raises(BadCalibration, match="two of one format"):
        StereoRig.load(kalibr, own)
