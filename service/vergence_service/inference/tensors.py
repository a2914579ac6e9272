"""Tensors of a state, on the host or on a device. Models without onnxruntime have them too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from onnxruntime import OrtValue


@dataclass(frozen=True, slots=True, eq=False)
class DeviceTensor:
    """A tensor that stays on its device. Tensors of a state are float32."""

    value: OrtValue

    @property
    def nbytes(self) -> int:
        return 4 * int(np.prod(self.value.shape()))

    def on_host(self) -> NDArray[np.float32]:
        copy: NDArray[np.float32] = self.value.numpy()
        return copy


Tensor = NDArray[np.float32] | DeviceTensor


def on_host(tensor: Tensor) -> NDArray[np.float32]:
    """Return the tensor of one stream in host memory: [C, h, w]."""
    return tensor.on_host()[0] if isinstance(tensor, DeviceTensor) else tensor
