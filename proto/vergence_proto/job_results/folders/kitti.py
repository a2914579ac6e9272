"""KITTI: ``disp_0`` as its stereo benchmark wants it, with poses and times as in its odometry.

Source: the development kits of KITTI stereo 2015 and odometry. Frames without a pose have no row in
``poses.txt``; ``frames.jsonl`` lists them.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from vergence_proto.datasets.images import encode_disparity_png
from vergence_proto.job_results.folders.base import About, File, Layout, image_suffix, numbers
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.jobs import JobOutput


class KittiLayout(Layout):
    """Disparity as 16-bit PNG, times 256."""

    def __init__(self, about: About) -> None:
        super().__init__(about)
        self._poses: list[str] = []
        self._times: list[str] = []

    @property
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        return [
            {
                "path": "disp_0/%06d_10.png",
                "content": "u_left - u_right, pixels",
                "type": "uint16",
                "scale": 1 / 256,
                "no_value": 0,
            },
            {"path": "poses.txt", "content": "world_from_left, 3x4, row by row, OpenCV axes"},
            {"path": "times.txt", "content": "seconds, of the rows of poses.txt"},
            {"path": "calib.txt", "content": "P2 and P3: projections of the rectified cameras"},
        ]

    def _files(self, frame: JobFrame) -> Iterator[File]:
        assert frame.disparity is not None
        record = frame.record
        if record.world_from_left is not None:
            self._poses.append(numbers(record.world_from_left.matrix[:3].ravel()) + "\n")
            self._times.append(f"{record.capture_ns / 1e9:.9e}\n")
        offset_png = encode_disparity_png(frame.disparity.offset_px)
        yield File(f"disp_0/{record.index:06d}_10.png", offset_png)
        if frame.left is not None and JobOutput.LEFT in self.about.outputs:
            yield File(f"image_2/{record.index:06d}{image_suffix(frame.left)}", frame.left)

    def _last_files(self) -> Iterator[File]:
        yield File("poses.txt", "".join(self._poses).encode())
        yield File("times.txt", "".join(self._times).encode())
        if (rig := self.about.rig) is not None:
            left = [rig.fx, 0, rig.cx_left, 0, 0, rig.fy, rig.cy, 0, 0, 0, 1, 0]
            right = [*left]
            right[2], right[3] = rig.cx_right, -rig.fx * rig.baseline_m
            lines = [f"P2: {numbers(left)}\n", f"P3: {numbers(right)}\n"]
            yield File("calib.txt", "".join(lines).encode())
