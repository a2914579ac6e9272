"""`lite` as a network of others that takes a flow: a trained network on a sequence it never saw."""

import logging
from pathlib import Path

import numpy as np
import pytest

from tests.support.foreign_graphs import BYTES, written
from tests.support.wrapped_lite import Face, Wrapped
from vergence_models.evaluate import WEIGHTS
from vergence_models.evaluation.stepping import footage_from_source
from vergence_models.foreign.adding import add_model
from vergence_models.foreign.guess import Given
from vergence_proto.datasets import open_source
from vergence_proto.model_io import load_model_card
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

log = logging.getLogger(__name__)

ROOM = Path(__file__).parents[2] / "client" / "vergence" / "sample" / "room"
FEW, MANY = 1, 4
SETTLED = 3  # frames after which the start is forgotten
FRAMES = 12
NS = 33_000_000


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> OnnxStereoModel:
    """RAFT-Stereo's contract, with flow_init, round the weights of `lite`."""
    folder = tmp_path_factory.mktemp("theirs")
    card = load_model_card(WEIGHTS, "lite")
    height, width = 480, 640
    face = Face(
        {
            "image1": [1, 3, height, width],
            "image2": [1, 3, height, width],
            "flow_init": [1, 2, height // 4, width // 4],
        },
        lambda _: ("image1", "image2"),
        BYTES,
        "flow_up",
        -1.0,
        Given(like="raft-stereo"),
    )
    paths = {}
    for count in (FEW, MANY):
        wrapped = Wrapped(card, (height, width), iterations=count, flow="flow_init")
        paths[count] = written(wrapped.model(face), folder / f"raft_{count}.of-others")
    added = add_model(paths, folder, name="raft", given=face.given)
    assert added.contract.warm_start is not None
    return OnnxStereoModel(folder, "raft", providers=["cpu"], threads=1, allow_spinning=False)


@pytest.mark.slow  # two proofs and forty steps of `lite` at 640x480
def test_one_warm_iteration_is_better_than_four_cold_ones(model: OnnxStereoModel) -> None:
    footage = footage_from_source(open_source(f"vergence:{ROOM}"))
    views = footage.views[:FRAMES]

    def epe(cold: int, warm: int | None) -> float:
        state: RecurrentState | None = None
        errors = []
        for i, each in enumerate(views):
            view = StereoView(each.left, each.right, footage.rig, i * NS, each.world_from_left)
            count = cold if warm is None or state is None else warm
            [result] = model.step([Step(view, None if warm is None else state, count)])
            state = result.state
            assert each.truth_px is not None
            errors.append(np.nanmean(np.abs(result.offset_px - each.truth_px)))
        return float(np.mean(errors[SETTLED:]))

    warm, few, many = epe(MANY, FEW), epe(FEW, None), epe(MANY, None)
    log.info("EPE: %.3f px warm with 1, %.3f cold with 4, %.3f cold with 1", warm, many, few)
    assert warm < many < few
