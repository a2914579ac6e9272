"""Run the graphs of a model stage after stage, as :mod:`vergence_proto.model_io` defines.

The graphs of one stage run in parallel, each on its own thread. Running independent subgraphs in
parallel is as fast as sharing every operator among the threads, and uses less CPU: the threads
synchronise once per stage, and each keeps to its own cache. When several steps run at once, the
steps run in parallel instead, and each runs its graphs one after the other.
"""

import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession, RunOptions, SessionOptions

from vergence_proto.model_io import DISPARITY, SIGMA, ManifestError, ModelCard, Stages
from vergence_service.inference.installed import usable_cores
from vergence_service.inference.providers import (
    DeviceTensor,
    Tensor,
    returning_memory,
    run_on_device,
    start_session,
)

log = logging.getLogger(__name__)

Tensors = Mapping[str, NDArray[np.generic] | DeviceTensor]


@dataclass(frozen=True, slots=True, eq=False)
class _Graph:
    """One graph, with the outputs that steps of one iteration count need."""

    session: InferenceSession
    inputs: tuple[str, ...]
    to_host: tuple[str, ...]  # outputs that are copied to the host
    to_stay: tuple[str, ...]  # outputs that stay on the device

    @classmethod
    def of(cls, session: InferenceSession, needed: set[str]) -> "_Graph":
        """Select the outputs of ``session`` that are ``needed``."""
        outputs = [name for name in _output_names(session) if name in needed]
        maps = tuple(name for name in outputs if name in (DISPARITY, SIGMA))
        rest = tuple(name for name in outputs if name not in maps)
        return cls(session, _input_names(session), maps, rest)

    def run(
        self, tensors: Tensors, device: str | None, options: RunOptions | None = None
    ) -> dict[str, Tensor]:
        feeds = {name: tensors[name] for name in self.inputs}
        names = (*self.to_host, *self.to_stay)
        if device is None:
            return dict(zip(names, self.session.run(names, feeds, options), strict=True))
        host, stayed = run_on_device(
            self.session, feeds, to_host=self.to_host, to_stay=self.to_stay, device=device
        )
        return dict(zip(names, [*host, *stayed], strict=True))


class GraphRunner:
    """Loads each graph of a model once and runs steps.

    ``providers`` are onnxruntime's names. All steps share ``threads`` threads; 0 uses one per core.
    At most ``max_concurrent_steps`` steps may run at once. A step that runs alone runs the graphs
    of a stage in parallel; otherwise each step runs them one after the other, with the same result.
    With a ``device``, all outputs except the maps stay on it, between stages and after the step.
    """

    def __init__(
        self,
        card: ModelCard,
        *,
        providers: Sequence[str],
        threads: int,
        allow_spinning: bool,
        device: str | None,
    ) -> None:
        self._card = card
        self._providers = providers
        self._allow_spinning = allow_spinning
        self._device = device
        self._sessions: dict[Path, InferenceSession] = {}
        self._steps: dict[Stages, list[list[_Graph]]] = {}
        width = max(map(len, card.all_stages))
        threads_or_cores = threads or usable_cores()
        self.max_concurrent_steps = min(threads_or_cores, width)
        # A model that is cut for several threads runs each graph on one thread, also in stages of
        # one graph. Two threads that shared the last graph of `lite`, operator by operator, took
        # 15 % less time but a fifth more work, and another stream's step can use the second thread
        # better. A model of one graph passes 0 on: onnxruntime itself counts the cores best.
        self._operator_threads = max(1, threads_or_cores // width) if width > 1 else threads
        self._side_pool = ThreadPoolExecutor(self.max_concurrent_steps, thread_name_prefix="graph")
        self._running = 0
        self._counting = threading.Lock()
        self._loading = threading.Lock()

    def close(self) -> None:
        """Stop the threads. No step may follow."""
        self._side_pool.shutdown()

    def load(self, iterations: int, *, cold_pixels: int | None = None) -> list[list[_Graph]]:
        """Load the graphs of a step, if they are not loaded yet, and return them by stage.

        Raises ManifestError if the graphs do not fit together, and ProviderUnavailable if the
        execution provider cannot start.
        """
        step = self._card.stages(iterations, cold_pixels=cold_pixels)
        if (graphs := self._steps.get(step)) is not None:
            return graphs  # without the lock: another thread may load a slow graph
        with self._loading:
            if step not in self._steps:
                started_s = time.monotonic()
                log.info("loading %s, %d iterations", self._card.name, iterations)
                self._steps[step] = self._loaded(iterations, step)
                log.info("loaded it in %.1f s", time.monotonic() - started_s)
            return self._steps[step]

    def _loaded(self, iterations: int, step: Stages) -> list[list[_Graph]]:
        stages = [[*map(self._session, stage)] for stage in step]
        _require_fit(self._card, iterations, stages)
        needed = set(self._card.output_names)
        graphs: list[list[_Graph]] = []
        for stage in reversed(stages):
            graphs.insert(0, [_Graph.of(session, needed) for session in stage])
            needed.update(name for graph in graphs[0] for name in graph.inputs)
        return graphs

    def run(
        self, iterations: int, given: Tensors, *, cold_pixels: int | None, save_memory: bool
    ) -> dict[str, Tensor]:
        """Run one step of a batch, from the model card's inputs to its outputs, by name.

        With ``save_memory``, the graphs run one after the other, and memory that is not in use is
        returned after each. That takes a third off the memory of a step, and adds to its time.
        """
        stages = self.load(iterations, cold_pixels=cold_pixels)
        found: dict[str, Tensor] = {}
        with self._counted():
            for graphs in stages:
                for outputs in self._run_stage(graphs, {**given, **found}, save_memory):
                    found |= outputs
        return {name: found[name] for name in self._card.output_names}

    @contextmanager
    def _counted(self) -> Iterator[None]:
        with self._counting:
            self._running += 1
        try:
            yield
        finally:
            with self._counting:
                self._running -= 1

    def _run_stage(
        self, graphs: Sequence[_Graph], tensors: Tensors, save_memory: bool
    ) -> list[dict[str, Tensor]]:
        if save_memory:
            options = returning_memory()
            return [graph.run(tensors, self._device, options) for graph in graphs]
        if self.max_concurrent_steps == 1 or self._running > 1:
            return [graph.run(tensors, self._device) for graph in graphs]
        first, *others = graphs  # the caller's thread runs a graph as well
        futures: list[Future[dict[str, Tensor]]] = []
        try:
            futures += (
                self._side_pool.submit(graph.run, tensors, self._device) for graph in others
            )
            outputs = first.run(tensors, self._device)
        finally:
            wait(futures)  # also after a failure: no graph may still run during the next step
        return [outputs, *(future.result() for future in futures)]

    def _session(self, path: Path) -> InferenceSession:
        if path not in self._sessions:
            options = SessionOptions()
            options.intra_op_num_threads = self._operator_threads
            # Planning the reuse of buffers took one second when a long graph was loaded and saved
            # no memory: the arena reuses freed buffers without a plan, and steps are as fast.
            options.enable_mem_reuse = False
            if not self._allow_spinning:
                # Long enough to wait for the next operator of a step, but not for the next step.
                options.add_session_config_entry("session.intra_op.spin_duration_us", "20")
            self._sessions[path] = start_session(path, options, self._providers)
        return self._sessions[path]


def _require_fit(
    card: ModelCard, iterations: int, stages: Sequence[Sequence[InferenceSession]]
) -> None:
    """Raise ManifestError if an input has no source, or an output has none or more than one."""
    step = f"{card.name}, {iterations} iterations"
    known = set(card.input_names)
    for stage in stages:
        for session in stage:
            if missing := set(_input_names(session)) - known:
                raise ManifestError(
                    f"{step}: expected {', '.join(sorted(missing))} from a graph of an earlier "
                    "stage; the graphs come from different exports"
                )
        for session in stage:
            if twice := known.intersection(_output_names(session)):
                raise ManifestError(
                    f"{step}: more than one graph computes {', '.join(sorted(twice))}"
                )
            known.update(_output_names(session))
    if missing := set(card.output_names) - known:
        raise ManifestError(f"{step}: no graph computes {', '.join(sorted(missing))}")


def _input_names(session: InferenceSession) -> tuple[str, ...]:
    return tuple(entry.name for entry in session.get_inputs())


def _output_names(session: InferenceSession) -> tuple[str, ...]:
    return tuple(entry.name for entry in session.get_outputs())
