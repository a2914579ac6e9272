"""TUM RGB-D: ``rgb``, ``depth`` with 5000 steps per metre, and ``groundtruth.txt``.

Source: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. evo reads the trajectory.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vergence_proto.job_results.folders.base import About, File, Layout, left_png, numbers
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.jobs import JobOutput
from vergence_proto.opencv import cv2
from vergence_proto.types import Plane

_STEPS_PER_M = np.float32(5000)


class TumLayout(Layout):
    """Colour, depth and trajectory with times in seconds."""

    needs: ClassVar[Mapping[JobOutput, str]] = {
        JobOutput.LEFT: "the images of a TUM RGB-D sequence"
    }

    def __init__(self, about: About) -> None:
        super().__init__(about)
        self._times: list[str] = []
        self._poses: list[str] = []

    @property
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        return [
            {"path": "rgb/SECONDS.png", "content": "the rectified left image"},
            {
                "path": "depth/SECONDS.png",
                "content": "along the optical axis, metres; beyond 13.1 m there is no value",
                "type": "uint16",
                "scale": 1 / 5000,
                "no_value": 0,
            },
            {"path": "groundtruth.txt", "content": "world_from_left: t x y z qx qy qz qw, OpenCV"},
        ]

    def _files(self, frame: JobFrame) -> Iterator[File]:
        assert frame.disparity is not None
        record = frame.record
        stamp = f"{record.capture_ns // 10**9}.{record.capture_ns % 10**9:09d}"
        self._times.append(stamp)
        if (pose := record.world_from_left) is not None:
            values = numbers([*pose.translation_m, *pose.orientation_xyzw])
            self._poses.append(f"{stamp} {values}\n")
        yield File(f"rgb/{stamp}.png", left_png(frame))
        yield File(f"depth/{stamp}.png", _depth_png(frame.disparity.depth_m))

    def _last_files(self) -> Iterator[File]:
        for name, what in (("rgb", "color images"), ("depth", "depth maps")):
            lines = [f"{stamp} {name}/{stamp}.png\n" for stamp in self._times]
            yield File(f"{name}.txt", "".join([f"# {what}\n", *lines]).encode())
        header = "# timestamp tx ty tz qx qy qz qw\n"
        yield File("groundtruth.txt", "".join([header, *self._poses]).encode())


def _depth_png(depth_m: Plane) -> bytes:
    stored = np.rint(np.nan_to_num(depth_m) * _STEPS_PER_M)
    stored[stored > np.iinfo(np.uint16).max] = 0
    return cv2.imencode(".png", stored.astype(np.uint16))[1].tobytes()
