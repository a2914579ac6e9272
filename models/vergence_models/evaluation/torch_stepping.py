"""A training run stepped over footage, where no graph of it was exported."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.config import load_config
from vergence_models.evaluation.stepping import Image, Plane, State, SteppedNetwork
from vergence_models.training.runs import Run, trained_network
from vergence_proto.model_io import ModelCard


class TorchNetwork(SteppedNetwork):
    """The averaged weights of a run, computed by PyTorch on the CPU: any iteration count."""

    def __init__(self, run: Run, *, threads: int = 2) -> None:
        torch.set_num_threads(threads)
        self._network = trained_network(run)
        self._config = load_config(run.config_name)
        self.card = ModelCard(
            name=run.config_name,
            stride=run.network.stride,
            max_disparity_px=run.network.max_disparity_px,
            state=self._network.state_tensors,
            graphs={},
            weights_sha256="",
        )

    @torch.inference_mode()
    def run(
        self,
        left: Image,
        right: Image,
        uvd_curr_from_prev: NDArray[np.float32],
        state: State,
        iterations: int,
    ) -> tuple[Plane, Plane, State]:
        images = as_tensors(left, right)
        tensors = tuple(torch.from_numpy(array) for array in state)
        estimate, following = self._network(
            *images, torch.from_numpy(uvd_curr_from_prev), tensors, iterations
        )
        return (
            estimate.disparity.numpy(),
            estimate.sigma.numpy(),
            tuple(tensor.numpy() for tensor in following),
        )

    @torch.inference_mode()
    def start(self, left: Image, right: Image, iterations: int) -> tuple[Plane, Plane, State]:
        small = left.shape[1] * left.shape[2] <= self._config.closer_max_pixels
        closer = self._config.closer.get(iterations, 0) if small else 0
        found = self._network.cold_step(*as_tensors(left, right), iterations, closer=closer)
        state = tuple(tensor.numpy() for tensor in found.state)
        return found.disparity.numpy(), found.sigma.numpy(), state

    def looks_closer(self, iterations: int) -> bool:
        return iterations in self._config.closer


def as_tensors(left: Image, right: Image) -> tuple[Tensor, Tensor]:
    return (
        torch.from_numpy(np.ascontiguousarray(left)),
        torch.from_numpy(np.ascontiguousarray(right)),
    )
