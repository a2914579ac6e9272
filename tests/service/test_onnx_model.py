"""The served model itself, with the weights that ship: batches, sizes, failures."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from tests.support.frames import make_frame
from tests.support.weights_copy import WEIGHTS
from vergence_proto.errors import NonFinite
from vergence_proto.geometry import RectifiedRig
from vergence_service.inference.model import (
    RecurrentState,
    Step,
    StepResult,
    StereoView,
    state_bytes,
)
from vergence_service.inference.onnx_model import OnnxStereoModel, on_host, packaged_weights_dir
from vergence_service.inference.providers import (
    PROVIDERS,
    DeviceTensor,
    ProviderUnavailable,
    require_provider,
)
from vergence_service.inference.snapshots import state_from_bytes, state_to_bytes

# 250 x 130: neither is a multiple of any stride.
RIG = RectifiedRig(250, 130, 200.0, 200.0, 124.5, 124.5, 64.5, 0.1)


def make_model(
    name: str = "lite",
    *,
    threads: int = 1,
    weights: Path | None = None,
    states_on: str | None = None,
) -> OnnxStereoModel:
    return OnnxStereoModel(
        weights or packaged_weights_dir(),
        name,
        providers=["cpu"],
        threads=threads,
        allow_spinning=False,
        states_on=states_on,
    )


@pytest.fixture(scope="module")
def model() -> OnnxStereoModel:
    return make_model(threads=2)


def make_view(frame_id: int, seed: int, rig: RectifiedRig = RIG) -> StereoView:
    frame = make_frame(frame_id, brightness=seed, rig=rig)
    assert frame.pose is not None
    bright = np.random.default_rng(seed).integers(0, 255, (rig.height, rig.width, 1), np.uint8)
    left = np.repeat(bright, 3, axis=2)
    world_from_left = frame.pose.world_from_left
    return StereoView(left, np.roll(left, -7, axis=1), rig, frame.capture_ns, world_from_left)


def walk(model: OnnxStereoModel, seed: int, *, frames: int) -> list[StepResult]:
    state: RecurrentState | None = None
    results = []
    for i in range(1, frames + 1):
        [result] = model.step([Step(make_view(i, seed), state, 1)])
        results.append(result)
        state = result.state
    return results


def test_streams_in_one_batch_get_bit_for_bit_what_each_gets_alone(model: OnnxStereoModel) -> None:
    seeds = (1, 2, 3)
    alone = [walk(model, seed, frames=3) for seed in seeds]
    states: list[RecurrentState | None] = [None] * len(seeds)
    for i in range(3):
        batch = [
            Step(make_view(i + 1, seed), state, 1)
            for seed, state in zip(seeds, states, strict=True)
        ]
        results = model.step(batch)
        states = [result.state for result in results]
        for row, result in enumerate(results):
            np.testing.assert_array_equal(result.offset_px, alone[row][i].offset_px)
            np.testing.assert_array_equal(result.sigma_px, alone[row][i].sigma_px)


def test_warm_and_cold_streams_share_a_batch(model: OnnxStereoModel) -> None:
    [first] = model.step([Step(make_view(1, 5), None, 1)])
    warm, cold = Step(make_view(2, 5), first.state, 1), Step(make_view(1, 6), None, 1)
    together = model.step([warm, cold])
    for step, shared in zip((warm, cold), together, strict=True):
        np.testing.assert_array_equal(shared.offset_px, model.step([step])[0].offset_px)
    assert [result.state.step_count for result in together] == [2, 1]


def test_a_step_changes_neither_its_state_nor_its_images(model: OnnxStereoModel) -> None:
    [first] = model.step([Step(make_view(1, 7), None, 1)])
    before = [on_host(tensor).copy() for tensor in first.state.tensors]
    step = Step(make_view(2, 7), first.state, 1)
    once, again = model.step([step])[0], model.step([step])[0]
    np.testing.assert_array_equal(once.offset_px, again.offset_px)
    for tensor, copy in zip(first.state.tensors, before, strict=True):
        np.testing.assert_array_equal(tensor, copy)


def test_any_size_is_served_at_its_size(model: OnnxStereoModel) -> None:
    [result] = model.step([Step(make_view(1, 8), None, 1)])
    assert result.offset_px.shape == result.sigma_px.shape == (RIG.height, RIG.width)
    assert result.state.nbytes == state_bytes(model.card, RIG.height, RIG.width)


@pytest.mark.parametrize("size", [(1, 1), (48, 64), (32, 192)], ids=str)
def test_images_narrower_than_the_largest_disparity_are_served(
    model: OnnxStereoModel, size: tuple[int, int]
) -> None:
    view = make_view(1, 8)
    height, width = size
    small = StereoView(view.left[:height, :width], view.right[:height, :width], RIG, 1)
    [result] = model.step([Step(small, None, 1)])
    assert result.offset_px.shape == size


def test_padding_is_the_edge_repeated(model: OnnxStereoModel) -> None:
    view = make_view(1, 9)
    height, width = model.card.step_size(RIG.height, RIG.width)
    assert height > RIG.height
    assert width > RIG.width
    around = ((0, height - RIG.height), (0, width - RIG.width), (0, 0))
    left, right = (np.pad(image, around, mode="edge") for image in (view.left, view.right))
    padded = StereoView(left, right, RIG, view.capture_ns, view.world_from_left)
    [whole] = model.step([Step(padded, None, 1)])
    [cropped] = model.step([Step(view, None, 1)])
    expected = whole.offset_px[: RIG.height, : RIG.width]
    np.testing.assert_array_equal(cropped.offset_px, expected)


def test_a_result_that_is_not_finite_is_not_passed_on() -> None:
    """The graph of the test weights divides by brightness."""
    model = make_model("reciprocal", weights=WEIGHTS)
    bright = np.full((8, 8, 3), 50, np.uint8)
    [result] = model.step([Step(StereoView(bright, bright, RIG, 1), None, 1)])
    np.testing.assert_allclose(result.offset_px, 1 / 150, rtol=1e-6)
    black = bright.copy()
    black[3, 4] = 0
    with pytest.raises(NonFinite):
        model.step([Step(StereoView(black, bright, RIG, 1), None, 1)])


def test_states_that_stay_on_their_device_change_no_result(model: OnnxStereoModel) -> None:
    """The path of a GPU, taken on the only device that is everywhere."""
    resident = make_model(states_on="cpu", threads=2)
    for mine, plain in zip(walk(resident, 4, frames=3), walk(model, 4, frames=3), strict=True):
        np.testing.assert_array_equal(mine.offset_px, plain.offset_px)
        np.testing.assert_array_equal(mine.sigma_px, plain.sigma_px)
        assert all(isinstance(tensor, DeviceTensor) for tensor in mine.state.tensors)
        assert mine.state.nbytes == plain.state.nbytes
        for tensor, same in zip(mine.state.tensors, plain.state.tensors, strict=True):
            np.testing.assert_array_equal(on_host(tensor), on_host(same))


def test_a_state_that_stayed_joins_a_batch_and_a_snapshot() -> None:
    resident = make_model(states_on="cpu", threads=2)
    [stayed] = resident.step([Step(make_view(1, 5), None, 1)])
    kept = state_from_bytes(state_to_bytes(stayed.state))
    cold = Step(make_view(1, 6), None, 1)
    by_stayed, by_kept = (
        resident.step([Step(make_view(2, 5), state, 1), cold]) for state in (stayed.state, kept)
    )
    for result, same in zip(by_stayed, by_kept, strict=True):
        assert result.state.step_count == same.state.step_count
        np.testing.assert_array_equal(result.offset_px, same.offset_px)
    [alone], [again] = (
        resident.step([Step(make_view(3, 5), results[0].state, 1)])
        for results in (by_stayed, by_kept)
    )
    np.testing.assert_array_equal(alone.offset_px, again.offset_px)


@pytest.mark.parametrize(
    ("provider", "wheel"),
    [
        ("cuda", "onnxruntime-gpu"),
        ("tensorrt", "onnxruntime-gpu"),
        ("openvino", "onnxruntime-openvino"),
    ],
)
def test_a_provider_that_is_not_there_is_refused_with_what_to_install(
    provider: str, wheel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As the wheel of the server extra has it, whichever one is installed here.
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [PROVIDERS["cpu"]])
    says = rf"'{provider}' is not available.*it has cpu\. .*pip install {wheel}$"
    with pytest.raises(ProviderUnavailable, match=says):
        OnnxStereoModel(
            packaged_weights_dir(), "lite", providers=[provider], threads=1, allow_spinning=False
        )
    assert require_provider("cpu") == PROVIDERS["cpu"]
