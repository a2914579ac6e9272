"""What this machine has, without onnxruntime: providers by name, cores, the installed weights."""

import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path

# The names in the settings, and the names in onnxruntime.
PROVIDERS: Mapping[str, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}


class ProviderUnavailable(RuntimeError):
    """A requested engine or execution provider cannot be used on this machine."""


def usable_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def packaged_weights_dir() -> Path:
    """Return the folder of the installed weights, without importing their package.

    Raises FileNotFoundError if no weights are installed.
    """
    spec = importlib.util.find_spec("vergence_models")
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(
            "no weights are installed; name a folder with a manifest.json in model.weights"
        )
    return Path(next(iter(spec.submodule_search_locations))) / "weights"
