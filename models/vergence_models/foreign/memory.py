"""The memory of a step, measured in a process of its own: ``python -m`` this, FOLDER NAME H W."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from vergence_models.foreign.contract import Contract
from vergence_models.foreign.proof import texture_size
from vergence_proto.model_io import StepMemory

_STATUS = Path("/proc/self/status")
_SPARE = 1.3  # allocators differ
_BESIDE_BYTES = 8 << 20
_MAPS_BYTES_A_PIXEL = 64.0  # of resizing to and from a graph of a fixed size


def measured_memory(folder: Path, name: str, contract: Contract) -> StepMemory | None:
    """Return the memory of a step of any size; None if this system does not report it."""
    if not _STATUS.exists():
        return None
    height, width = texture_size(contract)
    if contract.size is not None:
        found = _measured(folder, name, height, width)
        if found is None:
            return None
        return StepMemory(_BESIDE_BYTES + int(_SPARE * found), _MAPS_BYTES_A_PIXEL, 0.0)
    narrow, wide = (_measured(folder, name, height, each) for each in (width, 2 * width))
    if narrow is None or wide is None:
        return None
    # Volumes relate pixels to columns: bytes per pixel grow with the width.
    per_pixel, twice = narrow / (height * width), wide / (2 * height * width)
    per_column = max(0.0, (twice - per_pixel) / width)
    per_pixel = max(twice - per_column * 2 * width, per_pixel - per_column * width, 1.0)
    return StepMemory(_BESIDE_BYTES, _SPARE * per_pixel, _SPARE * per_column)


def _measured(folder: Path, name: str, height: int, width: int) -> int | None:
    arguments = [str(folder), name, str(height), str(width)]
    command = [sys.executable, "-m", "vergence_models.foreign.memory", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return int(done.stdout) if done.returncode == 0 else None


def _resident(which: str) -> int:
    lines = _STATUS.read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(which))


def _step_once(folder: Path, name: str, height: int, width: int) -> int:
    """Return the bytes by which the largest step of a model grows this process."""
    import numpy as np

    from vergence_models.evaluation.stepping import OnnxNetwork

    network = OnnxNetwork(folder, name, threads=1)
    image = np.random.default_rng(0).integers(0, 255, (1, height, width, 3), np.uint8)
    before = _resident("VmRSS")
    network.start(image, image, max(network.card.graphs))
    return _resident("VmHWM") - before


if __name__ == "__main__":
    folder, name, height, width = sys.argv[1:]
    sys.stdout.write(str(_step_once(Path(folder), name, int(height), int(width))))
