"""The folder of the results of ``vergence run`` or of one sequence of ``vergence batch``."""

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence.cli.errors import CliError
from vergence.filters import keep_confident, keep_range, without_speckles
from vergence.results import DepthResult
from vergence_proto.datasets import beyond_png
from vergence_proto.geometry import RectifiedRig
from vergence_proto.jobs import Output, ResultFormat
from vergence_proto.result_files import encode_maps
from vergence_proto.types import DisparityMap

RIG = "rig.json"
_SHEET = "sheet.png"
_PAIR_NAMES = {Output.DISPARITY: "disp"}
_RESULT = re.compile(r"(\d{4,}|disp|depth|confidence|sigma)\.(png|pfm|npz)")


def make_room(folder: Path) -> None:
    """Make a folder that holds no results of an earlier run.

    Results are known by the file ``rig.json`` beside them. Raises CliError: without it, the folder
    holds files with the names of results, which may be somebody's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    earlier = list(_results_in(folder))
    if earlier and not (folder / RIG).is_file():
        raise CliError(
            f"{folder} holds {earlier[0].relative_to(folder)}, which a result would replace; name "
            "another folder with --out",
            exit_code=2,
        )
    for path in earlier:
        path.unlink()
    for name in (_SHEET, RIG) if earlier else ():
        (folder / name).unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class KeptValues:
    """Which values of a result are written; the others have none in the files."""

    min_confidence: int = 0
    min_depth_m: float = 0.0
    max_depth_m: float = math.inf
    speckle_px: int = 0
    """The size of the largest region that is left out as a speckle."""

    @property
    def limits_depth(self) -> bool:
        """True if a depth is too near or too far to be written."""
        return (self.min_depth_m, self.max_depth_m) != (0.0, math.inf)

    def of(self, result: DepthResult) -> DepthResult:
        """Return the result with only these values."""
        if self.min_confidence:
            result = keep_confident(result, self.min_confidence)
        if self.limits_depth:
            result = keep_range(result, self.min_depth_m, self.max_depth_m)
        return without_speckles(result, self.speckle_px) if self.speckle_px else result


@dataclass(frozen=True, slots=True)
class Files:
    """What is written of each frame."""

    outputs: Sequence[Output] = ()
    """The maps; none: disparity, and depth of images and cameras calibrated on the command line."""
    form: ResultFormat = ResultFormat.PNG16
    kept: KeptValues = KeptValues()


class ResultFolder:
    """Writes the maps of each frame, and the rig that they belong to."""

    def __init__(
        self, folder: Path, *, outputs: Sequence[Output], form: ResultFormat, alone: bool
    ) -> None:
        self.folder = folder
        self.beyond: int = 0
        """Pixels whose disparity or depth does not fit a 16-bit PNG, until now."""
        self._outputs = outputs
        self._form = form
        self._alone = alone

    def begin(self, rig: RectifiedRig) -> None:
        """Write the rectified rig, and make the folders of other maps than disparity."""
        (self.folder / RIG).write_text(json.dumps(dataclasses.asdict(rig), indent=1), "utf-8")
        if not self._alone and self._form is not ResultFormat.NPZ:
            for output in self._outputs:
                if output is not Output.DISPARITY:
                    (self.folder / output).mkdir(exist_ok=True)

    def write(self, index: int, result: DisparityMap) -> None:
        """Write the maps of one frame: ``0000.png``, ``sigma/0000.png``; of a pair ``disp.png``."""
        maps = {output: np.asarray(_map(result, output)) for output in self._outputs}
        if self._form is ResultFormat.PNG16:
            limited = (maps[each] for each in (Output.DISPARITY, Output.DEPTH) if each in maps)
            self.beyond += sum(int(np.count_nonzero(beyond_png(map_))) for map_ in limited)
        for file in encode_maps(maps, self._form):
            (self.folder / f"{self._stem(index, file.output)}{file.suffix}").write_bytes(
                file.content
            )

    def _stem(self, index: int, output: Output | None) -> str:
        if self._alone:
            return "disp" if output is None else _PAIR_NAMES.get(output, output)
        if output in (None, Output.DISPARITY):
            return f"{index:04d}"
        return f"{output}/{index:04d}"


def _map(result: DisparityMap, output: Output) -> NDArray[Any] | None:
    match output:
        case Output.DISPARITY:
            return result.offset_px
        case Output.DEPTH:
            return result.depth_m
        case Output.CONFIDENCE:
            return result.confidence
        case Output.SIGMA:
            return result.sigma_px


def _results_in(folder: Path) -> Iterator[Path]:
    for each in (folder, *(folder / output for output in Output)):
        if each.is_dir():
            yield from (path for path in sorted(each.iterdir()) if _RESULT.fullmatch(path.name))
