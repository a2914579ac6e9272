"""The execution providers of onnxruntime, and runs whose states stay on the device."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from vergence_service.inference.installed import PROVIDERS as PROVIDERS
from vergence_service.inference.installed import ProviderUnavailable as ProviderUnavailable
from vergence_service.inference.tensors import DeviceTensor as DeviceTensor
from vergence_service.inference.tensors import Tensor as Tensor

ENGINE = f"onnxruntime {onnxruntime.__version__}"
# Each wheel of onnxruntime contains some providers; only one wheel can be installed at a time.
_WHEELS: Mapping[str, str] = {
    "cpu": "onnxruntime",
    "cuda": "onnxruntime-gpu",
    "tensorrt": "onnxruntime-gpu",
    "openvino": "onnxruntime-openvino",
}
# Providers with their own memory, and the name of their device in onnxruntime.
_DEVICES: Mapping[str, str] = {"cuda": "cuda", "tensorrt": "cuda"}


def require_provider(name: str) -> str:
    """Return onnxruntime's name. Raises ProviderUnavailable with the wheel to install."""
    available = onnxruntime.get_available_providers()
    usable = [short for short, full in PROVIDERS.items() if full in available]
    if name not in usable:
        raise ProviderUnavailable(
            f"provider {name!r} is not available in the installed onnxruntime; it has "
            f"{', '.join(usable)}. Replace the wheel: pip uninstall -y onnxruntime "
            f"onnxruntime-gpu onnxruntime-openvino && pip install {_WHEELS[name]}"
        )
    return PROVIDERS[name]


def device_of(name: str) -> str | None:
    """Return the device that a provider's memory is on, or None for host memory."""
    return _DEVICES.get(name)


def start_session(
    graph: Path, options: onnxruntime.SessionOptions, providers: Sequence[str]
) -> onnxruntime.InferenceSession:
    """Load a graph; ``providers`` are onnxruntime's names.

    Raises ProviderUnavailable if the first provider cannot start.
    """
    if providers[0] == PROVIDERS["cpu"]:
        _share_arena()
        options.add_session_config_entry("session.use_env_allocators", "1")
        # A pattern is one more buffer, as large as the peak of a step, for each size of image.
        options.enable_mem_pattern = False
    elif providers[0] in {PROVIDERS[name] for name in _DEVICES}:
        _load_cuda()
    options.log_severity_level = 4  # fatal: what is less is raised
    session = onnxruntime.InferenceSession(graph, options, providers=list(providers))
    # onnxruntime falls back to the CPU with a warning. A server must not do so silently.
    if session.get_providers()[0] != providers[0]:
        raise ProviderUnavailable(
            f"{providers[0]} is installed but failed to start; onnxruntime's message above names "
            "the reason (usually a missing driver or library)"
        )
    return session


@cache
def _load_cuda() -> None:
    """Load the libraries of NVIDIA's wheels, once per process: the linker does not look there."""
    onnxruntime.preload_dlls()


@cache
def _share_arena() -> None:
    """Make the arena that all sessions on the CPU share, once per process.

    An arena keeps what it has allocated. With one for each graph, a server that had stepped a few
    image sizes kept three times the memory of its largest step.
    """
    where = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    onnxruntime.create_and_register_allocator(where, None)


def returning_memory() -> onnxruntime.RunOptions:
    """Return the options of a run after which the shared arena returns what it does not use."""
    options = onnxruntime.RunOptions()
    options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
    return options


def run_on_device(
    session: onnxruntime.InferenceSession,
    feeds: Mapping[str, NDArray[np.generic] | DeviceTensor],
    *,
    to_host: Sequence[str],
    to_stay: Sequence[str],
    device: str,
) -> tuple[list[NDArray[np.float32]], list[DeviceTensor]]:
    """Run a graph once; return the outputs copied to the host and those left on ``device``.

    Outputs on the device can be inputs of the next run without a copy.
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
        binding.bind_output(name, device)  # every run allocates a new tensor
    binding.synchronize_inputs()
    session.run_with_iobinding(binding)
    binding.synchronize_outputs()
    outputs = binding.get_outputs()
    host = [value.numpy() for value in outputs[: len(to_host)]]
    return host, [DeviceTensor(value) for value in outputs[len(to_host) :]]
