"""Fixtures of the generator's tests."""

from __future__ import annotations

import pytest
import torch

from tests.support.tiny_scenes import SMALL
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def generator() -> ClipGenerator:
    return ClipGenerator(SMALL)


@pytest.fixture(scope="module")
def clips(generator: ClipGenerator) -> StereoClips:
    """Rooms, streets and swarms as they come."""
    return generator.clips(seed=5, indices=range(8))
