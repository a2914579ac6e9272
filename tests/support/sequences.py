"""Sequences as people upload them: folders in the project's layout, zips, tars and forms."""

import io
import json
import struct
import tarfile
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from tests.support.frames import FRAME_NS, RIG, make_frame
from vergence_proto.types import StereoFrame

CALIBRATION = {
    "width": RIG.width,
    "height": RIG.height,
    "fx": RIG.fx,
    "fy": RIG.fy,
    "cx": RIG.cx_left,
    "cy": RIG.cy,
    "baseline_m": RIG.baseline_m,
    "fps": 1e9 / FRAME_NS,
}


def make_frames(count: int, *, brightness: int = 40) -> list[StereoFrame]:
    return [make_frame(i, brightness=brightness + i) for i in range(1, count + 1)]


def png(image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> bytes:
    done, file = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert done
    return file.tobytes()


def pose_numbers(frame: StereoFrame) -> list[float]:
    assert frame.pose is not None
    numbers: list[float] = frame.pose.world_from_left.matrix[:3].ravel().tolist()
    return numbers


def sequence_files(frames: Iterable[StereoFrame]) -> Iterator[tuple[str, bytes]]:
    """Names and contents in the project's own layout; truth is a wall at 8 px."""
    poses = []
    for index, frame in enumerate(frames):
        yield f"frame_{index:04d}_left.png", png(frame.left)
        yield f"frame_{index:04d}_right.png", png(frame.right)
        truth = io.BytesIO()
        np.savez(truth, disp=np.full(frame.left.shape[:2], 64 * 8, np.uint16))
        yield f"frame_{index:04d}_gt.npz", truth.getvalue()
        poses.append(" ".join(map(repr, pose_numbers(frame))))
    yield "poses.txt", "\n".join(poses).encode()
    yield "calib.json", json.dumps(CALIBRATION).encode()


def zip_bytes(files: Iterable[tuple[str, bytes]], *, compressed: bool = False) -> bytes:
    archive = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(archive, "w", kind) as file:
        for name, content in files:
            file.writestr(name, content)
    return archive.getvalue()


def tar_bytes(files: Iterable[tuple[str, bytes]], mode: str = "w:gz") -> bytes:
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode=mode) as file:  # type: ignore[call-overload] # a choice
        for name, content in files:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            file.addfile(info, io.BytesIO(content))
    return archive.getvalue()


def write_sequence(folder: Path, frames: Iterable[StereoFrame]) -> Path:
    folder.mkdir(parents=True)
    for name, content in sequence_files(frames):
        (folder / name).write_bytes(content)
    return folder


def with_size(file: bytes, width: int, height: int) -> bytes:
    """A PNG whose header states another size."""
    return file[:16] + struct.pack(">II", width, height) + file[24:]
