"""nerfstudio: ``transforms.json`` beside ``images`` and ``depths`` (``ns-train ... --data DIR``).

Source: https://docs.nerf.studio/quickstart/data_conventions.html, and its Nerfstudio data parser,
whose ``depth_unit_scale_factor`` is 0.001.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vergence_proto.job_results.folders.base import About, File, PosedLayout, left_file, posed
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.jobs import JobOutput
from vergence_proto.result_files import encode_depth_mm_png

# Camera axes of OpenGL (x right, y up, z back) from those of OpenCV.
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Its pixel centres lie at halves, ours at integers.
_CENTRE_PX = 0.5


class NerfstudioLayout(PosedLayout):
    """Frames with poses, as nerfstudio reads them."""

    needs: ClassVar[Mapping[JobOutput, str]] = {
        JobOutput.LEFT: "the images of a nerfstudio data set"
    }

    def __init__(self, about: About) -> None:
        super().__init__(about)
        self._frames: list[dict[str, Any]] = []

    @property
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        return [
            {"path": "images/frame_%05d.*", "content": "the rectified left image"},
            {
                "path": "depths/frame_%05d.png",
                "content": "along the optical axis, metres",
                "type": "uint16",
                "scale": 1 / 1000,
                "no_value": 0,
            },
            {"path": "transforms.json", "content": "cameras; world_from_camera, OpenGL axes"},
        ]

    def _files(self, frame: JobFrame) -> Iterator[File]:
        assert frame.disparity is not None
        stem = f"frame_{frame.record.index:05d}"
        image = left_file(f"images/{stem}", frame)
        depth = File(f"depths/{stem}.png", encode_depth_mm_png(frame.disparity.depth_m))
        matrix = posed(frame.record).matrix @ _OPENCV_FROM_OPENGL
        self._frames.append(
            {
                "file_path": image.name,
                "depth_file_path": depth.name,
                "transform_matrix": matrix.tolist(),
            }
        )
        yield image
        yield depth

    def _last_files(self) -> Iterator[File]:
        rig = self.about.rig
        if rig is None:
            return
        cameras = {
            "camera_model": "OPENCV",
            "w": rig.width,
            "h": rig.height,
            "fl_x": rig.fx,
            "fl_y": rig.fy,
            "cx": rig.cx_left + _CENTRE_PX,
            "cy": rig.cy + _CENTRE_PX,
            **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
            "frames": self._frames,
        }
        yield File("transforms.json", json.dumps(cameras, indent=1).encode())
