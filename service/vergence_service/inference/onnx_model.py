"""A stereo model that runs as ONNX graphs in onnxruntime."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnxruntime.capi.onnxruntime_pybind11_state import RuntimeException as OrtError

from vergence_proto.errors import NonFinite
from vergence_proto.model_io import (
    DISPARITY,
    LEFT,
    RIGHT,
    SIGMA,
    UVD_CURR_FROM_PREV,
    ModelCard,
    load_model_card,
)
from vergence_service.inference.graphs import GraphRunner
from vergence_service.inference.installed import packaged_weights_dir as packaged_weights_dir
from vergence_service.inference.model import RecurrentState, Step, StepResult
from vergence_service.inference.providers import (
    ENGINE,
    DeviceTensor,
    Tensor,
    device_of,
    require_provider,
)
from vergence_service.inference.tensors import on_host as on_host

# What onnxruntime says if an allocation fails: its arena, and C++.
_NO_MEMORY = re.compile("Failed to allocate memory|bad_alloc|bad allocation|Available memory of")

# The memory of a step: pixels * (bytes per pixel + bytes per column * columns), for the graphs of
# `lite` relate every pixel of a row to every other. Upper bounds, measured on a CPU;
# tests/service/test_step_memory.py measures again.
_FROM_NOTHING = (320.0, 0.345)  # the graphs of cold starts
_ANY_STEP = (110.0, 0.07)
_SAVING = (70.0, 0.045)  # any step, if it saves memory
_BESIDE_PIXELS = 12 << 20
# A step that would need more than this saves memory.
_LARGE_STEP = 320 << 20


class OnnxStereoModel:
    """A model of the manifest in onnxruntime.

    States stay on the device of the first provider; ``states_on`` names another device. All steps
    share ``threads`` threads; 0 uses one per core.

    Raises ManifestError if the manifest or its graphs cannot be used, and ProviderUnavailable if
    onnxruntime cannot use a provider on this machine.
    """

    def __init__(
        self,
        weights_dir: Path,
        name: str,
        *,
        providers: Sequence[str],
        threads: int,
        allow_spinning: bool,
        states_on: str | None = None,
    ) -> None:
        self._card = load_model_card(weights_dir, name)
        self._provider = require_provider(providers[0])
        self._device = states_on or device_of(providers[0])
        self._graphs = GraphRunner(
            self._card,
            providers=[require_provider(provider) for provider in providers],
            threads=threads,
            allow_spinning=allow_spinning,
            device=self._device,
        )

    @property
    def card(self) -> ModelCard:
        return self._card

    @property
    def provider(self) -> str:
        return self._provider

    @property
    def engine(self) -> str:
        return ENGINE

    @property
    def max_concurrent_steps(self) -> int:
        return self._graphs.max_concurrent_steps if self._device is None else 1

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        self._graphs.load(iterations)
        for count in cold_iterations:
            self.load_cold(count)

    def load_cold(self, iterations: int) -> None:
        """Load the graphs of cold starts with this count."""
        self._graphs.load(iterations, cold_pixels=0)

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        height, width = self._card.step_size(height, width)
        pixels = height * width
        if self._card.step_memory is not None:
            return self._card.step_memory.of(height, width)
        own_graphs = iterations in self._card.cold_graphs and pixels <= self._card.cold_max_pixels
        if cold and own_graphs:
            return _bytes_of(_FROM_NOTHING, pixels, width)
        usual = _bytes_of(_ANY_STEP, pixels, width)
        return usual if usual <= _LARGE_STEP else _bytes_of(_SAVING, pixels, width)

    def close(self) -> None:
        """Stop the threads that steps use. No step may follow."""
        self._graphs.close()

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        # A CPU steps row by row. A batch would gain nothing there, and CPU kernels sum in an order
        # that depends on the batch: a stream's answer must not depend on its neighbours.
        if self._device is None:
            return [result for step in steps for result in self._step([step])]
        return self._step(steps)

    def _step(self, steps: Sequence[Step]) -> list[StepResult]:
        height, width = steps[0].view.left.shape[:2]
        step_height, step_width = self._card.step_size(height, width)
        pixels = step_height * step_width
        try:
            found = self._graphs.run(
                steps[0].iterations,
                self._feeds(steps),
                cold_pixels=pixels if steps[0].cold else None,
                save_memory=_bytes_of(_ANY_STEP, pixels, step_width) > _LARGE_STEP,
            )
        except OrtError as error:
            if _NO_MEMORY.search(str(error)):
                raise MemoryError(f"a step of {width}x{height}") from None
            raise
        # States on a device are not checked: a bad value would show in the maps of the next step.
        to_check = [values for values in found.values() if not isinstance(values, DeviceTensor)]
        if not all(np.isfinite(values).all() for values in to_check):
            raise NonFinite(
                "the network's result was not finite; the stream starts again without a state"
            )
        disparity, sigma = _batch_on_host(found[DISPARITY]), _batch_on_host(found[SIGMA])
        states = _rows([found[tensor.output_name] for tensor in self._card.state], len(steps))
        return [
            StepResult(
                disparity[row, :height, :width],
                sigma[row, :height, :width],
                RecurrentState.after(step.view, step.state, states[row]),
            )
            for row, step in enumerate(steps)
        ]

    def _feeds(self, steps: Sequence[Step]) -> dict[str, NDArray[np.generic] | DeviceTensor]:
        left = _stack([self._card.grown(step.view.left) for step in steps])
        feeds: dict[str, NDArray[np.generic] | DeviceTensor] = {
            LEFT: left,
            RIGHT: _stack([self._card.grown(step.view.right) for step in steps]),
            UVD_CURR_FROM_PREV: _stack([step.uvd_curr_from_prev for step in steps]),
        }
        for index, tensor in enumerate(self._card.state):
            zeros = np.zeros(tensor.shape(*left.shape[1:3]), np.float32)
            before = [step.state.tensors[index] if step.state else zeros for step in steps]
            feeds[tensor.input_name] = (
                before[0]
                if len(before) == 1 and isinstance(before[0], DeviceTensor)
                else _stack([*map(on_host, before)])
            )
        return feeds


def _bytes_of(measured: tuple[float, float], pixels: int, columns: int) -> int:
    per_pixel, per_column = measured
    return _BESIDE_PIXELS + int(pixels * (per_pixel + per_column * columns))


def _batch_on_host(tensor: Tensor) -> NDArray[np.float32]:
    return tensor.on_host() if isinstance(tensor, DeviceTensor) else tensor


def _rows(tensors: Sequence[Tensor], count: int) -> list[tuple[Tensor, ...]]:
    """Split a batch of states into rows. A single row stays on its device, several are copied."""
    if count == 1 and any(isinstance(tensor, DeviceTensor) for tensor in tensors):
        return [tuple(tensors)]
    batches = [*map(_batch_on_host, tensors)]
    return [tuple(batch[row] for batch in batches) for row in range(count)]


def _stack(rows: Sequence[NDArray[np.generic]]) -> NDArray[np.generic]:
    """Make a batch of rows. A single row is not copied."""
    return np.ascontiguousarray(rows[0])[None] if len(rows) == 1 else np.stack(rows)
