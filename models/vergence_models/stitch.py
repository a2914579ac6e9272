"""Graphs of any iteration count, stitched from parts: before the iterations, one, and after.

Each part goes through the exporter once, whatever the counts; and graphs of all counts hold the
same weights, so those go into one file beside them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import onnx
from onnx import ModelProto, NodeProto, TensorProto

T = TypeVar("T")
SMALL_BYTES = 1024  # such tensors stay in the graph: shapes and scalars that runtimes fold
ALIGNMENT = 4096  # runtimes map whole pages
TAKES_PLACE = "to_"


class Parts(NamedTuple, Generic[T]):
    """What is found before the iterations, by graphs that do not need each other; one; the rest.

    Outputs are found by name. One of ``iterate`` that is called to_NAME takes the place of NAME.
    """

    begin: tuple[T, ...]
    iterate: T
    end: T


def stitched(parts: Parts[ModelProto], iterations: int) -> ModelProto:
    """One graph: inputs of ``begin``, outputs of ``end``, and ``iterations`` times between."""
    model = ModelProto()
    model.CopyFrom(parts.begin[0])
    graph = model.graph
    for field in (graph.node, graph.initializer, graph.output):
        del field[:]
    known: dict[str, str] = {entry.name: entry.name for entry in graph.input}
    steps = [(f"begin_{number}", part, 0) for number, part in enumerate(parts.begin)]
    steps += [("iterate", parts.iterate, number) for number in range(iterations)]
    steps += [("end", parts.end, 0)]
    for name, part, number in steps:
        # Weights are named after their part, what is computed after the place it is computed at.
        place = f"{name}_{number}" if part is parts.iterate else name
        names = {entry.name: known[entry.name] for entry in part.graph.input}
        names |= {entry.name: f"{name}.{entry.name}" for entry in part.graph.initializer}
        for node in part.graph.node:
            names |= {result: f"{place}.{result}" for result in node.output if result}
        if part is parts.end:
            names |= {entry.name: entry.name for entry in part.graph.output}
        graph.node.extend(renamed(node, names, place) for node in part.graph.node)
        if number == 0:
            graph.initializer.extend(relabelled(entry, names) for entry in part.graph.initializer)
        results = [entry.name for entry in part.graph.output]
        known |= {result.removeprefix(TAKES_PLACE): names[result] for result in results}
    graph.output.extend(parts.end.graph.output)
    return model


def renamed(node: NodeProto, names: Mapping[str, str], label: str) -> NodeProto:
    """The node at another place. An empty name is an input that is left out."""
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
