"""Steps of `lite`, computed by the library.

Arrays are those of the model card: images uint8 [H, W, 3], state float32 [1, H/4, W/4] px and
[32, H/8, W/8], disparity and sigma float32 [H, W] px. H and W are multiples of 32, and W is at
least 192. All CPUs compute the same bits, with any number of threads.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterable
from ctypes import POINTER, c_float, c_int8, c_int32, c_void_p
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vergence_native.library import (
    _NOT_FINITE,
    _OK,
    NativeUnavailable,
    NotFinite,
    library,
    variants,
)
from vergence_native.lite_weights import LiteWeights, PartWeights, read_weights
from vergence_native.onnx_graph import Graph, UnsupportedWeights

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

STRIDE = 32
MIN_WIDTH = 192
HIDDEN = 32


class LiteResult(NamedTuple):
    """The result of one step."""

    disparity: Floats  # [H, W] px, the offset u_left - u_right
    sigma: Floats  # [H, W] px, its expected absolute error
    next_disparity: Floats  # [1, H/4, W/4] px
    next_hidden: Floats  # [32, H/8, W/8]


class Threads:
    """Threads for steps; they sleep between steps. A step that runs alone uses all of them.

    Close it when no step runs any more.
    """

    def __init__(self, count: int) -> None:
        self._pool = c_void_p(library().vn_pool_new(max(1, count)))
        if not self._pool:
            raise MemoryError("no memory for threads")
        self.count: int = library().vn_pool_threads(self._pool)

    def close(self) -> None:
        """End the threads."""
        pool, self._pool = self._pool, c_void_p()
        library().vn_pool_free(pool)

    @property
    def handle(self) -> c_void_p:
        """The library's pool."""
        return self._pool


class _Workspaces:
    """Buffers of the sizes of images that were stepped last, for steps at once."""

    def __init__(self, workers: int, kept: int) -> None:
        self._workers = workers
        self._kept = kept
        self._free: list[tuple[tuple[int, int], c_void_p]] = []
        self._lock = threading.Lock()

    def take(self, height: int, width: int) -> c_void_p:
        with self._lock:
            for index, (size, space) in enumerate(self._free):
                if size == (height, width):
                    del self._free[index]
                    return space
        space = c_void_p(library().vn_workspace_new(height, width, self._workers))
        if not space:
            raise MemoryError(f"no memory for a step of {height}x{width} pixels")
        return space

    def give(self, height: int, width: int, space: c_void_p) -> None:
        with self._lock:
            self._free.append(((height, width), space))
            dropped = self._free[: -self._kept]
            self._free = self._free[-self._kept :]
        for _, each in dropped:
            library().vn_workspace_free(each)

    def close(self) -> None:
        with self._lock:
            dropped, self._free = self._free, []
        for _, each in dropped:
            library().vn_workspace_free(each)


class LiteStep:
    """The step of `lite` with one number of iterations.

    ``files`` are the int8 graphs of the step, ``threads`` are shared with other steps. ``variant``
    names a set of instructions of :func:`variants`; the default is the fastest.

    Raises UnsupportedWeights if the files do not hold a step of `lite` that the library computes,
    and NativeUnavailable if there is no library or no such variant.
    """

    def __init__(
        self,
        files: Iterable[Path],
        *,
        iterations: int,
        threads: Threads | None = None,
        variant: str | None = None,
    ) -> None:
        graph = Graph()
        for path in files:
            graph.add_file(path)
        weights = read_weights(graph, iterations=range(iterations))
        known = variants()
        self.variant = variant or known[0]
        if self.variant not in known:
            raise NativeUnavailable(f"this CPU has no {self.variant}; it has {', '.join(known)}")
        self._variant = known.index(self.variant)
        self._threads = threads
        self._model = _model_of(weights)
        workers = threads.count if threads else 1
        self._spaces = _Workspaces(workers, kept=workers)

    def close(self) -> None:
        """Free the weights and buffers. No step may run or follow."""
        self._spaces.close()
        model, self._model = self._model, c_void_p()
        library().vn_model_free(model)

    def step(
        self,
        left: Bytes,
        right: Bytes,
        uvd_curr_from_prev: Floats | None,
        prev_disparity: Floats,
        prev_hidden: Floats,
    ) -> LiteResult:
        """Step once. Without a transform, the state is in the view of this frame already.

        May be called from several threads at once. Raises ValueError for arrays of a wrong shape or
        type, NotFinite, and MemoryError.
        """
        height, width = _checked_size(left)
        shapes = ((1, height // 4, width // 4), (HIDDEN, height // 8, width // 8))
        given = [
            _checked("left", left, np.uint8, (height, width, 3)),
            _checked("right", right, np.uint8, (height, width, 3)),
            None
            if uvd_curr_from_prev is None
            else _checked("uvd_curr_from_prev", uvd_curr_from_prev, np.float32, (4, 4)),
            _checked("prev_disparity", prev_disparity, np.float32, shapes[0]),
            _checked("prev_hidden", prev_hidden, np.float32, shapes[1]),
        ]
        if uvd_curr_from_prev is not None and not np.isfinite(uvd_curr_from_prev).all():
            raise NotFinite("the motion between two frames is not finite")
        if not self._model:
            raise ValueError("the step is closed")
        result = LiteResult(
            np.empty((height, width), np.float32),
            np.empty((height, width), np.float32),
            *(np.empty(shape, np.float32) for shape in shapes),
        )
        space = self._spaces.take(height, width)
        try:
            status = library().vn_step(
                self._variant,
                self._model,
                space,
                self._threads.handle if self._threads else None,
                *(None if array is None else array.ctypes.data for array in (*given, *result)),
            )
        finally:
            self._spaces.give(height, width, space)
        if status == _NOT_FINITE:
            raise NotFinite("the result of the step is not finite")
        if status != _OK:
            raise ValueError(f"the library refused the step, status {status}")
        return result


def _checked_size(image: Bytes) -> tuple[int, int]:
    if image.ndim != 3 or image.shape[0] % STRIDE or image.shape[1] % STRIDE or not image.shape[0]:
        raise ValueError(f"expected an image [H, W, 3] of multiples of {STRIDE}, got {image.shape}")
    if image.shape[1] < MIN_WIDTH:
        raise ValueError(f"expected a width of {MIN_WIDTH} or more, got {image.shape[1]}")
    return image.shape[0], image.shape[1]


def _checked(
    name: str, array: NDArray[np.generic], dtype: type[np.generic], shape: tuple[int, ...]
) -> NDArray[np.generic]:
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(
            f"{name}: expected {np.dtype(dtype).name} {shape}, got {array.dtype.name} {array.shape}"
        )
    return np.require(array, requirements=["C_CONTIGUOUS", "ALIGNED"])


def _model_of(weights: LiteWeights) -> c_void_p:
    """The library's copy of the weights. Raises UnsupportedWeights."""
    native = library()
    model = c_void_p(native.vn_model_new(len(weights.iterations)))
    if not model:
        raise UnsupportedWeights(f"expected 1 to 16 iterations, got {len(weights.iterations)}")
    try:
        for number, part in enumerate((weights.begin, weights.end, *weights.iterations)):
            _set_part(native, model, number, part)
        _require(native.vn_model_finish(model), "the weights are not complete")
    except UnsupportedWeights:
        native.vn_model_free(model)
        raise
    return model


def _set_part(native: ctypes.CDLL, model: c_void_p, number: int, part: PartWeights) -> None:
    for index, conv in enumerate(part.convolutions):
        dims = np.array([*conv.weights.shape, *conv.stride], np.int32)
        status = native.vn_model_conv(
            model,
            number,
            index,
            dims.ctypes.data_as(POINTER(c_int32)),
            conv.weights.ctypes.data_as(POINTER(c_int8)),
            conv.steps.ctypes.data_as(POINTER(c_float)),
            conv.bias.ctypes.data_as(POINTER(c_int32)),
            *conv.given,
            *conv.made,
        )
        _require(status, f"part {number}, convolution {index}")
    for index, terms in enumerate(part.sums):
        status = native.vn_model_sum(model, number, index, *terms.first, *terms.second, *terms.made)
        _require(status, f"part {number}, sum {index}")
    for index, values in enumerate(part.floats):
        pointer = values.ctypes.data_as(POINTER(c_float))
        status = native.vn_model_floats(model, number, index, pointer, values.size)
        _require(status, f"part {number}, floats {index}")


def _require(status: int, what: str) -> None:
    if status != _OK:
        raise UnsupportedWeights(f"{what}: shapes or values that the kernels cannot compute with")
