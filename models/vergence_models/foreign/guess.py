"""Guess the contract of a graph from its names, its shapes, and the shapes of what it returns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, TensorProto

from vergence_models.foreign.compose import NETWORK
from vergence_models.foreign.contract import Contract, ContractError, Layout, WarmStart
from vergence_models.foreign.proof import texture_size
from vergence_models.foreign.published import PUBLISHED, Published
from vergence_models.foreign.textures import scene
from vergence_models.foreign.trial import Network, Trial

Dimension = int | None  # None: any

_TYPES: dict[int, Literal["float32", "float16", "uint8"]] = {
    TensorProto.FLOAT: "float32",
    TensorProto.FLOAT16: "float16",
    TensorProto.UINT8: "uint8",
}
_RIGHT = re.compile(r"right|(^|[^a-z])r$|[^0-9]2$|_r_|imgr", re.IGNORECASE)
_LEFT = re.compile(r"left|(^|[^a-z])l$|[^0-9]1$|_l_|imgl", re.IGNORECASE)
_FLOW = re.compile(r"flow|init_disp|disp_init|prev", re.IGNORECASE)
_CONFIDENCE = re.compile(r"conf|certain", re.IGNORECASE)
_DISPARITY = re.compile(r"disp|flow_up|final|up", re.IGNORECASE)
_MOST_MAPS = 8  # a graph with more channels returns features or costs
_SECOND = re.compile(r"second|right|coarse", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Given:
    """What the user says of a graph; None is to be guessed."""

    like: str | None = None
    left: str | None = None
    right: str | None = None
    pixels: str | None = None
    order: Literal["rgb", "bgr", "grey"] | None = None
    output: str | None = None
    factor: float | None = None
    max_disparity_px: int | None = None
    multiple_of: int | None = None
    sigma: Literal["constant", "left-right", "confidence"] | None = None
    sigma_px: float | None = None
    warm_start: bool | None = None  # False: leave an input for a flow at zero


@dataclass(frozen=True, slots=True)
class _Input:
    name: str
    kind: int
    shape: tuple[Dimension, ...]

    @property
    def words(self) -> str:
        return f"{self.name} [{', '.join('?' if d is None else str(d) for d in self.shape)}]"


@dataclass(frozen=True, slots=True)
class GuessedImages:
    """A contract without its outputs, and whether its pixels are known."""

    contract: Contract
    pixels_known: bool  # from the user, or from a published family


def images_of(model: ModelProto, given: Given, like: str | None) -> GuessedImages:
    """Guess everything about the inputs of a graph of the family ``like``. Raises ContractError."""
    inputs = _inputs_of(model)
    published = PUBLISHED.get(like) if like else None
    flows = [each for each in inputs if _FLOW.search(each.name) and not _is_image(each)]
    flows += [each for each in inputs if _looks_like_flow(each, inputs) and each not in flows]
    images = [each for each in inputs if each not in flows]
    contract = _images(images, given)
    multiple = given.multiple_of or (published.multiple_of if published else 32)
    contract = replace(
        contract,
        multiple_of=multiple,
        pixels=given.pixels or (published.pixels if published else "0..255"),
        factor=given.factor or (published.factor if published else 1.0),
        max_disparity_px=given.max_disparity_px or 192,
    )
    if len(flows) > 1:
        raise ContractError(
            f"nobody knows what to feed {' and '.join(each.words for each in flows)}; "
            "export the graph without these inputs"
        )
    if flows:
        warm = replace(_flow(flows[0], images, published), used=given.warm_start is not False)
        contract = replace(contract, warm_start=warm)
    return GuessedImages(contract, given.pixels is not None or published is not None)


def family_of(model: ModelProto, file_name: str, given: Given) -> str | None:
    """Name the published family of a graph, if its names or its file's name give it away."""
    if given.like is not None and given.like not in PUBLISHED:
        known = ", ".join(PUBLISHED)
        raise ContractError(f"there is no contract {given.like!r}; there are {known}")
    return given.like or _family_of(model, file_name)


def outputs_of(contract: Contract, network: Network, given: Given) -> list[Contract]:
    """Guess the output from what the graph returns: the likely ones first. Raises ContractError."""
    size = texture_size(contract)
    pair = scene(*size, 8, 24, seed=11)
    raw = Trial(contract, network).raw(pair.left, pair.right)
    found = {name.removeprefix(NETWORK): value for name, value in raw.items()}
    planes = {name: _layout_of(value, size) for name, value in found.items()}
    maps = {name: plane for name, plane in planes.items() if plane is not None}
    shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in found.items())
    if given.output is not None and given.output not in maps:
        raise ContractError(f"the graph returns no map called {given.output!r}, but {shapes}")
    confidence = next((name for name in maps if _CONFIDENCE.search(name)), "")
    maps_of_disparity = [name for name in maps if name != confidence]
    if not maps_of_disparity:
        raise ContractError(f"expected a disparity map of {size[1]}x{size[0]}, got {shapes}")

    def preference(name: str) -> tuple[bool, float, bool, bool]:
        _, scale = maps[name]
        secondary = bool(_SECOND.search(name))
        return secondary, -scale, not _DISPARITY.search(name), name != "output"

    sigma = given.sigma or ("confidence" if confidence else "constant")
    if sigma == "confidence" and not confidence:
        raise ContractError(f"the graph returns no confidence, but {shapes}")
    contract = replace(
        contract,
        sigma=sigma,
        sigma_px=given.sigma_px or 1.0,
        confidence=confidence,
        confidence_layout=maps[confidence][0] if confidence else "NCHW",
    )
    names = [given.output] if given.output else sorted(maps_of_disparity, key=preference)
    likely = []
    for name in names:
        layout, scale = maps[name]
        described = replace(
            contract,
            output=name,
            output_layout=layout,
            output_dtype=found[name].dtype.name,
            output_scale=scale,
        )
        channels = found[name].shape[layout.index("C")] if "C" in layout else 1
        likely += [(channel, described) for channel in range(channels)]
    # The first channel of every map comes before the second of any.
    likely.sort(key=lambda each: each[0])
    return [replace(each, output_channel=channel) for channel, each in likely[:_MOST_MAPS]]


def iterations_in(file_name: str) -> int:
    """Return the number of iterations that a file's name states, as iter10 or 10iters; else 1."""
    found = re.search(r"iters?_?(\d+)|(\d+)_?iters?", file_name, re.IGNORECASE)
    return max(1, int(found[1] or found[2])) if found else 1


def _inputs_of(model: ModelProto) -> list[_Input]:
    weights = {each.name for each in model.graph.initializer}
    found = []
    for each in model.graph.input:
        if each.name in weights:  # old exporters list them
            continue
        about = each.type.tensor_type
        if not each.type.HasField("tensor_type") or not about.HasField("shape"):
            raise ContractError(
                f"the input {each.name} has no fixed number of dimensions; export it with a shape"
            )
        shape = tuple(d.dim_value if d.HasField("dim_value") else None for d in about.shape.dim)
        found.append(_Input(each.name, about.elem_type, shape))
    if not found:
        raise ContractError("the file holds no graph with inputs")
    return found


def _family_of(model: ModelProto, file_name: str) -> str | None:
    names = [each.name for each in (*model.graph.input, *model.graph.output)]
    text = " ".join([file_name, model.graph.name, *names]).lower()
    found = [key for key, each in PUBLISHED.items() if any(mark in text for mark in each.marks)]
    return found[0] if found else None


def _channels(each: _Input) -> tuple[int | None, bool]:
    """Channels of an image input, and whether they are last; None: it is no image."""
    if len(each.shape) != 4 or each.kind not in _TYPES:
        return None, False
    first, last = each.shape[1], each.shape[3]
    if first in (1, 2, 3, 6):
        return first, False
    return (last, True) if last in (1, 2, 3, 6) else (None, False)


def _is_image(each: _Input) -> bool:
    return _channels(each)[0] is not None


def _looks_like_flow(each: _Input, inputs: Sequence[_Input]) -> bool:
    """A third input with the channels of a flow, beside two images."""
    others = [other for other in inputs if other is not each]
    return _channels(each)[0] == 2 and [_channels(other)[0] for other in others] == [3, 3]


def _images(images: Sequence[_Input], given: Given) -> Contract:
    """Guess which inputs take the images."""
    words = ", ".join(each.words for each in images)
    channels = [_channels(each) for each in images]
    by_name = {each.name: each for each in images}
    for name in (given.left, given.right):
        if name is not None and name not in by_name:
            raise ContractError(f"the graph has no image input {name!r}, but {words}")
    if len(images) not in (1, 2, 4) or any(count is None for count, _ in channels):
        raise ContractError(
            "expected one input with both images, two with an image each, or four with both at "
            f"two sizes, got {words}; wrap the network in a module that takes two images "
            "[B, 3, H, W], and export that"
        )
    count, last = channels[0]
    kind = _TYPES[images[0].kind]
    if len(images) == 1:
        if count not in (2, 6):
            raise ContractError(
                f"expected both images in the channels of the only input, got {words}; wrap the "
                "network in a module that takes two images [B, 3, H, W], and export that"
            )
        order = given.order or ("grey" if count == 2 else "rgb")
        return Contract(
            images[0].name,
            "",
            channels_last=last,
            dtype=kind,
            order=order,
            size=_size_of(images[0], last),
        )
    if count not in (1, 3):
        raise ContractError(f"expected images of one or three channels, got {words}")
    halves: list[_Input] = []
    if len(images) == 4:
        images, halves = _by_size(images, words)
    left, right = _sides(images)
    if given.left is not None or given.right is not None:
        left = (
            by_name[given.left]
            if given.left
            else next(each for each in images if each.name != given.right)
        )
        right = (
            by_name[given.right]
            if given.right
            else next(each for each in images if each.name != given.left)
        )
    left_half, right_half = (each.name for each in _sides(halves)) if halves else ("", "")
    return Contract(
        left.name,
        right.name,
        left_half=left_half,
        right_half=right_half,
        channels_last=last,
        dtype=kind,
        order=given.order or ("grey" if count == 1 else "rgb"),
        size=_size_of(left, last),
    )


def _sides(images: Sequence[_Input]) -> tuple[_Input, _Input]:
    """The left and the right one by their names, else in the order of the graph."""
    first, second = images
    lefts = [each for each in images if _LEFT.search(each.name)]
    rights = [each for each in images if _RIGHT.search(each.name)]
    if lefts == [second] or rights == [first]:
        return second, first
    return first, second


def _by_size(images: Sequence[_Input], words: str) -> tuple[list[_Input], list[_Input]]:
    """The two large and the two small of four images."""
    widths = [each.shape[-1] or 0 for each in images]
    if min(widths) == 0:  # sizes are not fixed: the names must say it
        halves = [each for each in images if re.search("half|init", each.name)]
    else:
        halves = [
            each for each, width in zip(images, widths, strict=True) if 2 * width == max(widths)
        ]
    if len(halves) != 2:
        raise ContractError(f"expected two images and the same two at half the size, got {words}")
    return [each for each in images if each not in halves], halves


def _size_of(image: _Input, channels_last: bool) -> tuple[int, int] | None:
    height, width = image.shape[1:3] if channels_last else image.shape[2:4]
    return (height, width) if height and width else None


def _flow(each: _Input, images: Sequence[_Input], published: Published | None) -> WarmStart:
    """The scale and unit of an initial flow."""
    channels, _ = _channels(each)
    if channels not in (1, 2):
        raise ContractError(f"expected a flow of two channels or a disparity, got {each.words}")
    width, whole = each.shape[3], images[0].shape[3]
    scale = whole // width if width and whole else 4
    factor = (published.flow_per_cell if published else None) or 1.0  # else proven later
    return WarmStart(each.name, channels, scale, factor / scale)


def _layout_of(value: NDArray[Any], size: tuple[int, int]) -> tuple[Layout, float] | None:
    """The layout of an output, and its width by that of the images; None: it is no map."""
    axes_orders: list[Layout] = {4: ["NCHW", "NHWC"], 3: ["NHW"], 2: ["HW"]}.get(value.ndim, [])  # type: ignore[assignment]
    for layout in axes_orders:
        height, width = (value.shape[layout.index(axis)] for axis in "HW")
        channels = value.shape[layout.index("C")] if "C" in layout else 1
        for scale in (1.0, 0.5, 0.25, 0.125, 0.0625):
            whole = (round(size[0] * scale), round(size[1] * scale))
            if (
                (height, width) == whole
                and channels <= _MOST_MAPS
                and np.issubdtype(value.dtype, np.number)
            ):
                return layout, scale
    return None
