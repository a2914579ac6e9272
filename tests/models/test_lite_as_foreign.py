"""`lite` behind the face of a foreign network, added back: the same bits as `lite` itself."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.foreign_graphs import BYTES, IMAGENET, UNIT, written
from tests.support.wrapped_lite import Face, Shape, Wrapped
from vergence_models.evaluate import WEIGHTS
from vergence_models.foreign.adding import add_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import scene
from vergence_proto.geometry import RectifiedRig
from vergence_proto.model_io import (
    load_model_card,
)
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

HEIGHT, WIDTH = 96, 192
RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 95.5, 95.5, 47.5, 0.1)
ITERATIONS = 1


def halved(graph: Wrapped) -> tuple[str, str]:
    """CREStereo's four images. The small ones are looked at, and change nothing."""
    views = []
    for side in ("left", "right"):
        small = graph.add("ReduceMean", f"init_{side}", keepdims=1)
        nothing = graph.add("Mul", small, graph.constant(0))
        views.append(graph.add("Add", f"next_{side}", nothing))
    return views[0], views[1]


def cut(graph: Wrapped) -> tuple[str, str]:
    ends = [graph.constant([each], np.int64) for each in (0, 3, 6)]
    axis = graph.constant([1], np.int64)
    left, right = (graph.add("Slice", "input", ends[i], ends[i + 1], axis) for i in (0, 1))
    return left, right


def turned(graph: Wrapped) -> tuple[str, str]:
    left, right = (graph.add("Transpose", each, perm=[0, 3, 1, 2]) for each in ("a", "b"))
    return left, right


_LARGE: Shape = [1, 3, HEIGHT, WIDTH]
_SMALL: Shape = [1, 3, HEIGHT // 2, WIDTH // 2]
FACES = {
    "negative": Face(
        {"x1": _LARGE, "x2": _LARGE}, lambda _: ("x1", "x2"), BYTES, "output", -1.0,
        Given(like="raft-stereo"),
    ),
    "normalised, channels last": Face(
        {"a": [1, HEIGHT, WIDTH, 3], "b": [1, HEIGHT, WIDTH, 3]}, turned, IMAGENET, "disp", 1.0,
        Given(pixels="imagenet", factor=1.0),
    ),
    "joined": Face(
        {"input": [1, 6, HEIGHT, WIDTH]}, cut, UNIT, "reference_output_disparity", 1.0,
        Given(like="hitnet"), channels_last=True,
    ),
    "half-size twin": Face(
        {"init_left": _SMALL, "init_right": _SMALL, "next_left": _LARGE, "next_right": _LARGE},
        halved, BYTES, "next_output", 1.0, Given(like="crestereo"),
    ),
}  # fmt: skip


# Proofs of `lite` take seconds; CI has time for all four.
_QUICK = ("negative", "half-size twin")


@pytest.mark.parametrize(
    "kind",
    [kind if kind in _QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in FACES],
)
def test_lite_behind_a_foreign_face_gives_the_bits_of_lite(kind: str, tmp_path: Path) -> None:
    face = FACES[kind]
    card = load_model_card(WEIGHTS, "lite")
    path = written(Wrapped(card, (HEIGHT, WIDTH)).model(face), tmp_path / "theirs.onnx")
    added = add_model({1: path}, tmp_path, name="lite-of-others", given=face.given)
    assert added.contract.factor == face.factor
    foreign, own = (
        OnnxStereoModel(folder, name, providers=["cpu"], threads=1, allow_spinning=False)
        for folder, name in ((tmp_path, "lite-of-others"), (WEIGHTS, "lite"))
    )
    for seed in (1, 2):
        pair = scene(HEIGHT, WIDTH, 7, 30, seed=seed)
        step = Step(StereoView(pair.left, pair.right, RIG, 1), None, ITERATIONS)
        [theirs], [ours] = foreign.step([step]), own.step([step])
        np.testing.assert_array_equal(theirs.offset_px, ours.offset_px)
