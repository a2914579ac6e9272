"""The model inside Triton: its Python backend calls this, in a process for each instance."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import triton_python_backend_utils as triton  # type: ignore[import-not-found] # of the backend

from vergence_proto.geometry import Pose, RectifiedRig
from vergence_service.inference.engines import load_model
from vergence_service.inference.model import RecurrentState, Step, StereoView

_RIG = RectifiedRig(640, 480, 512.0, 512.0, 319.5, 319.5, 239.5, 0.1)


class TritonPythonModel:
    """The state of a sequence stays in the instance that Triton sends the sequence to."""

    def initialize(self, _: Any) -> None:
        weights = Path(os.environ["VERGENCE_MODEL__WEIGHTS"])
        self.model = load_model(
            weights, "lite", engine="auto", providers=["cpu"], threads=1, allow_spinning=False
        )
        self.iterations = self.model.card.iterations_at_most(1)
        self.model.warm_up(self.iterations, self.iterations)
        self.states: dict[int, RecurrentState] = {}

    def execute(self, requests: list[Any]) -> list[Any]:
        return [self.answer(request) for request in requests]

    def answer(self, request: Any) -> Any:
        def given(name: str) -> Any:
            return triton.get_input_tensor_by_name(request, name).as_numpy()[0]

        left, right = (image.copy() for image in given("IMAGES"))
        captured, sequence = given("CAPTURED"), int(given("CORRID").item())
        state = None if given("START").item() else self.states.get(sequence)
        view = StereoView(left, right, _RIG, int(captured.item()), Pose.identity())
        started_s = time.perf_counter()
        [result] = self.model.step([Step(view, state, self.iterations)])
        self.states[sequence] = result.state
        outputs = {
            "OFFSET": result.offset_px.astype(np.float16)[None],
            "STEP_S": np.array([[time.perf_counter() - started_s]]),
            "CAPTURED": captured[None],
        }
        # Its way for NumPy's arrays takes those of NumPy 2 for empty.
        tensors = [triton.Tensor.from_dlpack(*each) for each in outputs.items()]
        return triton.InferenceResponse(tensors)
