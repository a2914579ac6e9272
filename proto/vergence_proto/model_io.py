"""The contract between whoever exports a network and whoever serves it.

A model is a set of ONNX graphs over the same weights, and a manifest that describes them. One
step of the recurrence, for a batch of streams, runs the graphs of its iteration count in stages.
The graphs of a stage do not need each other and may run side by side; each takes, by name, what
the caller gives or what a graph of an earlier stage gave. Any graph may give an output of the
model, and no two graphs of a count give the same name. Most models have a single graph per count:
one stage of one graph. A model may start a stream in another way than it goes on: cold graphs take
the place of the others where there is no state, at the counts that they are there for, in images
that are not too large for them.

Inputs:

- ``left``, ``right``: uint8 [B, H, W, 3], rectified RGB; H and W as :meth:`ModelCard.step_size`.
- ``uvd_curr_from_prev``: float32 [B, 4, 4], pixels of the previous frame to pixels of this one;
  see :func:`vergence_proto.geometry.uvd_curr_from_prev`.
- ``prev_<tensor>``: float32 [B, C, h, w], the state the previous step left; zeros on a cold start.

Outputs:

- ``disparity``: float32 [B, H, W], the pixel offset u_left - u_right, in full-resolution pixels.
- ``sigma``: float32 [B, H, W], its expected absolute error, in pixels.
- ``next_<tensor>``: float32 [B, C, h, w], the state for the next step.

Pixel centres sit at integer coordinates. The matched quantity is the raw pixel offset, also where
the two principal points differ: the transform carries that difference.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from vergence_proto.types import Image

LEFT = "left"
RIGHT = "right"
UVD_CURR_FROM_PREV = "uvd_curr_from_prev"
DISPARITY = "disparity"
SIGMA = "sigma"

MANIFEST_NAME = "manifest.json"
MANIFEST_FORMAT = 2

Stage = tuple[Path, ...]  # graphs that may run side by side
Stages = tuple[Stage, ...]  # one step, in the order in which its stages run


class ManifestError(ValueError):
    """A manifest or a file it names is missing, damaged, of another format, or does not fit."""


@dataclass(frozen=True, slots=True)
class StateTensor:
    """One tensor of the recurrent state: float32 [B, channels, H / scale, W / scale]."""

    name: str
    channels: int
    scale: int

    @property
    def input_name(self) -> str:
        return f"prev_{self.name}"

    @property
    def output_name(self) -> str:
        return f"next_{self.name}"

    def shape(self, height: int, width: int) -> tuple[int, int, int]:
        return self.channels, height // self.scale, width // self.scale


@dataclass(frozen=True, slots=True)
class ModelCard:
    """What the manifest says about one model."""

    name: str
    stride: int  # H and W of a step are multiples of it
    max_disparity_px: int
    state: tuple[StateTensor, ...]
    graphs: Mapping[int, Stages]  # by iterations
    weights_sha256: str  # of all files together: the identity told to clients
    cold_graphs: Mapping[int, Stages] = field(default_factory=dict)  # by iterations; may be none
    cold_max_pixels: int = 0  # of an image, as it is stepped: larger ones start as they go on

    def stages(self, iterations: int, *, cold_pixels: int | None = None) -> Stages:
        """The graphs of a step; ``cold_pixels``, of its images, if it is a stream's first.

        Raises KeyError: no such count.
        """
        usual = self.graphs[iterations]
        if cold_pixels is None or cold_pixels > self.cold_max_pixels:
            return usual
        return self.cold_graphs.get(iterations, usual)

    @property
    def all_stages(self) -> tuple[Stage, ...]:
        """Of every step there is."""
        return tuple(chain(*self.graphs.values(), *self.cold_graphs.values()))

    @property
    def input_names(self) -> tuple[str, ...]:
        """What the caller of a step gives."""
        return LEFT, RIGHT, UVD_CURR_FROM_PREV, *(tensor.input_name for tensor in self.state)

    @property
    def output_names(self) -> tuple[str, ...]:
        """What the caller of a step gets."""
        return DISPARITY, SIGMA, *(tensor.output_name for tensor in self.state)

    def step_size(self, height: int, width: int) -> tuple[int, int]:
        """The size [H, W] that images are grown to: whole strides, every disparity inside."""
        rows, columns = (
            -(-height // self.stride),
            -(-max(width, self.max_disparity_px) // self.stride),
        )
        return rows * self.stride, columns * self.stride

    def grown(self, image: Image) -> Image:
        """``image`` at its step size: edges repeated to the right and below, no pixel moves."""
        height, width = image.shape[:2]
        step_height, step_width = self.step_size(height, width)
        if (step_height, step_width) == (height, width):
            return image
        around = ((0, step_height - height), (0, step_width - width), (0, 0))
        return np.pad(image, around, mode="edge")

    def iterations_at_most(self, wanted: int) -> int:
        """The largest exported count that does not exceed ``wanted`` (at least the smallest)."""
        fitting = [count for count in self.graphs if count <= wanted]
        return max(fitting) if fitting else min(self.graphs)


def load_model_card(weights_dir: Path, name: str) -> ModelCard:
    """Read one model's card from ``weights_dir`` and check its files against their sha256.

    Raises ManifestError: file missing or without a sha256, unknown format, unknown model, or a
    hash that differs.
    """
    path = weights_dir / MANIFEST_NAME
    try:
        manifest = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise ManifestError(f"no manifest at {path}; export a model there first") from None
    except json.JSONDecodeError as error:
        raise ManifestError(f"{path} is not JSON: {error}") from None
    if manifest.get("format") != MANIFEST_FORMAT:
        raise ManifestError(
            f"{path}: expected manifest format {MANIFEST_FORMAT}, got {manifest.get('format')!r}"
        )
    models = manifest["models"]
    if name not in models:
        raise ManifestError(
            f"{path} has no model {name!r}; it has {', '.join(sorted(models))}. "
            "Name the folder that another was exported to"
        )
    entry = models[name]
    # The graphs, and what large networks keep beside them because their graphs have it in common.
    files = entry["files"]
    digests = [_checked_digest(weights_dir / file, files[file]) for file in sorted(files)]
    graphs, cold_graphs = (
        {
            int(count): tuple(tuple(weights_dir / file for file in stage) for stage in stages)
            for count, stages in entry.get(kind, {}).items()
        }
        for kind in ("graphs", "cold_graphs")
    )
    for stages in (*graphs.values(), *cold_graphs.values()):
        for graph in chain(*stages):
            if graph.name not in files:
                raise ManifestError(
                    f"{path}: model {name!r} runs {graph.name}, which is not among its files; "
                    "export the model anew"
                )
    return ModelCard(
        name=name,
        stride=entry["stride"],
        max_disparity_px=entry["max_disparity_px"],
        state=tuple(StateTensor(**tensor) for tensor in entry["state"]),
        graphs=graphs,
        weights_sha256=hashlib.sha256(b"".join(digests)).hexdigest(),
        cold_graphs=cold_graphs,
        cold_max_pixels=entry.get("cold_max_pixels", 0),
    )


def _checked_digest(path: Path, expected: str) -> bytes:
    try:
        digest = hashlib.sha256(path.read_bytes())
    except FileNotFoundError:
        raise ManifestError(f"the manifest names {path}, which does not exist") from None
    if digest.hexdigest() != expected:
        raise ManifestError(
            f"{path}: expected sha256 {expected}, got {digest.hexdigest()}; "
            "the file is damaged or the manifest is of another export"
        )
    return digest.digest()
