"""Steps in stages: two models of the test weights do the same, one of them in three graphs."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnxruntime import InferenceSession
from onnxruntime.capi.onnxruntime_pybind11_state import InvalidArgument

from tests.support.frames import make_frame
from tests.support.weights_copy import WEIGHTS, Entry, copied_weights
from vergence_proto.geometry import RectifiedRig
from vergence_proto.model_io import ManifestError
from vergence_service.inference import graphs as graphs_module
from vergence_service.inference.model import RecurrentState, Step, StepResult, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel, on_host
from vergence_service.inference.providers import DeviceTensor, start_session

RIG = RectifiedRig(70, 40, 50.0, 50.0, 34.5, 34.5, 19.5, 0.1)
WHITE = 255  # that the graphs fail on


@contextmanager
def opened(
    name: str, *, threads: int = 2, weights: Path = WEIGHTS, states_on: str | None = None
) -> Iterator[OnnxStereoModel]:
    with closing(
        OnnxStereoModel(
            weights,
            name,
            providers=["cpu"],
            threads=threads,
            allow_spinning=False,
            states_on=states_on,
        )
    ) as model:
        yield model


def make_view(frame_id: int) -> StereoView:
    frame = make_frame(frame_id, rig=RIG)
    assert frame.pose is not None
    shape = (2, RIG.height, RIG.width, 3)
    left, right = np.random.default_rng(frame_id).integers(0, WHITE, shape, np.uint8)
    return StereoView(left, right, RIG, frame.capture_ns, frame.pose.world_from_left)


def walk(model: OnnxStereoModel, *, first: int = 1, frames: int = 4) -> list[StepResult]:
    """A sequence that starts with two iterations and continues with one."""
    state: RecurrentState | None = None
    results = []
    for i in range(first, first + frames):
        [result] = model.step([Step(make_view(i), state, 1 if state else 2)])
        results.append(result)
        state = result.state
    return results


def assert_same(one: StepResult, other: StepResult) -> None:
    np.testing.assert_array_equal(one.offset_px, other.offset_px)
    np.testing.assert_array_equal(one.sigma_px, other.sigma_px)
    for tensor, same in zip(one.state.tensors, other.state.tensors, strict=True):
        np.testing.assert_array_equal(on_host(tensor), on_host(same))


@pytest.mark.parametrize("states_on", [None, "cpu"], ids=["on the host", "on a device"])
@pytest.mark.parametrize("threads", [0, 1, 2])
def test_stages_answer_bit_for_bit_what_the_whole_graph_answers(
    threads: int, states_on: str | None
) -> None:
    with (
        opened("whole", threads=threads) as whole,
        opened("staged", threads=threads, states_on=states_on) as staged,
    ):
        expected, found = walk(whole), walk(staged)
    assert any((one.offset_px != expected[0].offset_px).any() for one in expected[1:])
    for one, other in zip(expected, found, strict=True):
        assert_same(one, other)
        assert all(
            isinstance(each, DeviceTensor) == bool(states_on) for each in other.state.tensors
        )


@pytest.fixture(scope="module", params=[2, 3, 4], ids="{} threads".format)
def laned(request: pytest.FixtureRequest) -> Iterator[OnnxStereoModel]:
    with opened("staged", threads=request.param) as model:
        yield model


@settings(max_examples=30, deadline=None)
@given(
    streams=st.lists(
        st.tuples(st.integers(1, 1000), st.integers(1, 12)), min_size=2, max_size=5, unique=True
    )
)
def test_streams_that_step_at_once_get_bit_for_bit_what_each_gets_alone(
    laned: OnnxStereoModel, streams: list[tuple[int, int]]
) -> None:
    alone = [walk(laned, first=first, frames=frames) for first, frames in streams]
    with ThreadPoolExecutor(laned.max_concurrent_steps) as threads:
        walks = [
            threads.submit(walk, laned, first=first, frames=frames) for first, frames in streams
        ]
    for expected, found in zip(alone, walks, strict=True):
        for one, other in zip(expected, found.result(), strict=True):
            assert_same(one, other)


@pytest.mark.parametrize(
    ("name", "threads", "states_on", "lanes"),
    [
        ("staged", 1, None, 1),
        ("staged", 2, None, 2),
        ("staged", 8, None, 2),
        ("staged", 2, "cpu", 1),
        ("whole", 2, None, 1),
    ],
    ids=["one thread", "two threads", "more threads than graphs", "a device", "no stages"],
)
def test_there_are_lanes_for_as_many_graphs_as_run_side_by_side(
    name: str, threads: int, states_on: str | None, lanes: int
) -> None:
    with opened(name, threads=threads, states_on=states_on) as model:
        assert model.max_concurrent_steps == lanes


def test_a_stream_that_fails_does_not_disturb_the_one_beside_it() -> None:
    bad = [Step(whiten(make_view(2), left=left, right=not left), None, 1) for left in (True, False)]
    with opened("staged") as model, ThreadPoolExecutor(1) as beside:
        expected = walk(model, frames=50)
        found = beside.submit(walk, model, frames=50)
        while not found.done():
            for step in bad:
                with pytest.raises(InvalidArgument, match="out of data bounds"):
                    model.step([step])
        for one, other in zip(expected, found.result(), strict=True):
            assert_same(one, other)
        assert_same(walk(model, frames=1)[0], expected[0])


def test_a_batch_of_staged_steps_gives_each_stream_its_own() -> None:
    with opened("staged", states_on="cpu") as model:
        first, second = (model.step([Step(make_view(i), None, 1)])[0] for i in (1, 2))
        steps = [
            Step(make_view(3), first.state, 1),
            Step(make_view(4), second.state, 1),
            Step(make_view(5), None, 1),
        ]
        for step, together in zip(steps, model.step(steps), strict=True):
            assert_same(model.step([step])[0], together)


def test_a_stream_starts_with_cold_graphs_and_goes_on_with_the_others(tmp_path: Path) -> None:
    def start_otherwise(entry: Entry) -> None:
        entry["cold_graphs"] = {"1": entry["graphs"]["2"]}
        entry["cold_max_pixels"] = RIG.width * RIG.height

    with opened("staged") as model:
        [first] = model.step([Step(make_view(1), None, 2)])
        [second] = model.step([Step(make_view(2), first.state, 1)])
    with opened("staged", weights=copied_weights(tmp_path, edit=start_otherwise)) as model:
        model.warm_up(1, 1)
        [begun] = model.step([Step(make_view(1), None, 1)])
        [gone_on] = model.step([Step(make_view(2), begun.state, 1)])
        [without] = model.step([Step(make_view(1), None, 2)])  # there is none for that count
    assert_same(begun, first)
    assert_same(gone_on, second)
    assert_same(without, first)


def test_images_that_are_too_large_for_cold_graphs_start_with_the_others(tmp_path: Path) -> None:
    def start_otherwise(entry: Entry) -> None:
        entry["cold_graphs"] = {"1": entry["graphs"]["2"]}
        entry["cold_max_pixels"] = RIG.width * RIG.height - 1

    with opened("staged", weights=copied_weights(tmp_path, edit=start_otherwise)) as model:
        [begun] = model.step([Step(make_view(1), None, 1)])
    with opened("staged") as model:
        [expected] = model.step([Step(make_view(1), None, 1)])
    assert_same(begun, expected)


def test_a_graph_that_several_counts_share_is_loaded_once(tmp_path: Path) -> None:
    weights = copied_weights(tmp_path)
    with opened("staged") as model:
        expected = walk(model)
    with opened("staged", weights=weights) as model:
        model.warm_up(1, 1)
        for shared in ("left.onnx", "right.onnx"):
            (weights / shared).unlink()
        for one, other in zip(expected, walk(model), strict=True):
            assert_same(one, other)


def test_a_step_whose_graphs_are_loaded_does_not_wait_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entered, may_go_on = threading.Event(), threading.Event()

    def start_slowly(*given: Any) -> InferenceSession:
        entered.set()
        assert may_go_on.wait(timeout=30)
        return start_session(*given)

    with opened("staged") as model, ThreadPoolExecutor() as threads:
        model.warm_up(1, 1)
        monkeypatch.setattr(graphs_module, "start_session", start_slowly)
        loading = threads.submit(model.warm_up, 2, 2)
        try:
            assert entered.wait(timeout=30)
            model.step([Step(make_view(1), None, 1)])
            assert not loading.done()
        finally:
            may_go_on.set()


def whiten(view: StereoView, *, left: bool, right: bool) -> StereoView:
    white = np.full_like(view.left, WHITE)
    return replace(view, left=white if left else view.left, right=white if right else view.right)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("left", "right"),
    [(True, False), (False, True), (True, True)],
    ids=["the first graph", "the second graph", "both"],
)
def test_an_error_in_a_graph_reaches_the_caller_and_the_next_step_works(
    left: bool, right: bool, threads: int
) -> None:
    with opened("staged", threads=threads) as model:
        expected = walk(model, frames=2)
        bad = whiten(make_view(2), left=left, right=right)
        for _ in range(3):
            with pytest.raises(InvalidArgument, match="out of data bounds"):
                model.step([Step(bad, expected[0].state, 1)])
            [again] = model.step([Step(make_view(2), expected[0].state, 1)])
            assert_same(again, expected[1])


def test_a_closed_model_leaves_no_thread_behind() -> None:
    before = set(threading.enumerate())
    with opened("staged") as model:
        walk(model)
        assert set(threading.enumerate()) > before
    assert set(threading.enumerate()) == before


Graphs = dict[str, list[list[str]]]


def without_the_first_stage(graphs: Graphs) -> None:
    del graphs["1"][0]


def without_the_last_stage(graphs: Graphs) -> None:
    del graphs["1"][1]


def all_in_one_stage(graphs: Graphs) -> None:
    graphs["1"] = [[*graphs["1"][0], *graphs["1"][1]]]


def a_stage_twice(graphs: Graphs) -> None:
    graphs["1"].insert(0, graphs["1"][0])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (without_the_first_stage, "expected left_light, moved, sigma from a graph of an earlier"),
        (without_the_last_stage, "no graph computes disparity, next_memory"),
        (all_in_one_stage, "expected left_light, moved, sigma from a graph of an earlier"),
        (a_stage_twice, "more than one graph computes left_light, moved"),
    ],
)
def test_graphs_that_do_not_fit_together_are_refused_when_they_are_loaded(
    tmp_path: Path, change: Callable[[Graphs], None], says: str
) -> None:
    def edit(entry: Entry) -> None:
        change(entry["graphs"])

    with opened("staged", weights=copied_weights(tmp_path, edit=edit)) as model:
        model.warm_up(2, 2)
        with pytest.raises(ManifestError, match=f"staged, 1 iterations: {says}"):
            model.warm_up(1, 1)
