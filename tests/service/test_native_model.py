"""The native engine in the service: onnxruntime's answers, and the choice between the two."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import vergence_native
from tests.service.test_onnx_model import make_view
from tests.support.weights_copy import WEIGHTS
from vergence_native import library
from vergence_service.inference.engines import ServedModel, load_model
from vergence_service.inference.model import RecurrentState, Step, StepResult, StereoModel
from vergence_service.inference.native_model import NativeStereoModel
from vergence_service.inference.onnx_model import OnnxStereoModel, packaged_weights_dir
from vergence_service.inference.providers import ProviderUnavailable

built = pytest.mark.skipif(not vergence_native.available(), reason="vergence_native is not built")
PARITY_PX = 0.02  # of nearly every pixel, as in tests/native
WITHIN_PARITY = 0.999


@pytest.fixture(scope="module")
def native() -> Iterator[NativeStereoModel]:
    model = NativeStereoModel(packaged_weights_dir(), "lite", threads=2, allow_spinning=False)
    with closing(model):
        yield model


@pytest.fixture(scope="module")
def onnx() -> Iterator[OnnxStereoModel]:
    model = OnnxStereoModel(
        packaged_weights_dir(), "lite", providers=["cpu"], threads=2, allow_spinning=False
    )
    with closing(model):
        yield model


def assert_close(ours: StepResult, theirs: StepResult) -> None:
    apart_px = np.abs(ours.offset_px - theirs.offset_px)
    assert (apart_px <= PARITY_PX).mean() >= WITHIN_PARITY
    assert ours.offset_px.shape == theirs.offset_px.shape
    for some, others in zip(ours.state.tensors, theirs.state.tensors, strict=True):
        assert isinstance(some, np.ndarray)
        assert isinstance(others, np.ndarray)
        assert some.shape == others.shape
        assert some.dtype == others.dtype


def walk(models: Sequence[StereoModel], *, seed: int = 1, start: int = 1) -> list[StepResult]:
    """Step a stream; each model takes one frame, from the state of the one before it."""
    state: RecurrentState | None = None
    results = []
    for number, model in enumerate(models, 1):
        iterations = start if state is None else 1
        [result] = model.step([Step(make_view(number, seed), state, iterations)])
        results.append(result)
        state = result.state
    return results


@built
@pytest.mark.parametrize("start", [1, 4, pytest.param(8, marks=pytest.mark.slow)])
def test_a_stream_gets_the_answers_of_onnxruntime(
    native: NativeStereoModel, onnx: OnnxStereoModel, start: int
) -> None:
    """Eight iterations refine at twice the size, which onnxruntime computes for both."""
    ours, theirs = (walk([model] * 3, start=start) for model in (native, onnx))
    for some, others in zip(ours, theirs, strict=True):
        assert_close(some, others)


@built
def test_a_state_goes_from_one_engine_to_the_other(
    native: NativeStereoModel, onnx: OnnxStereoModel
) -> None:
    expected = walk([onnx] * 4)
    for some, others in zip(walk([native, onnx, native, onnx]), expected, strict=True):
        assert_close(some, others)
    assert [result.state.step_count for result in expected] == [1, 2, 3, 4]


@built
def test_streams_in_one_batch_get_bit_for_bit_what_each_gets_alone(
    native: NativeStereoModel,
) -> None:
    seeds = (1, 2, 3)
    alone = [walk([native] * 2, seed=seed) for seed in seeds]
    states: list[RecurrentState | None] = [None] * len(seeds)
    for frame in range(2):
        batch = [
            Step(make_view(frame + 1, seed), state, 1)
            for seed, state in zip(seeds, states, strict=True)
        ]
        results = native.step(batch)
        states = [result.state for result in results]
        for mine, together in zip(alone, results, strict=True):
            assert mine[frame].offset_px.tobytes() == together.offset_px.tobytes()
            assert mine[frame].sigma_px.tobytes() == together.sigma_px.tobytes()


@built
def test_streams_on_several_lanes_get_bit_for_bit_what_each_gets_alone(
    native: NativeStereoModel,
) -> None:
    seeds = range(4)
    alone = [walk([native] * 3, seed=seed) for seed in seeds]
    with ThreadPoolExecutor(native.max_concurrent_steps) as lanes:
        together = [*lanes.map(lambda seed: walk([native] * 3, seed=seed), seeds)]
    for some, others in zip(alone, together, strict=True):
        for one, other in zip(some, others, strict=True):
            assert one.offset_px.tobytes() == other.offset_px.tobytes()


@built
def test_the_memory_of_a_step_is_at_most_what_the_model_says(native: NativeStereoModel) -> None:
    functions = library.library()
    for height, width in ((130, 250), (480, 640), (1080, 1920), (2000, 2000)):
        rows, columns = native.card.step_size(height, width)
        space = functions.vn_workspace_new(rows, columns, native.max_concurrent_steps)
        results = rows * columns * (2 + 1 / 16 + 32 / 64) * 4
        said = native.step_bytes(height, width, 1, cold=False)
        assert functions.vn_workspace_bytes(space) + results <= said
        functions.vn_workspace_free(space)


def load(
    name: str = "lite", *, engine: str = "auto", weights: Path | None = None, provider: str = "cpu"
) -> closing[ServedModel]:
    return closing(
        load_model(
            weights or packaged_weights_dir(),
            name,
            engine=engine,
            providers=[provider],
            threads=1,
            allow_spinning=False,
        )
    )


@built
def test_auto_is_native_for_lite_on_a_cpu() -> None:
    with load() as model:
        assert model.engine == f"native {vergence_native.variants()[0]}"


@built
def test_auto_is_onnxruntime_for_another_model() -> None:
    with load("reciprocal", weights=WEIGHTS) as model:
        assert model.engine.startswith("onnxruntime ")


def test_auto_is_onnxruntime_where_the_library_was_not_built(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    library.library.cache_clear()
    monkeypatch.setattr(library, "__file__", str(tmp_path / "library.py"))
    try:
        with load() as model:
            assert model.engine.startswith("onnxruntime ")
        with pytest.raises(ProviderUnavailable, match="no C compiler"):
            load(engine="native")
    finally:
        library.library.cache_clear()


def test_native_is_refused_on_a_gpu() -> None:
    with pytest.raises(ProviderUnavailable, match="runs on the CPU"):
        load(engine="native", provider="cuda")


@built
def test_native_is_refused_for_another_model() -> None:
    with pytest.raises(ProviderUnavailable, match="cannot compute 'reciprocal'"):
        load("reciprocal", engine="native", weights=WEIGHTS)
