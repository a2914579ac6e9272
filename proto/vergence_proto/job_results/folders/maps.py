"""Maps as PNG, PFM or NPZ, one folder for each kind: the layout of ``vergence run``."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.job_results.folders.base import About, File, Layout, image_suffix
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.job_results.points import encode_ply
from vergence_proto.jobs import JobOutput, Output, ResultFormat
from vergence_proto.result_files import encode_depth_mm_png, encode_maps
from vergence_proto.types import DisparityMap

_MAPS: Mapping[Output, Callable[[DisparityMap], NDArray[Any] | None]] = {
    Output.DISPARITY: lambda each: each.offset_px,
    Output.DEPTH: lambda each: each.depth_m,
    Output.CONFIDENCE: lambda each: each.confidence,
    Output.SIGMA: lambda each: each.sigma_px,
}
_MEANINGS = {
    Output.DISPARITY: "u_left - u_right, pixels",
    Output.DEPTH: "along the optical axis, metres",
    Output.SIGMA: "expected absolute error of the disparity, pixels",
}


class MapLayout(Layout):
    """One file per frame and map."""

    def __init__(self, about: About, form: ResultFormat) -> None:
        super().__init__(about)
        self._form = form

    @classmethod
    def of(cls, form: ResultFormat) -> Callable[[About], Layout]:
        """Return what makes the layout with maps in this format."""
        return lambda about: cls(about, form)

    @property
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        return [*map(self._kind, self._outputs()), *self._other_kinds()]

    def _outputs(self) -> list[Output]:
        return [each for each in _MAPS if JobOutput(each.value) in self.about.outputs]

    def _kind(self, output: Output) -> Mapping[str, Any]:
        npz = self._form is ResultFormat.NPZ
        array: dict[str, Any] = {"array": output.value} if npz else {}
        path = "%04d.npz" if npz else f"{output.value}/%04d.png"
        if output is Output.CONFIDENCE:
            meaning = "probability of an error below 1 px"
            return {"path": path, **array, "content": meaning, "type": "uint8", "scale": 1 / 255}
        about = {"content": _MEANINGS[output], "scale": 1.0, "type": "float32", "no_value": "NaN"}
        if npz:
            return {"path": path, **array, **about}
        if self._form is ResultFormat.PFM:
            return {"path": f"{output.value}/%04d.pfm", **about, "no_value": "inf"}
        mm = output is Output.DEPTH and self._form is ResultFormat.PNG16MM
        scale = 1 / 1000 if mm else 1 / 256
        return {"path": path, **about, "type": "uint16", "scale": scale, "no_value": 0}

    def _other_kinds(self) -> Iterator[Mapping[str, Any]]:
        if JobOutput.LEFT in self.about.outputs:
            yield {"path": "left/%04d.*", "content": "the rectified left image"}
        if JobOutput.POINTS in self.about.outputs:
            yield {
                "path": "points/%04d.ply",
                "content": "coloured points in the world, or in the camera without a pose, metres",
                "axes": "OPENCV",
            }

    def _files(self, frame: JobFrame) -> Iterator[File]:
        assert frame.disparity is not None
        stem = f"{frame.record.index:04d}"
        found = ((output, _MAPS[output](frame.disparity)) for output in self._outputs())
        maps = {output: map_ for output, map_ in found if map_ is not None}
        form = ResultFormat.PNG16 if self._form is ResultFormat.PNG16MM else self._form
        if self._form is ResultFormat.PNG16MM and Output.DEPTH in maps:
            depth_m = np.asarray(maps.pop(Output.DEPTH), np.float32)
            yield File(f"depth/{stem}.png", encode_depth_mm_png(depth_m))
        for file in encode_maps(maps, form) if maps else ():
            folder = "" if file.output is None else f"{file.output}/"
            yield File(f"{folder}{stem}{file.suffix}", file.content)
        if frame.left is not None and JobOutput.LEFT in self.about.outputs:
            yield File(f"left/{stem}{image_suffix(frame.left)}", frame.left)
        if JobOutput.POINTS in self.about.outputs:
            yield File(f"points/{stem}.ply", encode_ply(frame))
