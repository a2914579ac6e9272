"""Networks stepped over footage, for evaluation, studies, benchmarks and parity checks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from vergence_proto.datasets import DatasetError, StereoSource
from vergence_proto.geometry import Pose, RectifiedRig, uvd_curr_from_prev
from vergence_proto.model_io import ModelCard, Stages, load_model_card

if TYPE_CHECKING:  # it needs torch, and networks of others are stepped without it
    from vergence_models.data.clips import StereoClips

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class FootageView:
    """One frame to step, and what is known of its truth."""

    left: Image  # [H, W, 3], RGB
    right: Image
    world_from_left: Pose | None
    truth_px: Plane | None = None  # [H, W]; NaN where unknown and on mirrors


@dataclass(frozen=True, slots=True, eq=False)
class Footage:
    """A rectified sequence, or a pair as a sequence of one."""

    name: str
    rig: RectifiedRig
    views: Sequence[FootageView]


def footage_from_source(source: StereoSource) -> Footage:
    """Read a whole source. Raises DatasetError: it is not rectified, or a file is wrong."""
    rig = source.rig.as_rectified()
    if rig is None:
        raise DatasetError(f"{source.name}: expected a rectified rig to evaluate on")
    views = []
    for entry in source:
        truth = entry.truth_px
        if truth is not None and entry.truth_mask is not None:
            truth = np.where(entry.truth_mask, truth, np.float32(np.nan)).astype(np.float32)
        pose = None if entry.frame.pose is None else entry.frame.pose.world_from_left
        views.append(FootageView(as_rgb(entry.frame.left), as_rgb(entry.frame.right), pose, truth))
    return Footage(source.name, rig, views)


def as_rgb(image: Image) -> Image:
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def footage_from_clip(clips: StereoClips, index: int, name: str) -> Footage:
    """One clip of a batch."""
    frames, height, width, _ = clips.left.shape[1:]
    fx, fy, cx, cy, baseline_m = (
        float(getattr(clips, key)[index]) for key in ("fx", "fy", "cx", "cy", "baseline_m")
    )
    rig = RectifiedRig(width, height, fx, fy, cx, cx, cy, baseline_m)
    views = []
    for frame in range(frames):
        truth = clips.disparity_px[index, frame].numpy()
        views.append(
            FootageView(
                clips.left[index, frame].numpy(),
                clips.right[index, frame].numpy(),
                Pose.from_matrix(clips.world_from_left[index, frame].numpy()),
                np.where(truth > 0, truth, np.float32(np.nan)),
            )
        )
    return Footage(name, rig, views)


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    disparity_px: Plane  # [H, W]
    sigma_px: Plane | None = None  # [H, W]; None: the method estimates no sigma


NO_MOTION = np.eye(4, dtype=np.float32)
State = tuple[Plane, ...]  # each [B, C, h, w], in the order of the card


class StepInputs(NamedTuple):
    """The inputs of one step of a batch, in the order of the contract."""

    left: Image  # [B, H, W, 3], RGB
    right: Image  # the same shape
    uvd_curr_from_prev: NDArray[np.float32]  # [B, 4, 4]
    state: State


class StepResult(NamedTuple):
    """The outputs of one step of a batch."""

    disparity_px: Plane  # [B, H, W]
    sigma_px: Plane  # [B, H, W]
    state: State


class SteppedNetwork(ABC):
    """A network that can be stepped, whichever runtime computes it."""

    card: ModelCard

    @abstractmethod
    def run(self, inputs: StepInputs, iterations: int) -> StepResult:
        """One step of a batch."""

    @abstractmethod
    def start(self, left: Image, right: Image, iterations: int) -> StepResult:
        """One step of a batch of first frames, which have no state."""

    @abstractmethod
    def refines_at_2x(self, iterations: int) -> bool:
        """Return True if :meth:`start` runs the last of so many iterations at twice the size."""

    def cold_state(self, height: int, width: int, batch: int = 1) -> State:
        """All zeros, for images whose size ``card.step_size`` returned."""
        return tuple(
            np.zeros((batch, *tensor.shape(height, width)), np.float32)
            for tensor in self.card.state
        )

    def sequence(self, footage: Footage, *, cold: int, warm: int | None) -> Iterator[Prediction]:
        """Step through footage: ``cold`` iterations on the first frame, then ``warm``.

        ``warm=None`` carries no state: every frame starts cold. No pose is no motion.
        """
        state: State = ()  # also of a model without memory: each of its frames is a cold start
        previous: Pose | None = None
        for view in footage.views:
            height, width = view.left.shape[:2]
            left, right = (self.card.grown(image)[None] for image in (view.left, view.right))
            if not state or warm is None:
                disparity, sigma, state = self.start(left, right, cold)
            else:
                matrix = NO_MOTION
                if previous is not None and view.world_from_left is not None:
                    curr_from_prev = view.world_from_left.inverse() @ previous
                    matrix = uvd_curr_from_prev(footage.rig, curr_from_prev)
                inputs = StepInputs(left, right, matrix[None], state)
                disparity, sigma, state = self.run(inputs, warm)
            previous = view.world_from_left
            yield Prediction(disparity[0, :height, :width], sigma[0, :height, :width])


class OnnxNetwork(SteppedNetwork):
    """The graphs of one model under onnxruntime on the CPU, as the service runs a lone stream's.

    The graphs of a stage run side by side. They share ``threads`` (at least 1), so a model that is
    cut for as many as there are has no operator on more than one, also in stages of one graph.
    """

    def __init__(self, weights: Path, name: str, *, threads: int = 2) -> None:
        """Raises ManifestError: no such model, or a file of it is damaged."""
        self.card = load_model_card(weights, name)
        side_by_side = max(map(len, self.card.all_stages))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = max(1, threads // side_by_side)
        # Both as the service sets them: planning the reuse of buffers only slows the start down,
        # and threads that always spin cost the other core's time.
        options.enable_mem_reuse = False
        options.add_session_config_entry("session.intra_op.spin_duration_us", "20")
        self._sessions = {
            path: onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
            for path in {*chain(*self.card.all_stages)}
        }
        self._beside = ThreadPoolExecutor(min(threads, side_by_side))  # ends with this network

    def run(self, inputs: StepInputs, iterations: int) -> StepResult:
        return self._run(self.card.stages(iterations), inputs)

    def start(self, left: Image, right: Image, iterations: int) -> StepResult:
        batch, height, width, _ = left.shape
        still = NO_MOTION[None].repeat(batch, axis=0)
        nothing = self.cold_state(height, width, batch)
        stages = self.card.stages(iterations, cold_pixels=height * width)
        return self._run(stages, StepInputs(left, right, still, nothing))

    def refines_at_2x(self, iterations: int) -> bool:
        return iterations in self.card.cold_graphs

    def _run(self, stages: Stages, inputs: StepInputs) -> StepResult:
        given = (*inputs[:3], *inputs.state)
        # Any type: the exporter alone decides what one stage passes to the next.
        tensors: dict[str, Any] = dict(zip(self.card.input_names, given, strict=True))

        def outputs_of(graph: Path) -> list[tuple[str, Any]]:
            session = self._sessions[graph]
            feed = {entry.name: tensors[entry.name] for entry in session.get_inputs()}
            names = [entry.name for entry in session.get_outputs()]
            return [*zip(names, session.run(names, feed), strict=True)]

        for stage in stages:
            tensors |= chain(*[*self._beside.map(outputs_of, stage)])
        disparity, sigma, *following = (tensors[name] for name in self.card.output_names)
        return StepResult(disparity, sigma, tuple(following))
