"""The three parts of a step of `full` and `fast`, from which their graphs are stitched."""

from __future__ import annotations

from torch import Tensor

from vergence_models.networks.raft.network import RaftGiven, RaftNetwork, RaftState
from vergence_models.networks.raft.update import CELL_PX, pyramid
from vergence_models.onnx_export.modules import (
    BATCH,
    COLUMNS,
    ROWS,
    GraphPart,
    Sizes,
    StepContract,
    StepModule,
    cells,
)
from vergence_models.onnx_export.stitch import TAKES_PLACE, StepParts


class Begin(StepModule[RaftNetwork]):
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        left, right, matrix, *state = inputs
        _, given, moving = self.network.begin(left, right, matrix, RaftState(*state))
        return *given, *moving


class Iterate(StepModule[RaftNetwork]):
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        given, moving = RaftGiven(*inputs[:3]), RaftState(*inputs[3:])
        # Every iteration builds the pyramid again; onnxruntime drops the repetitions.
        return self.network.iterate(given, pyramid(given.pairs), moving)


class End(StepModule[RaftNetwork]):
    def forward(self, *moving: Tensor) -> tuple[Tensor, ...]:
        disparity, sigma, following = self.network.end(RaftState(*moving))
        return disparity, sigma, *following


def parts_of(network: RaftNetwork) -> StepParts[GraphPart]:
    """The part before the iterations, one iteration, and the part after them."""
    given, moving = RaftGiven._fields, tuple(f"at_{name}" for name in RaftState._fields)
    moved = tuple(TAKES_PLACE + name for name in moving)
    stride, cell = network.config.stride, network.config.stride // CELL_PX
    pairs: Sizes = {0: BATCH, 1: cell * ROWS, 2: cell * COLUMNS, 3: cell * COLUMNS}
    eighth, sixteenth = cells(stride, CELL_PX), cells(stride, 2 * CELL_PX)
    given_sizes, moving_sizes = (pairs, eighth, sixteenth), (eighth, eighth, sixteenth)
    contract = StepContract.of(network)
    begin = Begin(network)
    between = begin.examples(*contract.inputs)
    return StepParts(
        (GraphPart(begin, contract.inputs, contract.sizes, contract.input_names, given + moving),),
        GraphPart(Iterate(network), between, given_sizes + moving_sizes, given + moving, moved),
        GraphPart(End(network), between[3:], moving_sizes, moving, contract.output_names),
    )
