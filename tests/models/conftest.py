"""Fixtures of the tests of the generator and of the exporter."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest
import torch

from tests.support.tiny_scenes import SMALL
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def quick_export(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The exporter without what only costs time: the graphs are the same."""
    # Under pytest's capture the tracer would format every symbolic shape it meets: minutes of it.
    monkeypatch.setattr(logging.getLogger("torch.__trace"), "propagate", False)
    from torch._dynamo import config  # takes seconds to import, and most tests do not need it

    # With symbolic sizes, a cache of operators costs more than it saves: a fifth of the time.
    with config.patch(fake_tensor_cache_enabled=False):
        yield


@pytest.fixture(scope="module")
def generator() -> ClipGenerator:
    return ClipGenerator(SMALL)


@pytest.fixture(scope="module")
def clips(generator: ClipGenerator) -> StereoClips:
    """Rooms, streets and swarms as they come."""
    return generator.clips(seed=5, indices=range(8))
