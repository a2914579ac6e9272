"""Export of modules, each a part of a step, to ONNX graphs that can be stitched."""

from __future__ import annotations

import copy
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import onnx
import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from vergence_models.networks.base import AnyNetwork
from vergence_proto.model_io import DISPARITY, LEFT, RIGHT, SIGMA, UVD_CURR_FROM_PREV

OPSET = 18  # ScatterElements gained reduction="max" there
BATCH = torch.export.Dim("batch", min=1, max=256)
ROWS = torch.export.Dim("rows", min=1, max=128)
COLUMNS = torch.export.Dim("columns", min=1, max=128)

# What the exporter takes for a tensor's dynamic sizes: dimension -> a Dim or a multiple of one.
Sizes = dict[int, object]
Network = TypeVar("Network", bound=nn.Module)


class StepModule(nn.Module, Generic[Network]):
    """A part of a network's step, from tensors to tensors; subclasses define ``forward``."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def examples(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Example outputs, which are example inputs of the next part."""
        return tuple(tensor.detach() for tensor in self(*inputs))


@dataclass(frozen=True, slots=True, eq=False)
class GraphPart:
    """A module to export, with its inputs and outputs: tensors alone, by name."""

    module: nn.Module
    inputs: tuple[Tensor, ...]  # example inputs
    sizes: tuple[Sizes, ...]  # the varying dimensions of each input
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]


def cells(stride: int, scale: int) -> Sizes:
    """Sizes of [B, C, H / scale, W / scale] for images that are multiples of ``stride``."""
    return {0: BATCH, 2: stride // scale * ROWS, 3: stride // scale * COLUMNS}


@dataclass(frozen=True, slots=True, eq=False)
class StepContract:
    """The inputs and outputs of a whole step, as the manifest's readers know them."""

    inputs: tuple[Tensor, ...]  # examples: both images, the motion, the state
    sizes: tuple[Sizes, ...]  # the varying dimensions of each input
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]

    @classmethod
    def of(cls, network: AnyNetwork) -> StepContract:
        stride = network.config.stride
        height, width = 6 * stride, 8 * stride
        # Two tensors: the exporter would take one object for one input, and match left with left.
        left, right = (torch.zeros(2, height, width, 3, dtype=torch.uint8) for _ in range(2))
        state = network.cold_state(2, height, width)
        image: Sizes = {0: BATCH, 1: stride * ROWS, 2: stride * COLUMNS}
        tensors = network.state_tensors
        return cls(
            (left, right, torch.eye(4).repeat(2, 1, 1), *state),
            (image, image, {0: BATCH}, *(cells(stride, tensor.scale) for tensor in tensors)),
            (LEFT, RIGHT, UVD_CURR_FROM_PREV, *(tensor.input_name for tensor in tensors)),
            (DISPARITY, SIGMA, *(tensor.output_name for tensor in tensors)),
        )


def export_part(part: GraphPart, path: Path) -> None:
    """Write a part's graph, with dynamic batch, height and width."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own deprecations
        torch.onnx.export(
            part.module,
            part.inputs,
            str(path),
            dynamo=True,
            verbose=False,
            external_data=False,
            opset_version=OPSET,
            dynamic_shapes=(part.sizes,),  # of the one variadic argument
            input_names=part.input_names,
            output_names=part.output_names,
        )
    slim(path)


def join_clamps(model: onnx.ModelProto) -> None:
    """Make one Clip of a clamp, which the exporter writes as a Max and a Min."""
    graph = model.graph
    scalars = {tensor.name for tensor in graph.initializer if not tensor.dims}
    scalars |= {value.name for value in graph.value_info if is_scalar(value)}
    uses = Counter(name for node in graph.node for name in node.input)
    uses.update(output.name for output in graph.output)
    raised = {
        node.output[0]: node
        for node in graph.node
        if node.op_type == "Max" and len(node.input) == 2 and node.input[1] in scalars
    }
    for node in [node for node in graph.node if node.op_type == "Min" and len(node.input) == 2]:
        value, high = node.input
        if value in raised and uses[value] == 1 and high in scalars:
            node.op_type = "Clip"
            del node.input[:]
            node.input.extend([*raised[value].input, high])
            graph.node.remove(raised[value])


def is_scalar(value: onnx.ValueInfoProto) -> bool:
    return value.type.tensor_type.HasField("shape") and not value.type.tensor_type.shape.dim


def slim(path: Path) -> None:
    """Drop the exporter's notes: stack traces, file paths, and sizes in a random order."""
    model = onnx.load(path)
    join_clamps(model)
    for node in model.graph.node:
        del node.metadata_props[:]
    del model.graph.value_info[:]
    del model.metadata_props[:]
    del model.graph.metadata_props[:]
    onnx.save(model, path)


def folded(network: Network) -> Network:
    """A copy with the same results, where every batch norm is folded into its convolution."""
    network = copy.deepcopy(network).eval()
    for module in network.modules():
        if not isinstance(module, nn.Sequential):
            continue
        for place in range(len(module) - 1):
            layer, norm = module[place], module[place + 1]
            if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                module[place] = fuse_conv_bn_eval(layer, norm)
                module[place + 1] = nn.Identity()
    return network
