"""The law of one answer: the shipped graphs find the same on every CPU.

Integer sums are exact everywhere (``test_pair_sums.py``). What may differ is the rounding of real
numbers, so the recorded answer of one CPU is the answer of any other within a small tolerance.
Record it again after an export: ``python -m tests.models.test_one_answer``.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from vergence.cli.demo import bundled_sample
from vergence_models.evaluate import WEIGHTS
from vergence_models.evaluation.stepping import Footage, OnnxNetwork, footage_from_source
from vergence_proto.datasets import open_source
from vergence_proto.instruction_set import instruction_set
from vergence_proto.model_io import load_model_card

RECORDED = Path(__file__).with_name("recorded_answer.npz")
FRAMES = 3
EVERY = 8  # of the rows and columns that are recorded
# Where a rounded number tips one byte of a feature, its pixel moves by less than this. Where two
# hypotheses are equally good it may tip the choice, and such pixels are fewer than 1 in 1,000.
TOLERANCE_PX = 0.02
SHARE = 0.999

Maps = NDArray[np.float32]


@pytest.fixture(scope="module")
def footage() -> Footage:
    return bundled_room()


@pytest.fixture(scope="module")
def found(shipped: OnnxNetwork, footage: Footage) -> Maps:
    return answer(shipped, footage)


def bundled_room() -> Footage:
    return footage_from_source(open_source(bundled_sample()))


def answer(network: OnnxNetwork, footage: Footage) -> Maps:
    """A cold start of four iterations and warm steps: [frame, y, x]."""
    steps = network.sequence(footage, cold=4, warm=1)
    return np.stack([step.disparity_px for step in islice(steps, FRAMES)])


def agreeing(some: Maps, others: Maps) -> float:
    """The share of pixels that agree."""
    return float((np.abs(some - others) <= TOLERANCE_PX).mean())


def test_the_answer_is_the_one_that_another_cpu_recorded(found: Maps) -> None:
    recorded = np.load(RECORDED)
    weights = load_model_card(WEIGHTS, "lite").weights_sha256
    assert str(recorded["weights_sha256"]) == weights, "record the answer of these weights"
    maps = recorded["disparity_px"]
    some = found[:, ::EVERY, ::EVERY]
    shares = [agreeing(*pair) for pair in zip(some, maps, strict=True)]
    assert min(shares) >= SHARE, f"{shares} on {instruction_set()}, from {recorded['isa']}"
    assert agreeing(maps[0], maps[1]) < SHARE  # the tolerance separates two frames


@pytest.mark.slow
def test_sums_in_32_bits_change_no_answer(
    footage: Footage, found: Maps, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This decides on CPUs without VNNI, where onnxruntime adds in 16 bits by default."""

    class PreciseOptions(onnxruntime.SessionOptions):  # type: ignore[misc] # it has no types
        def __init__(self) -> None:
            super().__init__()
            self.add_session_config_entry("session.x64quantprecision", "1")

    monkeypatch.setattr(onnxruntime, "SessionOptions", PreciseOptions)
    precise = OnnxNetwork(WEIGHTS, "lite")
    np.testing.assert_array_equal(answer(precise, footage), found)


if __name__ == "__main__":
    np.savez_compressed(
        RECORDED,
        disparity_px=answer(OnnxNetwork(WEIGHTS, "lite"), bundled_room())[:, ::EVERY, ::EVERY],
        weights_sha256=load_model_card(WEIGHTS, "lite").weights_sha256,
        isa=instruction_set(),
    )
