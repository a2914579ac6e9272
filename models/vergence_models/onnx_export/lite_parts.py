"""The parts of a step of `lite`, from which its graphs are stitched."""

from __future__ import annotations

import torch
from torch import Tensor

from vergence_models.networks.base import StepOutput
from vergence_models.networks.lite.coarse import CostFeatures
from vergence_models.networks.lite.network import LiteNetwork, LiteState, MatchingFeatures
from vergence_models.networks.lite.refinement import Refined
from vergence_models.networks.lite.upscaled import joined, larger_image, larger_state
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
from vergence_models.onnx_export.stitch import (
    PLAIN,
    RAW_SIGMA,
    TAKES_PLACE,
    RefinementAt2x,
    StepParts,
)
from vergence_proto.model_io import LEFT, RIGHT, SIGMA

NARROW = ("pairs", "context4", "context8", "context16")
GIVEN = (*CostFeatures._fields, *NARROW)


class Wide(StepModule[LiteNetwork]):
    """The inputs of the wide search, and the state warped to the new view."""

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        left, right, matrix, *state = inputs
        moved = self.network.moved(LiteState(*state), matrix)
        return *self.network.search_wide(left, right), *moved


class Narrow(StepModule[LiteNetwork]):
    """The volume of the narrow search, and the context. It takes about as long as the wide part."""

    def forward(self, *images: Tensor) -> tuple[Tensor, ...]:
        left, right = images
        return self.network.search_narrow(left, right)


class Iterate(StepModule[LiteNetwork]):
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        fixed, features, *narrow = inputs[: len(GIVEN)]
        evidence = MatchingFeatures(CostFeatures(fixed, features), *narrow)
        found = self.network.iterate(evidence, LiteState(*inputs[len(GIVEN) :]))
        disparity, doubt, features = found.answer
        return disparity, found.hidden, doubt, features


class End(StepModule[LiteNetwork]):
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        disparity, hidden, doubt, features = inputs
        refined = Refined(disparity, doubt, features)
        return *self.network.refinement.enlarged(refined), disparity, hidden


class Sigma(StepModule[LiteNetwork]):
    """Sigma by the ambiguity of the match; the last part of every step."""

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        raw, disparity, scores = inputs
        return (self.network.sigma_head(raw, disparity, scores),)


class Enter(StepModule[LiteNetwork]):
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        left, right, *state = inputs
        return larger_image(left), larger_image(right), *larger_state(*state)


class Join(StepModule[LiteNetwork]):
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        plain, at_2x = (
            StepOutput(disparity, sigma, tuple(state))
            for disparity, sigma, *state in (inputs[:4], inputs[4:])
        )
        disparity, sigma, state = joined(plain, at_2x, self.network.config.max_disparity_px)
        return disparity, sigma, *state


def parts_of(network: LiteNetwork) -> StepParts[GraphPart]:
    """The parts: both searches, one iteration, and the upsampling to full size."""
    stride = network.config.stride
    contract = StepContract.of(network)
    inputs, sizes = contract.inputs, contract.sizes
    columns = network.near
    window = columns.ratio * COLUMNS + columns.ratio * (columns.before + columns.after)
    moving = tuple(f"at_{name}" for name in LiteState._fields)  # outputs have the plain names
    sizes_of: dict[str, Sizes] = {
        "fixed": cells(stride, 8),
        "features": {**cells(stride, 16), 0: network.bins * BATCH},
        "pairs": {0: BATCH, 1: stride // 4 * ROWS, 3: window, 4: stride // 32 * COLUMNS},
        "context4": cells(stride, 4),
        "context8": cells(stride, 8),
        "context16": cells(stride, 16),
        "at_disparity": cells(stride, 4),
        "at_hidden": cells(stride, 8),
    }
    wide, narrow = Wide(network), Narrow(network)
    cost_features = wide.examples(*inputs)
    found = narrow.examples(*inputs[:2])
    between = (*cost_features[:2], *found, *cost_features[2:])
    iterate = Iterate(network)
    answer = iterate.examples(*between)
    return StepParts(
        begin=(
            GraphPart(wide, inputs, sizes, contract.input_names, (*CostFeatures._fields, *moving)),
            GraphPart(narrow, inputs[:2], sizes[:2], (LEFT, RIGHT), NARROW),
        ),
        iterate=GraphPart(
            iterate,
            between,
            tuple(sizes_of[name] for name in (*GIVEN, *moving)),
            (*GIVEN, *moving),
            tuple(TAKES_PLACE + name for name in (*moving, "doubt", "features4")),
        ),
        end=GraphPart(
            End(network),
            answer,
            tuple(cells(stride, scale) for scale in (4, 8, 4, 4)),
            (*moving, "doubt", "features4"),
            found_names(contract),
        ),
        at_2x=refine_at_2x(network),
        sigma=sigma_part(network),
    )


def found_names(contract: StepContract) -> tuple[str, ...]:
    """The outputs of ``end``: those of a step, with the refinement's own sigma."""
    return tuple(RAW_SIGMA if name == SIGMA else name for name in contract.output_names)


def sigma_part(network: LiteNetwork) -> GraphPart:
    """Sigma of the result, from that of the refinement, the answer and the matching scores."""
    stride = network.config.stride
    contract = StepContract.of(network)
    left, _, _, disparity, _ = contract.inputs
    height, width = left.shape[1:3]
    raw = torch.ones(2, height, width)
    scores = torch.zeros(2, network.bins, height // 8, width // 8)
    answer, *_ = (each.output_name for each in network.state_tensors)
    image: Sizes = {0: BATCH, 1: stride * ROWS, 2: stride * COLUMNS}
    return GraphPart(
        Sigma(network),
        (raw, disparity, scores),
        (image, cells(stride, 4), cells(stride, 8)),
        (RAW_SIGMA, answer, "fixed"),
        (SIGMA,),
    )


def refine_at_2x(network: LiteNetwork) -> RefinementAt2x[GraphPart]:
    """The parts that go to twice the size and back."""
    contract = StepContract.of(network)
    (left, right, _, *state), (image, *_) = contract.inputs, contract.sizes
    given, outputs = contract.input_names, found_names(contract)
    enter, (height, width) = Enter(network), left.shape[1:3]
    larger = enter.examples(left, right, *state)
    maps = [torch.zeros(2, height, width) for _ in range(2)]
    larger_maps = [torch.zeros(2, 2 * height, 2 * width) for _ in range(2)]
    stride = network.config.stride
    sizes, larger_sizes = (found_sizes(rows) for rows in (stride, 2 * stride))
    return RefinementAt2x(
        enter=GraphPart(
            enter,
            (left, right, *state),
            (image, image, *sizes[2:]),
            (LEFT, RIGHT, *outputs[2:]),
            tuple(TAKES_PLACE + name for name in (LEFT, RIGHT, *given[3:])),
        ),
        moved=dict(zip(given[3:], (f"at_{name}" for name in LiteState._fields), strict=True)),
        join=GraphPart(
            Join(network),
            (*maps, *state, *larger_maps, *larger[2:]),
            (*sizes, *larger_sizes),
            (*(PLAIN + name for name in outputs), *outputs),
            tuple(TAKES_PLACE + name for name in outputs),
        ),
    )


def found_sizes(stride: int) -> tuple[Sizes, ...]:
    """Sizes of a step's outputs, for images that are multiples of ``stride``."""
    plane: Sizes = {0: BATCH, 1: stride * ROWS, 2: stride * COLUMNS}
    return plane, plane, cells(stride, 4), cells(stride, 8)
