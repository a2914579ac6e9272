"""OpenCV's semi-global matching as a model: the classical baseline, over the same transports.

It has no weights and no memory, so every frame is a cold start.
"""

import numpy as np

from vergence_proto.sgbm import sgbm_matches
from vergence_service.inference.model import RecurrentState, Step, StepResult
from vergence_service.inference.opencv_model import MAX_DISPARITY_PX, OpenCvModel

# The models, and the size at which each matches.
SGBM_MODELS = {"sgbm": 1.0, "sgbm-half": 0.5}

# Half of its matches on the bundled room are closer than sigma times ln 2. What it does not match
# is off by several pixels.
_SIGMA_PX = {"sgbm": 0.5, "sgbm-half": 0.6}
_HOLE_SIGMA_PX = 8.0
_STRIDE = 2  # half of the size is whole

# An upper bound of the memory of a step: bytes per pixel of the maps, and bytes per column and
# disparity of OpenCV's buffers; a test measures again.
_BYTES_A_PIXEL = 110
_BYTES_A_COST = 40
_BESIDE_PIXELS = 2 << 20


class SgbmModel(OpenCvModel):
    """OpenCV's StereoSGBM in its three-way mode.

    A hole takes the farther of its neighbours, with a wide sigma.
    """

    def __init__(self, name: str, *, threads: int) -> None:
        super().__init__(name, threads=threads, stride=_STRIDE)

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        costs = (width + MAX_DISPARITY_PX) * MAX_DISPARITY_PX
        return _BESIDE_PIXELS + _BYTES_A_PIXEL * height * width + _BYTES_A_COST * costs

    def _step(self, step: Step) -> StepResult:
        height, width = step.view.left.shape[:2]
        left, right = (self._card.grown(each) for each in (step.view.left, step.view.right))
        dense, matched = sgbm_matches(
            left, right, max_disparity_px=MAX_DISPARITY_PX, scale=SGBM_MODELS[self._card.name]
        )
        sigma = np.where(matched, _SIGMA_PX[self._card.name], _HOLE_SIGMA_PX).astype(np.float32)
        return StepResult(
            dense[:height, :width],
            sigma[:height, :width],
            RecurrentState.after(step.view, step.state, tensors=()),
        )
