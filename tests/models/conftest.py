"""Fixtures: the generator and its clips, the shipped network, and the exporter."""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Iterator
from importlib.util import find_spec

import pytest
import torch

from tests.support.tiny_scenes import SMALL
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator
from vergence_models.evaluate import WEIGHTS
from vergence_models.evaluation.stepping import OnnxNetwork


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> None:
    """Test processes share the cores. Threads of the renderer even spin while they wait."""
    torch.set_num_threads(1)
    if find_spec("drjit"):
        importlib.import_module("drjit").set_thread_count(1)


@pytest.fixture(scope="session")
def shipped() -> OnnxNetwork:
    """The graphs that ship. They are loaded once, which takes seconds."""
    return OnnxNetwork(WEIGHTS, "lite")


@pytest.fixture
def quick_export(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The exporter without what only costs time: the graphs are the same."""
    # Under pytest's capture the tracer would format every symbolic shape it meets: minutes of it.
    monkeypatch.setattr(logging.getLogger("torch.__trace"), "propagate", False)
    from torch._dynamo import config  # takes seconds to import, and most tests do not need it

    # With symbolic sizes, a cache of operators costs more than it saves: a fifth of the time.
    with config.patch(fake_tensor_cache_enabled=False):
        # A tracer that counts coverage would follow millions of calls inside torch.
        tracer = sys.gettrace()
        sys.settrace(None)
        yield
        sys.settrace(tracer)


@pytest.fixture(scope="module")
def generator() -> ClipGenerator:
    return ClipGenerator(SMALL)


@pytest.fixture(scope="module")
def clips(generator: ClipGenerator) -> StereoClips:
    """Rooms, streets and swarms as they come."""
    return generator.clips(seed=5, indices=range(8))
