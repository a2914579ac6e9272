"""`lite` computed by the native kernels, with onnxruntime for the steps that they do not have.

Both engines compute the same network from the same files, and a state has the same layout in both,
so a stream may go on in the other engine.
"""

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vergence_native import LiteStep, NativeUnavailable, NotFinite, Threads, UnsupportedWeights
from vergence_proto.errors import NonFinite
from vergence_proto.model_io import ModelCard
from vergence_service.inference.installed import ProviderUnavailable, usable_cores
from vergence_service.inference.model import RecurrentState, Step, StepResult
from vergence_service.inference.onnx_model import OnnxStereoModel
from vergence_service.inference.tensors import on_host

# Bytes per pixel of a step's buffers and results, an upper bound; a test measures again.
_STEP_BYTES = 64
_BESIDE_PIXELS = 1 << 20


class NativeStereoModel:
    """A model of the manifest in the native engine.

    Cold starts that refine at twice the size run in onnxruntime. All steps share ``threads``
    threads; 0 uses one per core. ``variant`` names a set of instructions; the default is the best.

    Raises ProviderUnavailable if the library is missing or does not compute these weights, and what
    :class:`OnnxStereoModel` raises.
    """

    def __init__(
        self,
        weights_dir: Path,
        name: str,
        *,
        threads: int,
        allow_spinning: bool,
        variant: str | None = None,
    ) -> None:
        self._onnx = OnnxStereoModel(
            weights_dir, name, providers=["cpu"], threads=threads, allow_spinning=allow_spinning
        )
        self._variant = variant
        self._steps: dict[int, LiteStep] = {}
        self._loading = threading.Lock()
        try:
            self._threads = Threads(threads or usable_cores())
            try:
                self._loaded(min(self.card.graphs))
            except (NativeUnavailable, UnsupportedWeights):
                self._threads.close()
                raise
        except (NativeUnavailable, UnsupportedWeights) as error:
            self._onnx.close()
            raise ProviderUnavailable(
                f"the native engine cannot compute {name!r}: {error}"
            ) from None

    @property
    def card(self) -> ModelCard:
        return self._onnx.card

    @property
    def provider(self) -> str:
        return self._onnx.provider

    @property
    def engine(self) -> str:
        return f"native {self._loaded(min(self.card.graphs)).variant}"

    @property
    def max_concurrent_steps(self) -> int:
        return self._threads.count

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        self._loaded(iterations)
        for count in cold_iterations:
            if count in self.card.cold_graphs:
                self._onnx.load_cold(count)
            else:
                self._loaded(count)

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        step_height, step_width = self.card.step_size(height, width)
        if cold and self._refines_at_2x(step_height * step_width, iterations):
            return self._onnx.step_bytes(height, width, iterations, cold=cold)
        return _BESIDE_PIXELS + _STEP_BYTES * step_height * step_width

    def close(self) -> None:
        """Stop the threads that steps use, and free the buffers. No step may follow."""
        for step in self._steps.values():
            step.close()
        self._threads.close()
        self._onnx.close()

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        return [result for step in steps for result in self._step(step)]

    def _step(self, step: Step) -> list[StepResult]:
        height, width = step.view.left.shape[:2]
        step_height, step_width = self.card.step_size(height, width)
        if step.cold and self._refines_at_2x(step_height * step_width, step.iterations):
            return self._onnx.step([step])
        if step.state is None:
            shapes = (tensor.shape(step_height, step_width) for tensor in self.card.state)
            disparity, hidden = (np.zeros(shape, np.float32) for shape in shapes)
        else:
            disparity, hidden = map(on_host, step.state.tensors)
        try:
            result = self._loaded(step.iterations).step(
                self.card.grown(step.view.left),
                self.card.grown(step.view.right),
                step.uvd_curr_from_prev,
                disparity,
                hidden,
            )
        except NotFinite:
            raise NonFinite(
                "the network's result was not finite; the stream starts again without a state"
            ) from None
        state = (result.next_disparity, result.next_hidden)
        return [
            StepResult(
                result.disparity[:height, :width],
                result.sigma[:height, :width],
                RecurrentState.after(step.view, step.state, state),
            )
        ]

    def _refines_at_2x(self, pixels: int, iterations: int) -> bool:
        return iterations in self.card.cold_graphs and pixels <= self.card.cold_max_pixels

    def _loaded(self, iterations: int) -> LiteStep:
        with self._loading:
            if iterations not in self._steps:
                files = [path for stage in self.card.stages(iterations) for path in stage]
                self._steps[iterations] = LiteStep(
                    files, iterations=iterations, threads=self._threads, variant=self._variant
                )
            return self._steps[iterations]
