"""COLMAP: a sparse model as text, the images, and depth maps of a dense workspace.

Source: https://colmap.github.io/format.html, and ``scripts/python/read_write_dense.py`` of COLMAP.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vergence_proto.job_results.folders.base import (
    About,
    File,
    PosedLayout,
    left_file,
    numbers,
    posed,
)
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.jobs import JobOutput

_CENTRE_PX = 0.5  # its pixel centres lie at halves, ours at integers


class ColmapLayout(PosedLayout):
    """Frames with poses, as COLMAP and pycolmap read them."""

    needs: ClassVar[Mapping[JobOutput, str]] = {JobOutput.LEFT: "the images of a COLMAP model"}

    def __init__(self, about: About) -> None:
        super().__init__(about)
        self._images: list[str] = []

    @property
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        return [
            {"path": "images/%06d.*", "content": "the rectified left image"},
            {
                "path": "stereo/depth_maps/IMAGE.geometric.bin",
                "content": "along the optical axis, metres",
                "type": "float32",
                "scale": 1.0,
                "no_value": 0,
            },
            {"path": "sparse/0/*.txt", "content": "cameras; camera_from_world, OpenCV axes"},
        ]

    def _files(self, frame: JobFrame) -> Iterator[File]:
        assert frame.disparity is not None
        image = left_file(f"images/{frame.record.index:06d}", frame)
        name = image.name.removeprefix("images/")
        left_from_world = posed(frame.record).inverse()
        x, y, z, w = left_from_world.orientation_xyzw
        pose = numbers([w, x, y, z, *left_from_world.translation_m])
        self._images.append(f"{len(self._images) + 1} {pose} 1 {name}\n\n")
        yield image
        depth_m = np.nan_to_num(frame.disparity.depth_m).astype("<f4")
        height, width = depth_m.shape
        yield File(
            f"stereo/depth_maps/{name}.geometric.bin",
            f"{width}&{height}&1&".encode() + depth_m.tobytes(),
        )

    def _last_files(self) -> Iterator[File]:
        rig = self.about.rig
        if rig is None:
            return
        intrinsics = [rig.fx, rig.fy, rig.cx_left + _CENTRE_PX, rig.cy + _CENTRE_PX]
        camera = f"1 PINHOLE {rig.width} {rig.height} {numbers(intrinsics)}\n"
        yield File("sparse/0/cameras.txt", camera.encode())
        yield File("sparse/0/images.txt", "".join(self._images).encode())
        yield File("sparse/0/points3D.txt", b"")
