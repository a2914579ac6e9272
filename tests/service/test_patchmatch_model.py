"""PatchMatch is served as any model with memory: its planes go from frame to frame."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.support.server import running_server
from tests.support.session_frames import EXACT
from vergence import Delivery, DepthClient, Origin
from vergence_proto.datasets import open_source
from vergence_proto.model_io import CLASSICAL_MODELS
from vergence_service.app.server import make_model
from vergence_service.inference.installed import ProviderUnavailable
from vergence_service.inference.model import Step, StereoView, state_bytes
from vergence_service.inference.patchmatch_model import PatchMatchModel
from vergence_service.inference.tensors import on_host
from vergence_service.settings import load_settings

ROOM = f"vergence:{Path(__file__).parents[2] / 'client/vergence/sample/room'}"


@pytest.fixture(scope="module")
def model() -> Iterator[PatchMatchModel]:
    with closing(make_model(load_settings(flags={"model.name": "patchmatch"}))) as model:
        assert isinstance(model, PatchMatchModel)
        yield model


async def test_over_the_wire_a_frame_starts_from_the_planes_of_the_one_before(
    model: PatchMatchModel,
) -> None:
    source = open_source(ROOM)
    entries = [entry for entry, _ in zip(source, range(2), strict=False)]
    rig = source.rig.as_rectified()
    assert rig is not None
    async with (
        running_server(model) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(rig, delivery=Delivery.EVERY, output=EXACT) as session,
    ):
        results = [
            await session.step(
                each.frame.left, each.frame.right, each.frame.pose, capture_ns=each.frame.capture_ns
            )
            for each in entries
        ]
        assert session.model.recurrent
    assert [each.step_count for each in results] == [1, 2]
    assert [each.origin for each in results] == [Origin.COLD_START, Origin.WARM]
    state = None
    for entry, result in zip(entries, results, strict=True):
        frame = entry.frame
        assert frame.pose is not None
        view = StereoView(
            frame.left, frame.right, rig, frame.capture_ns, frame.pose.world_from_left
        )
        [step] = model.step([Step(view, state, result.iterations)])
        state = step.state
        assert state.nbytes == state_bytes(model.card, rig.height, rig.width)
        found = result.disparity_px
        # The pose of the wire is rounded, which may change the last bits of a warm step.
        apart = np.abs(found - step.offset_px)[found > 0]
        assert np.mean(apart < (1e-3 if result.step_count > 1 else 1e-9)) > 0.999
        assert np.mean(found > 0) > 0.9
        # It knows where it is right.
        assert entry.truth_px is not None
        known = np.isfinite(entry.truth_px) & (entry.truth_px > 0)
        error = np.abs(step.offset_px - entry.truth_px)
        sure = step.sigma_px < 1
        assert 0.4 < sure.mean() < 0.95
        assert error[known & ~sure].mean() > 3 * error[known & sure].mean()


def test_any_size_is_matched_and_no_row_depends_on_its_neighbours(model: PatchMatchModel) -> None:
    random = np.random.default_rng(4)
    for height, width in ((33, 47), (48, 301)):
        left = random.integers(0, 255, (height, width, 3), np.uint8).repeat(2, axis=1)[:, :width]
        view = StereoView(left, np.roll(left, -6, axis=1), None, 1)  # type: ignore[arg-type]
        one, two = model.step([Step(view, None, 2)] * 2)
        np.testing.assert_array_equal(one.offset_px, two.offset_px)
        assert one.offset_px.shape == one.sigma_px.shape == view.left.shape[:2]
        assert np.isfinite(one.offset_px).all()
        assert np.isfinite(on_host(one.state.tensors[0])).all()
    assert np.median(one.offset_px[8:-8, 30:-8]) == pytest.approx(6, abs=0.3)


def test_another_engine_is_refused() -> None:
    flags = {"model.name": "patchmatch", "model.engine": "onnxruntime"}
    with pytest.raises(ProviderUnavailable, match="OpenCV computes patchmatch"):
        make_model(load_settings(flags=flags))


def test_every_classical_model_is_served_with_the_memory_that_lists_say() -> None:
    for name, remembers in CLASSICAL_MODELS.items():
        with closing(make_model(load_settings(flags={"model.name": name}))) as model:
            assert (model.card.name, model.card.recurrent) == (name, remembers)
