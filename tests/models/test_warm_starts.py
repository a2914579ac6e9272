"""A network with flow_init starts from its last disparity, moved to the new pose."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from tests.support.foreign_graphs import (
    FLOW_CELL_PX,
    HEIGHT,
    REACH_PX,
    WIDTH,
    refining,
    written,
)
from tests.support.moved_flow import moved_flow
from tests.support.server import running_server
from tests.support.session_frames import EXACT
from vergence import Delivery, DepthClient, Origin
from vergence_models.foreign.adding import Added, add_model, check_model
from vergence_models.foreign.contract import ContractError, SigmaFrom
from vergence_models.foreign.files import write_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import texture
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import PoseSample
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel
from vergence_service.inference.snapshots import state_from_bytes, state_to_bytes

BASELINE_M = 0.1
RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, BASELINE_M)
WALL_PX, BOARD_PX = 5, 30
FRAMES = 5
STEP_PX = 2  # with each frame the wall moves so far to the left, and the board six times as far
BOARD = slice(HEIGHT // 4, 3 * HEIGHT // 4)  # rows
NS = 33_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth_px: NDArray[np.float32]
    pose: Pose
    capture_ns: int

    @property
    def view(self) -> StereoView:
        return StereoView(self.left, self.right, RIG, self.capture_ns, self.pose)


def board_at(shift_px: int) -> slice:
    """The columns of the board, from a camera that moved so that the wall moved so far."""
    first = 150 - shift_px * BOARD_PX // WALL_PX
    return slice(first, first + 80)


def seen_from(shift_px: int) -> NDArray[np.uint8]:
    view = texture(HEIGHT, 3 * WIDTH, 21)[:, WIDTH + shift_px : 2 * WIDTH + shift_px].copy()
    view[BOARD, board_at(shift_px)] = texture(HEIGHT, 80, 22)[BOARD]
    return view


def frames() -> list[Frame]:
    """A camera that moves to the right. Its motion is a whole number of pixels at each depth."""
    made = []
    for i in range(FRAMES):
        shift = STEP_PX * i
        columns = board_at(shift)
        truth = np.full((HEIGHT, WIDTH), WALL_PX, np.float32)
        truth[BOARD, columns.start - (BOARD_PX - WALL_PX) : columns.start] = np.nan  # hidden
        truth[BOARD, columns] = BOARD_PX
        pose = Pose(np.eye(3), np.array([BASELINE_M * shift / WALL_PX, 0.0, 0.0]))
        left, right = seen_from(shift), seen_from(shift + WALL_PX)
        made.append(Frame(left, right, truth, pose, (i + 1) * NS))
    return made


@pytest.fixture(scope="module")
def footage() -> list[Frame]:
    return frames()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def added(folder: Path) -> Added:
    paths = {
        count: written(refining(count), folder / f"raft_{count}.of-others") for count in (1, 2)
    }
    return add_model(paths, folder, name="raft", given=Given(like="raft-stereo"))


@pytest.fixture(scope="module")
def model(folder: Path, added: Added) -> OnnxStereoModel:
    assert added.contract.warm_start is not None
    return OnnxStereoModel(folder, "raft", providers=["cpu"], threads=1, allow_spinning=False)


def walk(
    model: OnnxStereoModel, footage: list[Frame], iterations: Callable[[int], int], *, warm: bool
) -> list[NDArray[np.float32]]:
    state: RecurrentState | None = None
    maps = []
    for i, frame in enumerate(footage):
        [result] = model.step([Step(frame.view, state if warm else None, iterations(i))])
        state = result.state
        maps.append(result.offset_px)
    return maps


def epe(found: NDArray[np.float32], frame: Frame) -> float:
    inner = (slice(6, -6), slice(WALL_PX + 4, -6))
    return float(np.nanmean(np.abs(found - frame.truth_px)[inner]))


def test_the_contract_has_the_flow_and_the_state_is_one_disparity(
    added: Added, model: OnnxStereoModel
) -> None:
    warm = added.contract.warm_start
    assert warm is not None
    assert (warm.input, warm.scale, warm.factor) == ("flow_init", 4, -1 / 4)
    [tensor] = model.card.state
    assert (tensor.name, tensor.channels, tensor.scale) == ("disparity", 1, FLOW_CELL_PX)
    assert model.card.recurrent


def test_one_warm_iteration_is_as_good_as_two_cold_ones_and_better_than_one(
    model: OnnxStereoModel, footage: list[Frame]
) -> None:
    warm = walk(model, footage, lambda i: 1 if i else 2, warm=True)
    many = walk(model, footage, lambda _: 2, warm=False)
    few = walk(model, footage, lambda _: 1, warm=False)
    errors = [
        np.mean([epe(found, frame) for found, frame in zip(maps[1:], footage[1:], strict=True)])
        for maps in (warm, many, few)
    ]
    assert errors[0] < 1.1 * errors[1]
    assert errors[0] < 0.2 * errors[2]


def test_without_the_pose_the_start_is_in_the_wrong_place(
    model: OnnxStereoModel, footage: list[Frame]
) -> None:
    """The board moves by 12 px a frame: further than a warm iteration looks."""
    [first] = model.step([Step(footage[0].view, None, 2)])
    moved, still = (
        StereoView(each.left, each.right, RIG, each.capture_ns, pose)
        for each, pose in ((footage[1], footage[1].pose), (footage[1], footage[0].pose))
    )
    errors = [
        epe(model.step([Step(view, first.state, 1)])[0].offset_px, footage[1])
        for view in (moved, still)
    ]
    assert errors[0] < 0.5 * errors[1]


def in_torch(frame: Frame, flow_init: torch.Tensor) -> torch.Tensor:
    """One iteration of :func:`refining` in PyTorch: disparity [H, W]."""
    left, right = (
        torch.from_numpy(each.astype(np.float32)).mean(dim=2)[None, None]
        for each in (frame.left, frame.right)
    )
    large = F.interpolate(flow_init[:, :1], scale_factor=FLOW_CELL_PX, mode="nearest")
    start = torch.round(large * -FLOW_CELL_PX)
    columns = torch.arange(WIDTH)[None, None, None, :] - start
    costs = []
    for step in range(-REACH_PX, REACH_PX + 1):
        index = (columns - step).clamp(0, WIDTH - 1).long()
        costs.append((left - right.gather(3, index)).abs())
    cost = F.avg_pool2d(torch.cat(costs, dim=1), 7, stride=1, padding=3)
    return (start[:, 0] + cost.argmin(dim=1) - REACH_PX)[0]


def test_over_a_sequence_the_answers_are_those_of_pytorch_with_the_same_flow(
    model: OnnxStereoModel, footage: list[Frame]
) -> None:
    turned = np.radians(0.7)
    rotation = np.array(
        [
            [np.cos(turned), 0, np.sin(turned)],
            [0, 1, 0],
            [-np.sin(turned), 0, np.cos(turned)],
        ]
    )
    [result] = model.step([Step(footage[0].view, None, 2)])
    for i, frame in enumerate(footage[1:], start=1):
        # Poses that also turn: the warp must agree where cells do not land on cells.
        pose = Pose(np.linalg.matrix_power(rotation, i), frame.pose.translation_m)
        view = StereoView(frame.left, frame.right, RIG, frame.capture_ns, pose)
        step = Step(view, result.state, 1)
        flow = moved_flow(result.offset_px, step.uvd_curr_from_prev, cell_px=FLOW_CELL_PX)
        [result] = model.step([step])
        expected = in_torch(frame, flow).numpy()
        same = np.abs(result.offset_px - expected) < 1e-3
        # A cell that lands on the very edge of two, or two equal costs, may fall either way.
        assert same.mean() > 0.998


def test_a_state_that_was_written_and_read_gives_the_same_bits(
    model: OnnxStereoModel, footage: list[Frame]
) -> None:
    [first] = model.step([Step(footage[0].view, None, 2)])
    kept = state_from_bytes(state_to_bytes(first.state))
    once, again = (
        model.step([Step(footage[1].view, state, 1)])[0] for state in (first.state, kept)
    )
    np.testing.assert_array_equal(once.offset_px, again.offset_px)
    assert again.state.step_count == 2


async def test_a_session_is_warm_is_reset_and_resumes(
    model: OnnxStereoModel, footage: list[Frame]
) -> None:
    async with (
        running_server(model, model__min_range_share=0) as server,
        DepthClient(server.grpc_address) as client,
    ):

        async def step(session: Any, frame: Frame) -> Any:
            pose = PoseSample(frame.pose)
            return await asyncio.wait_for(
                session.step(frame.left, frame.right, pose, capture_ns=frame.capture_ns), 20
            )

        options: dict[str, Any] = {"delivery": Delivery.EVERY, "output": EXACT, "stream_id": "s"}
        async with client.open_session(RIG, **options) as session:
            assert session.model.recurrent
            results = [await step(session, each) for each in footage[:2]]
            async with client.open_session(
                RIG, resume_token=session.resume_token, **options
            ) as resumed:
                results.append(await step(resumed, footage[2]))
                resumed.reset()
                results.append(await step(resumed, footage[3]))
    assert [(each.origin, each.step_count, each.iterations) for each in results] == [
        (Origin.COLD_START, 1, 2),
        (Origin.WARM, 2, 1),
        (Origin.RESUMED, 3, 1),
        (Origin.RESET_REQUESTED, 1, 2),
    ]
    expected = walk(model, footage[:3], lambda i: 1 if i else 2, warm=True)
    for each, same in zip(results, expected, strict=False):
        found = each.disparity_px
        np.testing.assert_array_equal(found[found > 0], same[found > 0])


def test_a_flow_of_the_wrong_sign_is_refused(folder: Path, added: Added, tmp_path: Path) -> None:
    warm = added.contract.warm_start
    assert warm is not None
    wrong = replace(added.contract, warm_start=replace(warm, factor=-warm.factor))
    networks = {count: folder / f"raft.{count}.onnx" for count in (1, 2)}
    write_model(tmp_path, "wrong", wrong, networks, proven=True)
    with pytest.raises(ContractError, match=r"warm start: .* from the last disparity"):
        check_model(tmp_path, "wrong")
    assert check_model(folder, "raft").contract == added.contract


def test_without_a_warm_start_the_flow_is_zero_and_the_model_has_no_memory(
    folder: Path, added: Added, model: OnnxStereoModel, footage: list[Frame], tmp_path: Path
) -> None:
    path = folder / "raft_2.of-others"
    sigmas: tuple[SigmaFrom, ...] = ("constant", "left-right")
    for sigma in sigmas:
        given = Given(like="raft-stereo", warm_start=False, sigma=sigma)
        add_model({1: path}, tmp_path, name=sigma, given=given)
        cold = OnnxStereoModel(tmp_path, sigma, providers=["cpu"], threads=1, allow_spinning=False)
        assert not cold.card.recurrent
        step = Step(footage[0].view, None, 1)
        [result], [same] = cold.step([step]), model.step([Step(footage[0].view, None, 2)])
        np.testing.assert_array_equal(result.offset_px, same.offset_px)
