"""The graphs of a model, run as :mod:`vergence_proto.model_io` says: stage after stage.

The graphs of a stage run side by side, on threads of their own. Where a network has large parts
that do not need each other, that is as quick as to divide every operator between the same threads,
for less work: the threads meet once a stage and each keeps to its own cache. While several steps
are taken at once it is they that run side by side, each graph after graph.
"""

import logging
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession, SessionOptions

from vergence_proto.model_io import DISPARITY, SIGMA, ManifestError, ModelCard, Stages
from vergence_service.inference.providers import DeviceTensor, Tensor, run_on_device, start_session

log = logging.getLogger(__name__)

Tensors = Mapping[str, NDArray[np.generic] | DeviceTensor]


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A graph as the steps of one iteration count use it."""

    session: InferenceSession
    inputs: tuple[str, ...]
    to_host: tuple[str, ...]
    to_stay: tuple[str, ...]

    @classmethod
    def of(cls, session: InferenceSession, needed: set[str]) -> "_Part":
        """The part that gives whatever is ``needed`` and the graph has."""
        outputs = [name for name in _output_names(session) if name in needed]
        maps = tuple(name for name in outputs if name in (DISPARITY, SIGMA))
        rest = tuple(name for name in outputs if name not in maps)
        return cls(session, _input_names(session), maps, rest)

    def run(self, tensors: Tensors, device: str | None) -> dict[str, Tensor]:
        feeds = {name: tensors[name] for name in self.inputs}
        names = (*self.to_host, *self.to_stay)
        if device is None:
            return dict(zip(names, self.session.run(names, feeds), strict=True))
        host, stayed = run_on_device(
            self.session, feeds, to_host=self.to_host, to_stay=self.to_stay, device=device
        )
        return dict(zip(names, [*host, *stayed], strict=True))


class GraphRunner:
    """The graphs of a model, each loaded once.

    ``providers`` are onnxruntime's names. Steps use ``threads`` threads, 0 for one a core. As many
    of them as ``lanes`` may run at once: one that is alone runs the graphs of a stage side by side,
    one that is not runs them one after the other, to the same result. With a ``device`` all but the
    maps stays there, from stage to stage and in what a step returns.
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
        self._steps: dict[Stages, list[list[_Part]]] = {}
        width = max(map(len, card.all_stages))
        self.max_concurrent_steps = min(threads or _cores(), width)
        # A model that is cut for several threads leaves each of them its own graph, also in stages
        # of one: two threads that shared the last graph of `lite`, operator by operator, took 15 %
        # less time but a fifth more work, while another stream's step can use the second thread
        # whole. Alone: onnxruntime knows best what "one a core" is.
        self._operator_threads = max(1, (threads or _cores()) // width) if width > 1 else threads
        self._side_pool = ThreadPoolExecutor(self.max_concurrent_steps, thread_name_prefix="graph")
        self._running = 0
        self._counting = threading.Lock()
        self._loading = threading.Lock()

    def close(self) -> None:
        """End the threads; no step may follow."""
        self._side_pool.shutdown()

    def load(self, iterations: int, *, cold_pixels: int | None = None) -> list[list[_Part]]:
        """The graphs of a step, from now on in memory.

        Raises ManifestError, the graphs do not fit together, and ProviderUnavailable.
        """
        step = self._card.stages(iterations, cold_pixels=cold_pixels)
        with self._loading:
            if step not in self._steps:
                self._steps[step] = self._loaded(iterations, step)
                log.info("loaded %s, %d iterations", self._card.name, iterations)
            return self._steps[step]

    def _loaded(self, iterations: int, step: Stages) -> list[list[_Part]]:
        stages = [[*map(self._session, stage)] for stage in step]
        _require_fit(self._card, iterations, stages)
        needed = set(self._card.output_names)
        parts: list[list[_Part]] = []
        for stage in reversed(stages):
            parts.insert(0, [_Part.of(session, needed) for session in stage])
            needed.update(name for part in parts[0] for name in part.inputs)
        return parts

    def run(self, iterations: int, given: Tensors, *, cold_pixels: int | None) -> dict[str, Tensor]:
        """One step of a batch: the card's inputs to the card's outputs, by name."""
        stages = self.load(iterations, cold_pixels=cold_pixels)
        found: dict[str, Tensor] = {}
        with self._counted():
            for parts in stages:
                for outputs in self._run_stage(parts, {**given, **found}):
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

    def _run_stage(self, parts: Sequence[_Part], tensors: Tensors) -> list[dict[str, Tensor]]:
        if self.max_concurrent_steps == 1 or self._running > 1:
            return [part.run(tensors, self._device) for part in parts]
        first, *others = parts  # the caller's thread takes a graph as well
        futures: list[Future[dict[str, Tensor]]] = []
        try:
            futures += (self._side_pool.submit(part.run, tensors, self._device) for part in others)
            outputs = first.run(tensors, self._device)
        finally:
            wait(futures)  # also where one fails: no graph runs on into the next step
        return [outputs, *(future.result() for future in futures)]

    def _session(self, graph: Path) -> InferenceSession:
        if graph not in self._sessions:
            options = SessionOptions()
            options.intra_op_num_threads = self._operator_threads
            # Planning the reuse of buffers took a second of a long graph's start and saved no
            # memory: the arena gives freed buffers out again without a plan, and steps are as
            # quick.
            options.enable_mem_reuse = False
            if not self._allow_spinning:
                # As long as the next operator of a step may take to come, never between steps.
                options.add_session_config_entry("session.intra_op.spin_duration_us", "20")
            self._sessions[graph] = start_session(graph, options, self._providers)
        return self._sessions[graph]


def _require_fit(
    card: ModelCard, iterations: int, stages: Sequence[Sequence[InferenceSession]]
) -> None:
    """Raises ManifestError: an input comes from nowhere, an output from nowhere or from two."""
    step = f"{card.name}, {iterations} iterations"
    known = set(card.input_names)
    for stage in stages:
        for session in stage:
            if missing := set(_input_names(session)) - known:
                raise ManifestError(
                    f"{step}: expected {', '.join(sorted(missing))} from a graph of an earlier "
                    "stage; the graphs are of different exports"
                )
        for session in stage:
            if twice := known.intersection(_output_names(session)):
                raise ManifestError(f"{step}: more than one graph gives {', '.join(sorted(twice))}")
            known.update(_output_names(session))
    if missing := set(card.output_names) - known:
        raise ManifestError(f"{step}: no graph gives {', '.join(sorted(missing))}")


def _input_names(session: InferenceSession) -> tuple[str, ...]:
    return tuple(entry.name for entry in session.get_inputs())


def _output_names(session: InferenceSession) -> tuple[str, ...]:
    return tuple(entry.name for entry in session.get_outputs())


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
