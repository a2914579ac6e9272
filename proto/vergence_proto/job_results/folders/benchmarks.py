"""Names and files of submissions to Middlebury (MiddEval3) and ETH3D (two-view).

Sources: the submission pages of https://vision.middlebury.edu/stereo/submit3/ and
https://www.eth3d.net/documentation. Disparity as PFM, infinite where there is no value, and the
time of a pair in seconds. A job is one scene; of several frames each has its number in the name.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from vergence_proto.datasets.images import encode_pfm
from vergence_proto.job_results.folders.base import About, File, Layout
from vergence_proto.job_results.frame_file import JobFrame

_METHOD = "Vergence"


class _SubmissionLayout(Layout):
    """One PFM and one time for each scene."""

    def __init__(self, about: About, disparity: str, time: str, time_text: str) -> None:
        super().__init__(about)
        self._disparity, self._time, self._time_text = disparity, time, time_text

    @property
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        return [
            {
                "path": self._disparity,
                "content": "u_left - u_right, pixels",
                "type": "float32",
                "scale": 1.0,
                "no_value": "inf",
            },
            {"path": self._time, "content": "seconds of a frame"},
        ]

    def _files(self, frame: JobFrame) -> Iterator[File]:
        assert frame.disparity is not None
        manifest = self.about.manifest
        path = str(manifest["source"]).partition(":")[2].partition("?")[0]
        scene = PurePosixPath(path).name or str(manifest.get("name") or "scene")
        if manifest["counts"]["frames"] > 1:
            scene = f"{scene}_{frame.record.index:04d}"
        yield File(self._disparity.format(scene), encode_pfm(frame.disparity.offset_px))
        seconds = 1 / fps if (fps := manifest["times"]["frames_per_s"]) else 0.0
        yield File(self._time.format(scene), self._time_text.format(seconds).encode())


def middlebury_layout(about: About) -> Layout:
    """Make the layout of MiddEval3: ``SCENE/disp0Vergence.pfm`` and ``timeVergence.txt``."""
    return _SubmissionLayout(
        about, f"{{}}/disp0{_METHOD}.pfm", f"{{}}/time{_METHOD}.txt", "{:.6f}\n"
    )


def eth3d_layout(about: About) -> Layout:
    """Make the layout of ETH3D: ``low_res_two_view/SCENE.pfm`` and ``SCENE.txt``."""
    return _SubmissionLayout(
        about, "low_res_two_view/{}.pfm", "low_res_two_view/{}.txt", "runtime {:.6f}\n"
    )
