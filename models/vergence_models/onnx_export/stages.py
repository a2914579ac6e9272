"""Whole steps cut into stages: graphs that run in parallel, and one that takes their outputs."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import chain

from onnx import ModelProto, TensorProto, ValueInfoProto

from vergence_models.config import StepKind
from vergence_models.onnx_export.quantize import BYTES
from vergence_models.onnx_export.stitch import StepParts


class StageError(RuntimeError):
    """A graph that all kinds of steps should share differs between two of them."""


def in_stages(
    name: str, models: Mapping[StepKind, ModelProto], handed: Sequence[Sequence[ValueInfoProto]]
) -> tuple[dict[StepKind, list[list[str]]], dict[str, ModelProto]]:
    """Cut whole steps into graphs that run in parallel, the same for all kinds, and the rest.

    ``handed`` lists the outputs of each parallel graph. Returns the stages of each kind, by file,
    and the files.

    Two graphs with a thread each keep two cores busy and hardly synchronise. If onnxruntime shared
    each of the 400 operators among two threads, a step would take a third more CPU time and be no
    faster.
    """
    files: dict[str, ModelProto] = {}
    stages: dict[StepKind, list[list[str]]] = {}
    for kind, model in models.items():
        made = {result for node in model.graph.node for result in node.output}
        passed = [[as_made(entry, made) for entry in group] for group in handed]
        first = [f"{name}_begin_{number}.onnx" for number in range(len(passed))]
        for file, group in zip(first, passed, strict=True):
            graph = cut_out(model, [], group)
            if files.setdefault(file, graph) != graph:
                raise StageError(
                    f"{file}: {name}_{kind} needs another graph than the kinds before it"
                )
        last = f"{name}_{kind}.onnx"
        files[last] = cut_out(model, [*chain(*passed)], model.graph.output)
        stages[kind] = [first, [last]]
    return stages, files


def handed_on(parts: StepParts[ModelProto]) -> list[list[ValueInfoProto]]:
    """The outputs of each graph of ``begin``, as :func:`stitched` names them."""
    return [
        [renamed(entry, f"begin_{number}.{entry.name}") for entry in part.graph.output]
        for number, part in enumerate(parts.begin)
    ]


def as_made(entry: ValueInfoProto, made: Container[str]) -> ValueInfoProto:
    """The same tensor as bytes, if the graph makes them."""
    if entry.name + BYTES not in made:
        return entry
    entry = renamed(entry, entry.name + BYTES)
    entry.type.tensor_type.elem_type = TensorProto.UINT8
    return entry


def renamed(entry: ValueInfoProto, name: str) -> ValueInfoProto:
    copy = ValueInfoProto()
    copy.CopyFrom(entry)
    copy.name = name
    return copy


def cut_out(
    model: ModelProto, given: Iterable[ValueInfoProto], wanted: Iterable[ValueInfoProto]
) -> ModelProto:
    """The part of a graph that computes ``wanted`` from its inputs and ``given`` tensors."""
    outside = {entry.name: entry for entry in (*model.graph.input, *given)}
    made_by = {name: node for node in model.graph.node for name in node.output}
    needed, read = set(), set()
    following = [entry.name for entry in wanted]
    while following:
        name = following.pop()
        if name in read:
            continue
        read.add(name)
        if name not in outside and name in made_by:
            needed.add(made_by[name].output[0])
            following.extend(made_by[name].input)
    part = ModelProto()
    part.CopyFrom(model)
    graph = part.graph
    for field in (graph.node, graph.initializer, graph.input, graph.output):
        del field[:]
    graph.node.extend(node for node in model.graph.node if node.output[0] in needed)
    graph.initializer.extend(entry for entry in model.graph.initializer if entry.name in read)
    graph.input.extend(entry for name, entry in outside.items() if name in read)
    graph.output.extend(wanted)
    return part
