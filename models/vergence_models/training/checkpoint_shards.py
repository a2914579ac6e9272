"""Splitting a large checkpoint into files that travel anywhere: none reaches 16 MiB.

What is large is stored in half precision: weights as float16, which keeps more digits, the
optimizer's moments as bfloat16, which keeps the range that squares of gradients need. Small tensors
(biases, norms and their statistics) stay exact; they weigh nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

SHARD_BYTES = 15 * 2**20
SMALL = 2**14  # elements
LIFTED = "lifted"  # a dictionary of this one key stands where a tensor was taken out

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
    """Take the large tensors out: what remains, and pieces of them by name, in half precision."""
    pieces: list[dict[str, Tensor]] = []
    room = 0

    def lift(name: str, leaf: Any) -> Any:
        nonlocal room
        if not isinstance(leaf, Tensor) or leaf.numel() < SMALL or not leaf.is_floating_point():
            return leaf
        stored = leaf.detach().to("cpu", half)
        if stored.nbytes > room:
            pieces.append({})
            room = SHARD_BYTES
        room -= stored.nbytes
        pieces[-1][name] = stored
        return {LIFTED: name}

    return replaced(value, lift), pieces


def joined(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The inverse of :func:`split`, in float32. Raises KeyError for a tensor that is not there."""

    def put_back(name: str, leaf: Any) -> Any:
        return tensors[name].float() if isinstance(leaf, Mapping) else leaf

    return replaced(value, put_back)
