"""The contract between the export of a network and the server that runs it.

A model is a set of ONNX graphs with the same weights, and a manifest that describes them. One step
of the recurrence, for a batch of streams, runs the graphs of its iteration count in stages. The
graphs of one stage are independent and may run in parallel. The inputs of a graph are named; each
comes from the caller or is an output of an earlier stage. Any graph may return an output of the
model, and no two graphs of a count have an output of the same name. Most models have a single graph
per count: one stage of one graph.

A model may have separate graphs for cold starts. They are used when there is no state, for the
iteration counts listed, up to their maximum image size.

A model may have no state tensors. Then every frame is a cold start, and its graphs need no motion.

Inputs:

- ``left``, ``right``: uint8 [B, H, W, 3], rectified RGB; H and W as :meth:`ModelCard.step_size`.
- ``uvd_curr_from_prev``: float32 [B, 4, 4], from the pixels of the previous frame to this one's;
  see :func:`vergence_proto.geometry.uvd_curr_from_prev`.
- ``prev_<tensor>``: float32 [B, C, h, w], the state after the previous step; zeros on a cold start.

Outputs:

- ``disparity``: float32 [B, H, W], the pixel offset u_left - u_right, in full-resolution pixels.
- ``sigma``: float32 [B, H, W], its expected absolute error, in pixels.
- ``next_<tensor>``: float32 [B, C, h, w], the state for the next step.

Pixel centres are at integer coordinates. The network predicts the raw pixel offset, even if the
two principal points differ: the transform includes that difference.
"""

import hashlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
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

# Models without weights and without a manifest, and whether each carries a state.
CLASSICAL_MODELS = {"sgbm": False, "sgbm-half": False, "patchmatch": True}

MANIFEST_NAME = "manifest.json"
MANIFEST_FORMAT = 2

Stage = tuple[Path, ...]  # graphs that may run in parallel
Stages = tuple[Stage, ...]  # one step, in the order in which its stages run


class ManifestError(ValueError):
    """A manifest or one of its files is missing, damaged, of another format, or does not match."""


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
class StepMemory:
    """An upper bound of the memory that one step takes while it runs, by its size."""

    beside_bytes: int  # for any size
    bytes_a_pixel: float
    bytes_a_pixel_and_column: float  # a volume relates pixels to columns

    def of(self, height: int, width: int) -> int:
        per_pixel = self.bytes_a_pixel + self.bytes_a_pixel_and_column * width
        return self.beside_bytes + int(per_pixel * height * width)


@dataclass(frozen=True, slots=True)
class ModelCard:
    """The manifest's description of one model."""

    name: str
    stride: int  # height and width of a step are multiples of this number
    max_disparity_px: int
    state: tuple[StateTensor, ...]
    graphs: Mapping[int, Stages]  # the stages of a step, by number of iterations
    weights_sha256: str  # hash of all files together; clients see it as the identity of the weights
    # The stages of a cold start, by number of iterations; empty if they are those of any step.
    cold_graphs: Mapping[int, Stages] = field(default_factory=dict)
    cold_max_pixels: int = 0  # larger images, at step size, start with the graphs of any step
    step_memory: StepMemory | None = None  # of any step; None: the engine knows the network

    def stages(self, iterations: int, *, cold_pixels: int | None = None) -> Stages:
        """Return the graphs of a step. For a stream's first, ``cold_pixels`` is its image's size.

        Raises KeyError: the model has no graphs for this number of iterations.
        """
        usual = self.graphs[iterations]
        if cold_pixels is None or cold_pixels > self.cold_max_pixels:
            return usual
        return self.cold_graphs.get(iterations, usual)

    @property
    def recurrent(self) -> bool:
        """True if a step passes a state to the next. False: every frame is a cold start."""
        return bool(self.state)

    @property
    def all_stages(self) -> tuple[Stage, ...]:
        """The stages of every kind of step."""
        return tuple(chain(*self.graphs.values(), *self.cold_graphs.values()))

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of a step's inputs."""
        return LEFT, RIGHT, UVD_CURR_FROM_PREV, *(tensor.input_name for tensor in self.state)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The names of a step's outputs."""
        return DISPARITY, SIGMA, *(tensor.output_name for tensor in self.state)

    def step_size(self, height: int, width: int) -> tuple[int, int]:
        """Return the padded size [H, W]: whole strides, and wide enough for every disparity."""
        rows, columns = (
            -(-height // self.stride),
            -(-max(width, self.max_disparity_px) // self.stride),
        )
        return rows * self.stride, columns * self.stride

    def grown(self, image: Image) -> Image:
        """Pad ``image`` to its step size. Edges are repeated right and below; no pixel moves."""
        height, width = image.shape[:2]
        step_height, step_width = self.step_size(height, width)
        if (step_height, step_width) == (height, width):
            return image
        around = ((0, step_height - height), (0, step_width - width), (0, 0))
        return np.pad(image, around, mode="edge")

    def iterations_at_most(self, wanted: int) -> int:
        """Return the largest exported count up to ``wanted``, or the smallest if all exceed it."""
        fitting = [count for count in self.graphs if count <= wanted]
        return max(fitting) if fitting else min(self.graphs)


def load_model_card(weights_dir: Path, name: str) -> ModelCard:
    """Read one model's card from ``weights_dir`` and check its files against their sha256.

    Raises ManifestError: a file is missing or has no sha256 or another one, the manifest has an
    unknown format, or there is no such model.
    """
    path = weights_dir / MANIFEST_NAME
    try:
        manifest = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise ManifestError(f"no manifest at {path}; export a model there first") from None
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"{path} is not JSON: {error}") from None
    if manifest.get("format") != MANIFEST_FORMAT:
        raise ManifestError(
            f"{path}: expected manifest format {MANIFEST_FORMAT}, got {manifest.get('format')!r}"
        )
    models = manifest["models"]
    if name not in models:
        raise ManifestError(
            f"{path} has no model {name!r}; it has {', '.join(sorted(models))}. "
            "For another model, name the folder that it was exported to"
        )
    entry = models[name]
    # The graphs, and the weights that several graphs of a large network share.
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
                    "export the model again"
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
        step_memory=StepMemory(**entry["step_memory"]) if entry.get("step_memory") else None,
    )


def user_models_dir() -> Path:
    """Return the folder of models that the user of this machine has added; it may not exist."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    else:
        base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "vergence" / "models"


def folder_of_model(name: str, folders: Sequence[Path]) -> Path:
    """Return the first of ``folders`` whose manifest names the model, otherwise the first of all.

    A manifest that cannot be read names no model: loading the model reports what is wrong.
    """
    for folder in folders:
        try:
            if name in json.loads((folder / MANIFEST_NAME).read_bytes())["models"]:
                return folder
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return folders[0]


def _checked_digest(path: Path, expected: str) -> bytes:
    try:
        digest = hashlib.sha256(path.read_bytes())
    except FileNotFoundError:
        raise ManifestError(f"the manifest names {path}, which does not exist") from None
    if digest.hexdigest() != expected:
        raise ManifestError(
            f"{path}: expected sha256 {expected}, got {digest.hexdigest()}; "
            "the file is damaged or the manifest belongs to another export"
        )
    return digest.digest()
