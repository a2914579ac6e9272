"""The native step: the answers of the exported graphs, and the same bits everywhere."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vergence_native
from tests.native.conftest import (
    STILL,
    MakeStep,
    assert_same_bits,
    graphs,
    nothing,
    random_pair,
    two_frames,
)
from vergence_models.evaluation.stepping import (
    FootageView,
    OnnxNetwork,
    StepInputs,
    footage_from_source,
)
from vergence_native import LiteStep, NativeUnavailable, NotFinite
from vergence_proto.datasets import open_source
from vergence_proto.geometry import uvd_curr_from_prev
from vergence_service.inference.onnx_model import packaged_weights_dir

ROOM = "vergence:client/vergence/sample/room"
# Nearly every pixel agrees to this; where two surfaces are equally good, a rounding may choose.
PARITY_PX = 0.02
WITHIN_PARITY = 0.999
FRAMES = 5
SIZE = (64, 224)  # neither side is a power of two


@pytest.fixture(scope="module")
def reference() -> OnnxNetwork:
    return OnnxNetwork(packaged_weights_dir(), "lite")


def test_it_gives_the_answers_of_the_exported_graphs(
    make_step: MakeStep, reference: OnnxNetwork
) -> None:
    """Each engine goes on from its own state, so differences may add up over the frames."""
    footage = footage_from_source(open_source(ROOM))
    native = {count: make_step(count, threads=2) for count in (1, 4)}
    previous: FootageView | None = None
    for view in footage.views[:FRAMES]:
        left, right = (reference.card.grown(image) for image in (view.left, view.right))
        matrix = STILL
        if previous is None:
            theirs = reference.cold_state(*left.shape[:2])
            ours = nothing(*left.shape[:2])
        else:
            assert view.world_from_left is not None
            assert previous.world_from_left is not None
            curr_from_prev = view.world_from_left.inverse() @ previous.world_from_left
            matrix = uvd_curr_from_prev(footage.rig, curr_from_prev)
        iterations = 4 if previous is None else 1
        inputs = StepInputs(left[None], right[None], matrix[None], theirs)
        expected = reference.run(inputs, iterations)
        found = native[iterations].step(left, right, matrix, *ours)
        apart_px = np.abs(found.disparity - expected.disparity_px[0])
        assert (apart_px <= PARITY_PX).mean() >= WITHIN_PARITY
        relative = np.abs(found.sigma / expected.sigma_px[0] - 1)
        assert (relative <= PARITY_PX).mean() >= WITHIN_PARITY
        theirs, ours = expected.state, (found.next_disparity, found.next_hidden)
        previous = view


@pytest.mark.parametrize("iterations", [2, 8])
def test_many_iterations_give_the_answers_of_the_exported_graphs(
    make_step: MakeStep, reference: OnnxNetwork, iterations: int
) -> None:
    """Each iteration makes a difference ten times as large, so these show the smallest ones."""
    left, right = random_pair(*SIZE)
    state = reference.cold_state(*SIZE)
    expected = reference.run(StepInputs(left[None], right[None], STILL[None], state), iterations)
    found = make_step(iterations).step(left, right, STILL, *nothing(*SIZE))
    apart_px = np.abs(found.disparity - expected.disparity_px[0])
    assert (apart_px <= PARITY_PX).mean() >= WITHIN_PARITY


@pytest.mark.parametrize("variant", ["avx2", "avx2_vnni", "avx512_vnni", "neon_dot"])
def test_every_set_of_instructions_gives_the_bits_of_the_reference(
    make_step: MakeStep, variant: str
) -> None:
    if variant not in vergence_native.variants():
        pytest.skip(f"this CPU has no {variant}")
    reference = two_frames(make_step(variant="scalar"), *SIZE)
    assert_same_bits(two_frames(make_step(variant=variant), *SIZE), reference)


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_no_bit(make_step: MakeStep, threads: int) -> None:
    alone = two_frames(make_step(), *SIZE)
    assert_same_bits(two_frames(make_step(threads=threads), *SIZE), alone)


def test_steps_at_once_give_what_each_gives_alone(make_step: MakeStep) -> None:
    step = make_step(threads=2)
    seeds = range(6)
    alone = [two_frames(step, *SIZE, seed=seed) for seed in seeds]
    with ThreadPoolExecutor(3) as pool:
        together = [*pool.map(lambda seed: two_frames(step, *SIZE, seed=seed), seeds)]
    for some, others in zip(alone, together, strict=True):
        assert_same_bits(some, others)


def test_a_step_changes_neither_its_images_nor_its_state(make_step: MakeStep) -> None:
    step = make_step()
    pair, state = random_pair(*SIZE), nothing(*SIZE)
    given: list[np.ndarray] = [*pair, *state]
    before = [array.copy() for array in given]
    step.step(*pair, STILL, *state)
    for array, copy in zip(given, before, strict=True):
        assert (array == copy).all()


@settings(max_examples=12, deadline=None)
@given(rows=st.integers(1, 5), columns=st.integers(6, 12), seed=st.integers(0, 99))
def test_all_variants_agree_at_any_size(rows: int, columns: int, seed: int) -> None:
    size = (32 * rows, 32 * columns)
    results = []
    for variant in vergence_native.variants()[:-1]:  # the reference is slow
        step = LiteStep(graphs(1), iterations=1, variant=variant)
        results.append(two_frames(step, *size, seed=seed))
        step.close()
    for result in results[1:]:
        assert_same_bits(result, results[0])


@settings(max_examples=60, deadline=None)
@given(height=st.integers(0, 2100), width=st.integers(0, 2100))
def test_a_size_that_is_no_multiple_is_refused(height: int, width: int) -> None:
    if height and not height % 32 and not width % 32 and width >= 192:
        return
    image = np.zeros((height, width, 3), np.uint8)
    with pytest.raises(ValueError, match="expected"):
        _shared().step(image, image, STILL, *nothing(64, 192))


def test_an_image_of_four_megapixels_is_stepped(make_step: MakeStep) -> None:
    size = (1600, 2496)
    pair = random_pair(*size)
    result = make_step(threads=2).step(*pair, STILL, *nothing(*size))
    # Noise moved by 9 px, except near the left border.
    assert abs(float(np.median(result.disparity)) - 9) < 0.5


@pytest.mark.parametrize(
    ("index", "shape", "dtype"),
    [
        (0, (64, 192, 3), np.uint8),
        (1, (64, 224), np.uint8),
        (0, (64, 224, 3), np.float32),
        (2, (3, 3), np.float32),
        (2, (4, 4), np.float64),
        (3, (1, 16, 48), np.float32),
        (3, (16, 56), np.float32),
        (4, (32, 16, 56), np.float32),
        (4, (31, 8, 28), np.float32),
    ],
)
def test_an_array_of_another_shape_or_type_is_refused(
    make_step: MakeStep, index: int, shape: tuple[int, ...], dtype: type[np.generic]
) -> None:
    arrays: list[np.ndarray] = [*random_pair(*SIZE), STILL, *nothing(*SIZE)]
    arrays[index] = np.zeros(shape, dtype)
    left, right, matrix, disparity, hidden = arrays
    with pytest.raises(ValueError, match="expected"):
        make_step().step(left, right, matrix, disparity, hidden)


def test_odd_strides_are_read_as_they_are(make_step: MakeStep) -> None:
    step = make_step()
    left, right = random_pair(*SIZE)
    plain = step.step(left, right, STILL, *nothing(*SIZE))
    wide = np.zeros((SIZE[0], SIZE[1] + 5, 4), np.uint8)
    wide[:, 2:-3, :3] = left
    strided = step.step(
        wide[:, 2:-3, :3], right[::-1].copy()[::-1], STILL.T.copy().T, *nothing(*SIZE)
    )
    assert_same_bits([strided], [plain])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_a_state_of_any_value_is_stepped_or_refused(make_step: MakeStep, value: float) -> None:
    step = make_step()
    disparity, hidden = nothing(*SIZE)
    disparity[:] = value
    hidden[::2] = value
    try:
        result = step.step(*random_pair(*SIZE), STILL, disparity, hidden)
    except NotFinite:
        return
    assert np.isfinite(result.disparity).all()


def test_a_motion_that_is_not_finite_is_refused(make_step: MakeStep) -> None:
    with pytest.raises(NotFinite, match="motion"):
        make_step().step(*random_pair(*SIZE), STILL * np.float32(np.nan), *nothing(*SIZE))


def test_a_variant_that_this_cpu_lacks_is_refused() -> None:
    with pytest.raises(NativeUnavailable, match="this CPU has no mmx; it has"):
        LiteStep(graphs(1), iterations=1, variant="mmx")


def test_a_missing_library_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from vergence_native import library

    monkeypatch.setattr(library, "__file__", str(tmp_path / "library.py"))
    with pytest.raises(NativeUnavailable, match="no C compiler"):
        library.library.__wrapped__()


_SHARED: list[LiteStep] = []


def _shared() -> LiteStep:
    if not _SHARED:
        _SHARED.append(LiteStep(graphs(1), iterations=1))
    return _SHARED[0]
