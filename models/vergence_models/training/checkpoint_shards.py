"""Shards of a large checkpoint: files below 16 MiB, which can be stored anywhere.

Large tensors are stored in half precision: weights as float16, which keeps more digits, the
optimizer's moments as bfloat16, which keeps the range that squares of gradients need. Small tensors
(biases, norms and their statistics) stay exact; they need little room.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

SHARD_BYTES = 15 * 2**20
SMALL = 2**14  # tensors of fewer elements stay in the index
LIFTED = "lifted"  # a dictionary with this one key marks the place of a tensor in a shard

HALF = {"weights": torch.float16, "average": torch.float16, "optimizer": torch.bfloat16}


def tensors_of(value: Any) -> Iterator[Tensor]:
    """All tensors in nested dictionaries and lists."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from tensors_of(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from tensors_of(inner)


def replaced(value: Any, change: Callable[[str, Any], Any], name: str = "") -> Any:
    """A copy of nested dictionaries and lists, every leaf (and mark) passed through ``change``."""
    if isinstance(value, Mapping) and LIFTED not in value:
        return {key: replaced(inner, change, f"{name}/{key}") for key, inner in value.items()}
    if isinstance(value, list):
        return [replaced(inner, change, f"{name}/{place}") for place, inner in enumerate(value)]
    return change(name, value)


def split(value: Any, half: torch.dtype) -> tuple[Any, list[dict[str, Tensor]]]:
    """Move the large tensors into shards, in half precision; returns the rest, and the shards."""
    shards: list[dict[str, Tensor]] = []
    room = 0

    def lift(name: str, leaf: Any) -> Any:
        nonlocal room
        if not isinstance(leaf, Tensor) or leaf.numel() < SMALL or not leaf.is_floating_point():
            return leaf
        stored = leaf.detach().to("cpu", half)
        if stored.nbytes > room:
            shards.append({})
            room = SHARD_BYTES
        room -= stored.nbytes
        shards[-1][name] = stored
        return {LIFTED: name}

    return replaced(value, lift), shards


def joined(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The inverse of :func:`split`, in float32. Raises KeyError for a tensor that is not there."""

    def put_back(name: str, leaf: Any) -> Any:
        return tensors[name].float() if isinstance(leaf, Mapping) else leaf

    return replaced(value, put_back)
