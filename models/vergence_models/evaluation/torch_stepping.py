"""A training run stepped over footage by PyTorch, for counts without an exported graph."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vergence_models.config import load_config
from vergence_models.evaluation.stepping import Image, StepInputs, SteppedNetwork, StepResult
from vergence_models.networks.base import StepOutput
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
    def run(self, inputs: StepInputs, iterations: int) -> StepResult:
        state = tuple(torch.from_numpy(array) for array in inputs.state)
        matrix = torch.from_numpy(inputs.uvd_curr_from_prev)
        images = as_tensors(inputs.left, inputs.right)
        estimate, following = self._network(*images, matrix, state, iterations)
        return as_arrays(StepOutput(estimate.disparity, estimate.sigma, following))

    @torch.inference_mode()
    def start(self, left: Image, right: Image, iterations: int) -> StepResult:
        small = left.shape[1] * left.shape[2] <= self._config.max_pixels_at_2x
        at_2x = self._config.iterations_at_2x.get(iterations, 0) if small else 0
        return as_arrays(self._network.cold_step(*as_tensors(left, right), iterations, at_2x=at_2x))

    def refines_at_2x(self, iterations: int) -> bool:
        return iterations in self._config.iterations_at_2x


def as_tensors(left: Image, right: Image) -> tuple[Tensor, Tensor]:
    return (
        torch.from_numpy(np.ascontiguousarray(left)),
        torch.from_numpy(np.ascontiguousarray(right)),
    )


def as_arrays(output: StepOutput) -> StepResult:
    state = tuple(tensor.numpy() for tensor in output.state)
    return StepResult(output.disparity.numpy(), output.sigma.numpy(), state)
