"""Graphs of any iteration count, stitched from three kinds of parts: begin, one iteration, end.

Each part goes through the exporter once, whatever the counts. Graphs of all counts hold the same
weights, which can lie in one file beside them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import onnx
from onnx import ModelProto, NodeProto, TensorProto

from vergence_models.config import StepKind

T = TypeVar("T")
SMALL_BYTES = 1024  # such tensors stay in the graph: shapes and scalars that runtimes fold
ALIGNMENT = 4096  # runtimes map whole pages
TAKES_PLACE = "to_"
PLAIN = "plain_"  # prefix of the outputs at 1x, when iterations at 2x follow
RAW_SIGMA = "raw_sigma"  # the sigma that ``end`` finds, where a part for sigma follows
SIGMA_PART = "sigma"


class RefinementAt2x(NamedTuple, Generic[T]):
    """The parts that upsample images and state, and merge the 2x result into the 1x result.

    ``enter`` takes the images and the outputs of ``end``, and returns the inputs of ``begin``,
    including a state. That state is in the view of this frame already, so iterations read it
    unwarped, by the names in ``moved``. ``join`` takes the outputs of ``end`` twice: those at 1x as
    plain_NAME, those at 2x as NAME.
    """

    enter: T
    moved: Mapping[str, str]
    join: T


class StepParts(NamedTuple, Generic[T]):
    """The parts of a step: independent graphs before the iterations, one iteration, the end.

    Parts are connected by names. An output called to_NAME takes the place of NAME.
    """

    begin: tuple[T, ...]
    iterate: T
    end: T
    at_2x: RefinementAt2x[T] | None = None
    sigma: T | None = None  # from raw_sigma, outputs of ``end`` and of the first graph, to sigma


def stitched(parts: StepParts[ModelProto], kind: StepKind) -> ModelProto:
    """One graph: inputs of ``begin``, outputs of ``end``, and the iterations between.

    The 2x part repeats ``begin`` as a whole. Runtimes drop the operators that nothing reads.
    """
    line = _GraphBuilder(parts.begin[0])
    line.begin(parts)
    line.iterate(parts, range(kind.iterations - kind.at_2x))
    if kind.at_2x:
        assert parts.at_2x is not None
        plain = line.add("end", parts.end, place="plain_end")
        line.known |= {PLAIN + name: result for name, result in plain.items()}
        larger = line.add("enter", parts.at_2x.enter)
        line.begin(parts, place="closer_")  # a tensor name of the shipped graphs: it stays
        line.known |= {name: larger[given] for given, name in parts.at_2x.moved.items()}
        line.iterate(parts, range(kind.iterations - kind.at_2x, kind.iterations))
        line.add("end", parts.end, place="closer_end")
        line.add("join", parts.at_2x.join, last=True)
    else:
        line.add("end", parts.end, last=True)
    line.model.graph.output.extend(parts.end.graph.output)
    return line.model if parts.sigma is None else with_sigma(line.model, parts.sigma)


def with_sigma(model: ModelProto, part: ModelProto) -> ModelProto:
    """The same step with this part for sigma, in the place of one that it may have.

    The part also takes outputs of the first graph of ``begin``, at the plain size. ``model`` may be
    a whole step or the last of its stages, and its convolutions may be int8.
    """
    (found,) = part.graph.output
    model = ModelProto.FromString(model.SerializeToString())
    graph = model.graph
    made = {name for node in graph.node for name in node.output}
    if RAW_SIGMA not in made:
        # A step of before there was such a part: its sigma is what the part takes.
        for node in graph.node:
            node.output[:] = [RAW_SIGMA if name == found.name else name for name in node.output]
    kept = [node for node in graph.node if not node.name.startswith(f"{SIGMA_PART}.")]
    weights = [each for each in graph.initializer if not each.name.startswith(f"{SIGMA_PART}.")]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(kept)
    graph.initializer.extend(weights)
    outside = {entry.name for entry in (*graph.input, *graph.output)} | made | {RAW_SIGMA}
    names = {
        entry.name: entry.name if entry.name in outside else f"begin_0.{entry.name}"
        for entry in part.graph.input
    }
    names |= {entry.name: f"{SIGMA_PART}.{entry.name}" for entry in part.graph.initializer}
    for node in part.graph.node:
        names |= {name: f"{SIGMA_PART}.{name}" for name in node.output if name}
    names[found.name] = found.name
    graph.node.extend(renamed(node, names, SIGMA_PART) for node in part.graph.node)
    graph.initializer.extend(relabelled(entry, names) for entry in part.graph.initializer)
    for entry in graph.output:
        entry.name = found.name if entry.name == RAW_SIGMA else entry.name
    return model


class _GraphBuilder:
    """Builds a graph by appending parts."""

    def __init__(self, first: ModelProto) -> None:
        """Start with the inputs of ``first``."""
        self.model = ModelProto()
        self.model.CopyFrom(first)
        self._graph = self.model.graph
        for field in (self._graph.node, self._graph.initializer, self._graph.output):
            del field[:]
        self.known = {entry.name: entry.name for entry in self._graph.input}
        self._weights: set[str] = set()

    def begin(self, parts: StepParts[ModelProto], *, place: str = "") -> None:
        for number, part in enumerate(parts.begin):
            self.add(f"begin_{number}", part, place=f"{place}begin_{number}")

    def iterate(self, parts: StepParts[ModelProto], numbers: Iterable[int]) -> None:
        for number in numbers:
            self.add("iterate", parts.iterate, place=f"iterate_{number}")

    def add(
        self, name: str, part: ModelProto, *, place: str = "", last: bool = False
    ) -> dict[str, str]:
        """Append a part and return its outputs by name. The last part's outputs keep their names.

        Weights are named after their part, other tensors after the place of the part.
        """
        place = place or name
        outputs = {entry.name: entry.name.removeprefix(TAKES_PLACE) for entry in part.graph.output}
        names = {entry.name: self.known[entry.name] for entry in part.graph.input}
        names |= {entry.name: f"{name}.{entry.name}" for entry in part.graph.initializer}
        for node in part.graph.node:
            names |= {result: f"{place}.{result}" for result in node.output if result}
        names |= outputs if last else {}
        self._graph.node.extend(renamed(node, names, place) for node in part.graph.node)
        if name not in self._weights:
            self._weights.add(name)
            weights = (relabelled(entry, names) for entry in part.graph.initializer)
            self._graph.initializer.extend(weights)
        results = {known: names[output] for output, known in outputs.items()}
        self.known |= results
        return results


def renamed(node: NodeProto, names: Mapping[str, str], label: str) -> NodeProto:
    """A copy of the node with other names. An empty name is an omitted input."""
    copy = NodeProto()
    copy.CopyFrom(node)
    copy.name = f"{label}.{node.name}"
    copy.input[:] = [names.get(name, name) for name in node.input]
    copy.output[:] = [names.get(name, name) for name in node.output]
    return copy


def relabelled(tensor: TensorProto, names: Mapping[str, str]) -> TensorProto:
    copy = TensorProto()
    copy.CopyFrom(tensor)
    copy.name = names[tensor.name]
    return copy


def write_with_shared_weights(models: Mapping[Path, ModelProto], weights: Path) -> None:
    """Write graphs whose large tensors lie in one file beside them, each stored once.

    Tensors of one name are taken to be the same in all ``models``, as :func:`stitched` has them.
    """
    models = {
        path: ModelProto.FromString(model.SerializeToString()) for path, model in models.items()
    }
    places: dict[str, tuple[int, int]] = {}
    with weights.open("wb") as file:
        for model in models.values():
            for tensor in model.graph.initializer:
                if len(tensor.raw_data) < SMALL_BYTES:
                    continue
                if tensor.name not in places:
                    file.write(b"\0" * (-file.tell() % ALIGNMENT))
                    places[tensor.name] = (file.tell(), len(tensor.raw_data))
                    file.write(tensor.raw_data)
                point_to(tensor, weights.name, *places[tensor.name])
    for path, model in models.items():
        onnx.save(model, path)


def point_to(tensor: TensorProto, location: str, offset: int, length: int) -> None:
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", offset), ("length", length)):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, str(value)
