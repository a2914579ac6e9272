"""A foreign graph in its contract, run on pairs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from vergence_models.foreign.compose import MIRRORED, NETWORK, graph_after, graph_before, state_of
from vergence_models.foreign.contract import Contract, ContractError
from vergence_models.foreign.textures import Image, Plane
from vergence_proto.model_io import DISPARITY, LEFT, RIGHT, SIGMA, UVD_CURR_FROM_PREV

Tensors = dict[str, NDArray[Any]]


def session_of(graph: bytes | Path, what: str) -> onnxruntime.InferenceSession:
    """Load a graph. Raises ContractError with the first sentence of what onnxruntime says."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has an exception for each of its statuses
        raise ContractError(f"onnxruntime cannot load {what}: {first_line(error)}") from None


def first_line(error: BaseException) -> str:
    """The first line of a message, without onnxruntime's status and the place of a file."""
    text = re.sub(
        r"^\[ONNXRuntimeError\] : \d+ : \w+ : (Load model from \S+ failed:)?", "", str(error)
    )
    lines = text.strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__


class Network:
    """The foreign graph itself, with the names of its tensors changed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._session = session_of(path, path.name)

    def run(self, feeds: Mapping[str, NDArray[Any]], prefix: str) -> Tensors:
        """Return every output as ``prefix`` + name, for inputs called ``prefix`` + name.

        Raises ContractError if the graph refuses the inputs.
        """
        own = {
            each.name: feeds[prefix + each.name.removeprefix(NETWORK)]
            for each in self._session.get_inputs()
        }
        names = [each.name for each in self._session.get_outputs()]
        try:
            values = self._session.run(names, own)
        except Exception as error:
            raise ContractError(f"the graph fails on a pair: {first_line(error)}") from None
        return {
            prefix + name.removeprefix(NETWORK): value
            for name, value in zip(names, values, strict=True)
        }


class Trial:
    """One contract tried on one network: a cold or a warm step of one pair."""

    def __init__(
        self,
        contract: Contract,
        network: Network,
        *,
        before: Path | None = None,
        after: Path | None = None,
    ) -> None:
        """``before`` and ``after`` are stored graphs; otherwise they are made from the contract."""
        self.contract = contract
        self._network = network
        graph = before or graph_before(contract).SerializeToString()
        self._before = session_of(graph, "the graph before")
        self._after = session_of(after, "the graph after") if after else None

    def raw(self, left: Image, right: Image, state: Tensors | None = None) -> Tensors:
        """Return the outputs of the foreign graph, and of its mirrored run if there is one."""
        feeds: Tensors = {LEFT: left[None], RIGHT: right[None]}
        for tensor in state_of(self.contract):
            shape = (1, *tensor.shape(*left.shape[:2]))
            feeds[UVD_CURR_FROM_PREV] = np.eye(4, dtype=np.float32)[None]
            feeds[tensor.input_name] = (
                np.zeros(shape, np.float32) if state is None else state[tensor.output_name]
            )
        names = [each.name for each in self._before.get_outputs()]
        given = dict(zip(names, self._before.run(names, feeds), strict=True))
        found = self._network.run(given, NETWORK)
        if self.contract.sigma == "left-right":
            found |= self._network.run(given, MIRRORED)
        return found

    def step(self, left: Image, right: Image, state: Tensors | None = None) -> Tensors:
        """Return all outputs of a step by name. ``state`` holds those of the step before."""
        if self._after is None:
            graph = graph_after(self.contract).SerializeToString()
            self._after = session_of(graph, "the graph after")
        found = {**self.raw(left, right, state), LEFT: left[None]}
        feeds = {each.name: found[each.name] for each in self._after.get_inputs()}
        names = [each.name for each in self._after.get_outputs()]
        try:
            return dict(zip(names, self._after.run(names, feeds), strict=True))
        except Exception as error:
            raise ContractError(
                f"the output {self.contract.output} is not as described: {first_line(error)}"
            ) from None

    def disparity_px(self, left: Image, right: Image) -> Plane:
        disparity: Plane = self.step(left, right)[DISPARITY][0]
        return disparity

    def sigma_px(self, left: Image, right: Image) -> Plane:
        sigma: Plane = self.step(left, right)[SIGMA][0]
        return sigma
