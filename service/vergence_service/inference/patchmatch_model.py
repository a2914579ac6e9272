"""PatchMatch stereo as a model: a classical method that carries its planes through time."""

import numpy as np

from vergence_proto.model_io import StateTensor
from vergence_proto.patchmatch import SCALE, patchmatch
from vergence_service.inference.model import RecurrentState, Step, StepResult
from vergence_service.inference.opencv_model import MAX_DISPARITY_PX, OpenCvModel
from vergence_service.inference.tensors import on_host

PATCHMATCH_MODEL = "patchmatch"

# An upper bound of the memory of a step; a test measures again.
_BYTES_A_PIXEL = 280
_BESIDE_PIXELS = 4 << 20


class PatchMatchModel(OpenCvModel):
    """A slanted plane for every second pixel. The last frame's planes are the start of the next."""

    def __init__(self, *, threads: int) -> None:
        super().__init__(
            PATCHMATCH_MODEL,
            threads=threads,
            stride=2 * SCALE,
            iterations=(1, 2, 3),
            state=(StateTensor("planes", channels=3, scale=SCALE),),
        )

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        height, width = self.card.step_size(height, width)
        return _BESIDE_PIXELS + _BYTES_A_PIXEL * height * width

    def _step(self, step: Step) -> StepResult:
        height, width = step.view.left.shape[:2]
        found = patchmatch(
            self.card.grown(step.view.left),
            self.card.grown(step.view.right),
            max_disparity_px=MAX_DISPARITY_PX,
            iterations=step.iterations,
            previous=None if step.state is None else np.asarray(on_host(step.state.tensors[0])),
            uvd_curr_from_prev=step.uvd_curr_from_prev,
        )
        return StepResult(
            found.disparity_px[:height, :width],
            found.sigma_px[:height, :width],
            RecurrentState.after(step.view, step.state, (found.planes,)),
        )
