"""The native step with the weights that ship, and steps to compare."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import vergence_native
from vergence_native import LiteResult, LiteStep, Threads
from vergence_proto.model_io import load_model_card
from vergence_service.inference.onnx_model import packaged_weights_dir

STILL = np.eye(4, dtype=np.float32)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if vergence_native.available():
        return
    reason = "vergence_native is not built: python models/vergence_native/compile_library.py"
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.skip(reason=reason))


def graphs(iterations: int) -> list[Path]:
    """The files of a step."""
    card = load_model_card(packaged_weights_dir(), "lite")
    return [path for stage in card.stages(iterations) for path in stage]


MakeStep = Callable[..., LiteStep]


@pytest.fixture
def make_step() -> Iterator[MakeStep]:
    """Make steps that are closed after the test."""
    made: list[LiteStep] = []
    pools: list[Threads] = []

    def make(iterations: int = 1, *, threads: int = 1, variant: str | None = None) -> LiteStep:
        pool = Threads(threads)
        pools.append(pool)
        files = graphs(iterations)
        made.append(LiteStep(files, iterations=iterations, threads=pool, variant=variant))
        return made[-1]

    yield make
    for step in made:
        step.close()
    for pool in pools:
        pool.close()


def random_pair(
    height: int, width: int, seed: int = 0
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Noise at two scales, and the same moved by 9 px."""
    random = np.random.default_rng(seed)
    large = random.integers(0, 200, (height // 8, width // 8, 3), np.uint8)
    left = large.repeat(8, axis=0).repeat(8, axis=1)
    left += random.integers(0, 56, left.shape, np.uint8)
    return left, np.ascontiguousarray(np.roll(left, -9, axis=1))


def nothing(height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The state of a cold start."""
    return (
        np.zeros((1, height // 4, width // 4), np.float32),
        np.zeros((32, height // 8, width // 8), np.float32),
    )


def moving() -> NDArray[np.float32]:
    """A transform that moves the state by a few pixels."""
    matrix = STILL.copy()
    matrix[0, 3], matrix[1, 2], matrix[0, 2], matrix[2, 2] = -6.0, 0.05, -0.2, 1.01
    return matrix


def two_frames(step: LiteStep, height: int, width: int, seed: int = 0) -> list[LiteResult]:
    """A cold step and a warm one with motion."""
    pair = random_pair(height, width, seed)
    first = step.step(*pair, STILL, *nothing(height, width))
    return [first, step.step(*pair, moving(), first.next_disparity, first.next_hidden)]


def assert_same_bits(some: list[LiteResult], others: list[LiteResult]) -> None:
    for one, other in zip(some, others, strict=True):
        for name, a, b in zip(LiteResult._fields, one, other, strict=True):
            assert a.tobytes() == b.tobytes(), name
