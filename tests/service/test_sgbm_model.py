"""The classical baseline is served as any model without memory."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.support.server import running_server
from tests.support.session_frames import EXACT
from vergence import Delivery, DepthClient, Origin
from vergence_proto.datasets import open_source
from vergence_proto.sgbm import sgbm_disparity
from vergence_service.app.server import make_model
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.sgbm_model import SGBM_MODELS, SgbmModel
from vergence_service.settings import load_settings

ROOM = f"vergence:{Path(__file__).parents[2] / 'client/vergence/sample/room'}"


@pytest.fixture(scope="module", params=SGBM_MODELS)
def model(request: pytest.FixtureRequest) -> Iterator[SgbmModel]:
    with closing(make_model(load_settings(flags={"model.name": request.param}))) as model:
        assert isinstance(model, SgbmModel)
        yield model


async def test_over_the_wire_it_is_what_opencv_finds_and_it_knows_where_it_does_not_match(
    model: SgbmModel,
) -> None:
    source = open_source(ROOM)
    entry = next(iter(source))
    rig = source.rig.as_rectified()
    assert rig is not None
    async with (
        running_server(model) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(rig, delivery=Delivery.EVERY, output=EXACT) as session,
    ):
        frame = entry.frame
        result = await session.step(
            frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns
        )
        assert not session.model.recurrent
        assert session.model.name == model.card.name
    assert (result.origin, result.step_count) == (Origin.COLD_START, 1)
    direct = sgbm_disparity(
        frame.left,
        frame.right,
        max_disparity_px=model.card.max_disparity_px,
        scale=SGBM_MODELS[model.card.name],
    )
    found = result.disparity_px
    np.testing.assert_array_equal(found[found > 0], direct[found > 0])
    assert np.mean(found > 0) > 0.95
    # The step itself says how sure it is: where it did not match, it is off by more.
    [step] = model.step([Step(StereoView(frame.left, frame.right, rig, 1), None, 1)])
    assert entry.truth_px is not None
    known = np.isfinite(entry.truth_px) & (entry.truth_px > 0)
    error = np.abs(step.offset_px - entry.truth_px)
    sure = step.sigma_px < 1
    assert 0.8 < sure.mean() < 1
    assert error[known & ~sure].mean() > 2 * error[known & sure].mean()
    within = error[known & sure] < step.sigma_px[known & sure] * np.log(2)
    assert 0.4 < within.mean() < 0.65


def test_any_size_is_matched_and_no_row_depends_on_its_neighbours(model: SgbmModel) -> None:
    random = np.random.default_rng(4)
    views = []
    for height, width in ((33, 47), (48, 300)):
        left = random.integers(0, 255, (height, width, 3), np.uint8)
        rig_view = StereoView(left, np.roll(left, -6, axis=1), None, 1)  # type: ignore[arg-type]
        views.append(rig_view)
    for view in views:
        one, two = model.step([Step(view, None, 1)] * 2)
        np.testing.assert_array_equal(one.offset_px, two.offset_px)
        assert one.offset_px.shape == one.sigma_px.shape == view.left.shape[:2]
        assert one.state.tensors == ()
        assert np.isfinite(one.offset_px).all()
    assert np.median(one.offset_px[8:-8, 30:-8]) == pytest.approx(6, abs=0.3)


def test_without_onnxruntime_the_classical_baseline_is_served_and_nothing_else() -> None:
    program = """
import sys
sys.modules["onnxruntime"] = None
from vergence_service.app.server import make_model
from vergence_service.inference.installed import ProviderUnavailable
from vergence_service.settings import load_settings
print(make_model(load_settings(flags={"model.name": "sgbm"})).engine)
try:
    make_model(load_settings())
except ProviderUnavailable as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    engine, refused = done.stdout.splitlines()
    assert engine.startswith("OpenCV")
    assert refused.startswith("lite needs onnxruntime, which is not installed; install it: ")
    assert refused.endswith("--model sgbm")
