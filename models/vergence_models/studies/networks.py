"""The networks to study: exported graphs, and training runs where no graph is."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vergence_models.evaluation.methods import Method, single_frame_method, warm_method
from vergence_models.evaluation.stepping import OnnxNetwork, SteppedNetwork
from vergence_models.evaluation.torch_stepping import TorchNetwork
from vergence_models.training.runs import Run, Validation, read_run
from vergence_proto.model_io import MANIFEST_NAME, ManifestError, user_models_dir

TIERS = ("full", "fast", "lite")
WARM = (1, 2, 5)  # the counts the paper tabulates
SINGLE_FRAME = (7, 20)
COLD = 8  # iterations on the first frame of a warm sequence, at most


@dataclass(frozen=True, slots=True)
class TrainingSummary:
    """The amount of training of a network, which every figure of it must be read with."""

    name: str
    runtime: str
    frames: int  # seen, repeated ones counted again
    minutes: float
    device: str

    @classmethod
    def of(cls, name: str, runtime: str, story: dict[str, Any]) -> TrainingSummary:
        """``story``: any JSON, as a run records it and a manifest repeats it."""
        return cls(
            name,
            runtime,
            int(story.get("frames", 0)),
            round(float(story.get("minutes", 0.0)), 1),
            str(story.get("device", "unknown")),
        )

    @property
    def words(self) -> str:
        if not self.frames:
            return f"{self.name}: trained by its authors; run by {self.runtime}"
        return (
            f"{self.name}: {self.frames:,} frames seen in {self.minutes:g} minutes on "
            f"{self.device}; run by {self.runtime}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class StudiedNetwork:
    """A network, and the iteration counts it is studied at."""

    name: str
    network: SteppedNetwork
    training: TrainingSummary
    warm: tuple[int, ...]
    single_frame: tuple[int, ...]
    cold: int  # iterations on the first frame of a warm sequence
    warps: bool  # its state moves with the camera; otherwise poses do not matter to it
    history: list[Validation] = field(default_factory=list)  # validations during a run's training

    @property
    def tier(self) -> str:
        return self.network.card.name

    def warm_methods(self) -> list[Method]:
        return [warm_method(self.network, self.name, n, cold=self.cold) for n in self.warm]

    def single_frame_methods(self) -> list[Method]:
        return [single_frame_method(self.network, self.name, n) for n in self.single_frame]

    def started_with(self, cold: int) -> Method:
        """One warm iteration a frame, after ``cold`` iterations on the first."""
        method = warm_method(self.network, self.name, 1, cold=cold)
        return replace(method, label=f"{method.label}, {cold} on the first frame")


def exported(
    folder: Path, *, threads: int, only: Collection[str] | None = None
) -> list[StudiedNetwork]:
    """Every model of a folder of weights, or only those named. Raises ManifestError."""
    path = folder / MANIFEST_NAME
    try:
        entries: dict[str, Any] = json.loads(path.read_text("utf-8"))["models"]
    except FileNotFoundError:
        raise ManifestError(f"no manifest at {path}; export a model there first") from None
    except (json.JSONDecodeError, KeyError) as error:
        raise ManifestError(f"{path}: expected a manifest of models: {error!r}") from None
    found = []
    for name in entries if only is None else only:
        if name not in entries:
            raise ManifestError(
                f"{path} has no model {name!r}; it has {', '.join(sorted(entries))}"
            )
        entry = entries[name]
        network = OnnxNetwork(folder, name, threads=threads)
        counts = network.card.graphs
        found.append(
            StudiedNetwork(
                name,
                network,
                TrainingSummary.of(name, "onnxruntime", entry.get("training", {})),
                warm=_warm_counts(network),
                single_frame=tuple(n for n in SINGLE_FRAME if n in counts) or (max(counts),),
                cold=network.card.iterations_at_most(COLD),
                warps=network.card.recurrent and entry.get("architecture", {}).get("warp", True),
            )
        )
    return found


def _warm_counts(network: SteppedNetwork) -> tuple[int, ...]:
    """The counts of warm steps to study; none if the network has no memory."""
    if not network.card.recurrent:
        return ()
    counts = network.card.graphs
    return tuple(n for n in WARM if n in counts) or (min(counts),)


def trained(run: Run, beside: Iterable[StudiedNetwork], *, threads: int) -> StudiedNetwork:
    """A training run, for the counts that no exported graph of its name has."""
    tier = run.config_name
    same = [other for other in beside if other.tier == tier]
    name = f"{tier} (PyTorch)"
    return StudiedNetwork(
        name,
        TorchNetwork(run, threads=threads),
        TrainingSummary.of(name, "PyTorch", run.story),
        warm=tuple(n for n in WARM if all(n not in other.warm for other in same)),
        single_frame=tuple(
            n for n in SINGLE_FRAME if all(n not in other.single_frame for other in same)
        ),
        cold=COLD,
        warps=dataclasses.asdict(run.network).get("warp", True),
        history=run.history,
    )


def gather_networks(
    weights: list[Path], runs: list[Path], *, threads: int, models: Sequence[str] = ()
) -> list[StudiedNetwork]:
    """All of them, ordered by tier; a model in two folders is taken from the first.

    ``models`` are names of models that the user has added with ``vergence models add``.

    Raises ManifestError, RunError, ConfigError.
    """
    found: dict[str, StudiedNetwork] = {}
    read = [read_run(folder) for folder in runs]  # quick to fail, graphs are slow to load
    for folder in weights:
        for studied in exported(folder, threads=threads):
            found.setdefault(studied.name, studied)
    for studied in exported(user_models_dir(), threads=threads, only=models) if models else ():
        found.setdefault(studied.name, studied)
    for run in read:
        studied = trained(run, list(found.values()), threads=threads)
        found.setdefault(studied.name, studied)
    order = {name: place for place, name in enumerate(TIERS)}
    return sorted(found.values(), key=lambda c: (order.get(c.tier, len(order)), c.name))
