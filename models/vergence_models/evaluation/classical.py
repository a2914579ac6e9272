"""The classical methods that are compared: semi-global matching, and PatchMatch carried in time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vergence_models.evaluation.methods import Method, single_frame_method, warm_method
from vergence_models.evaluation.stepping import (
    Footage,
    Image,
    Prediction,
    State,
    StepInputs,
    SteppedNetwork,
    StepResult,
)
from vergence_proto.model_io import ModelCard, StateTensor
from vergence_proto.patchmatch import SCALE, Matches, patchmatch
from vergence_proto.sgbm import sgbm_disparity

_COLD_ITERATIONS = 3  # as the server


def classical_methods() -> list[Method]:
    """SGBM at two sizes, and PatchMatch with its memory."""
    patches = PatchMatchSteps()
    return [
        sgbm_method("SGBM, full size", 1.0),
        sgbm_method("SGBM, half size", 0.5),
        warm_method(patches, "PatchMatch", 1, cold=_COLD_ITERATIONS),
    ]


def patchmatch_without_memory() -> Method:
    return single_frame_method(PatchMatchSteps(), "PatchMatch", _COLD_ITERATIONS)


def sgbm_method(label: str, scale: float) -> Method:
    def predict(footage: Footage) -> Iterator[Prediction]:
        limit = 192 if len(footage.views) == 1 and footage.rig.width > 700 else 128
        for view in footage.views:
            found = sgbm_disparity(view.left, view.right, max_disparity_px=limit, scale=scale)
            yield Prediction(found)

    return Method(label, predict)


class PatchMatchSteps(SteppedNetwork):
    """PatchMatch stepped as a network; its planes are its state."""

    def __init__(self) -> None:
        self.card = ModelCard(
            name="patchmatch",
            stride=2 * SCALE,
            max_disparity_px=192,
            state=(StateTensor("planes", channels=3, scale=SCALE),),
            graphs={1: (), 2: (), 3: ()},
            weights_sha256="",
        )

    def run(self, inputs: StepInputs, iterations: int) -> StepResult:
        [planes] = inputs.state
        rows = zip(inputs.left, inputs.right, planes, inputs.uvd_curr_from_prev, strict=True)
        return _batch(
            [
                patchmatch(
                    left,
                    right,
                    max_disparity_px=self.card.max_disparity_px,
                    iterations=iterations,
                    previous=previous,
                    uvd_curr_from_prev=matrix,
                )
                for left, right, previous, matrix in rows
            ]
        )

    def start(self, left: Image, right: Image, iterations: int) -> StepResult:
        limit = self.card.max_disparity_px
        pairs = zip(left, right, strict=True)
        return _batch(
            [patchmatch(*pair, max_disparity_px=limit, iterations=iterations) for pair in pairs]
        )

    def refines_at_2x(self, iterations: int) -> bool:
        return False


def _batch(rows: list[Matches]) -> StepResult:
    state: State = (np.stack([row.planes for row in rows]),)
    return StepResult(
        np.stack([row.disparity_px for row in rows]),
        np.stack([row.sigma_px for row in rows]),
        state,
    )
