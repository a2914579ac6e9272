"""What onnxruntime runs a graph on, and how a graph is run where states stay on the device."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

ENGINE = f"onnxruntime {onnxruntime.__version__}"
# The names a person writes in the settings, and onnxruntime's.
PROVIDERS: Mapping[str, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}
# Each of onnxruntime's wheels has some of them; only one wheel can be installed at a time.
_WHEELS: Mapping[str, str] = {
    "cpu": "onnxruntime",
    "cuda": "onnxruntime-gpu",
    "tensorrt": "onnxruntime-gpu",
    "openvino": "onnxruntime-openvino",
}
# Those whose memory is not the host's, by onnxruntime's name of the device.
_DEVICES: Mapping[str, str] = {"cuda": "cuda", "tensorrt": "cuda"}


class ProviderUnavailable(RuntimeError):
    """The execution provider asked for cannot be used on this machine."""


@dataclass(frozen=True, slots=True, eq=False)
class DeviceTensor:
    """A tensor that stays on its device; one of a state is float32."""

    value: onnxruntime.OrtValue

    @property
    def nbytes(self) -> int:
        return 4 * int(np.prod(self.value.shape()))

    def on_host(self) -> NDArray[np.float32]:
        copy: NDArray[np.float32] = self.value.numpy()
        return copy


Tensor = NDArray[np.float32] | DeviceTensor


def require_provider(name: str) -> str:
    """The name that onnxruntime has for it. Raises ProviderUnavailable, with what to install."""
    available = onnxruntime.get_available_providers()
    usable = [short for short, full in PROVIDERS.items() if full in available]
    if name not in usable:
        raise ProviderUnavailable(
            f"provider {name!r} is not available in the installed onnxruntime; it has "
            f"{', '.join(usable)}. Put another wheel in its place: pip uninstall -y onnxruntime "
            f"onnxruntime-gpu onnxruntime-openvino && pip install {_WHEELS[name]}"
        )
    return PROVIDERS[name]


def device_of(name: str) -> str | None:
    """The device that a provider's memory is on; None for the host's own."""
    return _DEVICES.get(name)


def start_session(
    graph: Path, options: onnxruntime.SessionOptions, providers: Sequence[str]
) -> onnxruntime.InferenceSession:
    """Load a graph; ``providers`` are onnxruntime's names. Raises ProviderUnavailable."""
    session = onnxruntime.InferenceSession(graph, options, providers=list(providers))
    # onnxruntime falls back to the CPU with a warning; a server must not, unasked.
    if session.get_providers()[0] != providers[0]:
        raise ProviderUnavailable(
            f"{providers[0]} is installed but failed to start; onnxruntime's own message above "
            "says why (a missing driver or library, most often)"
        )
    return session


def run_on_device(
    session: onnxruntime.InferenceSession,
    feeds: Mapping[str, NDArray[np.generic] | DeviceTensor],
    *,
    to_host: Sequence[str],
    to_stay: Sequence[str],
    device: str,
) -> tuple[list[NDArray[np.float32]], list[DeviceTensor]]:
    """Run a graph once: outputs copied to the host, and outputs that stay on ``device``.

    What stayed is fed to the next run as it is, without a copy.
    """
    binding = session.io_binding()
    for name, value in feeds.items():
        if isinstance(value, DeviceTensor):
            binding.bind_ortvalue_input(name, value.value)
        else:
            binding.bind_cpu_input(name, np.ascontiguousarray(value))
    for name in to_host:
        binding.bind_output(name)
    for name in to_stay:
        binding.bind_output(name, device)  # allocated there, anew for every run
    binding.synchronize_inputs()
    session.run_with_iobinding(binding)
    binding.synchronize_outputs()
    outputs = binding.get_outputs()
    host = [value.numpy() for value in outputs[: len(to_host)]]
    return host, [DeviceTensor(value) for value in outputs[len(to_host) :]]
