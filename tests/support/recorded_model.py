"""A network that answers from a record, in the time that a GPU would take.

So a benchmark of the way to the server measures the way, and not the model on this machine's CPU.
``python -m`` this module serves it: RECORD.npz HOST [SETTING=VALUE...]. With "recall" as the
record, it serves the tiny model of the tests, whose answers show its memory.
"""

import asyncio
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.support.models import RecallModel
from vergence_proto.model_io import ModelCard, load_model_card
from vergence_proto.types import Plane, StereoFrame, StereoRig
from vergence_service.app.server import running
from vergence_service.inference.engines import load_model
from vergence_service.inference.model import (
    RecurrentState,
    Step,
    StepResult,
    StereoView,
)
from vergence_service.inference.onnx_model import packaged_weights_dir
from vergence_service.settings import load_settings

STEP_S = 0.015
_NAME = "lite"
_THUMBNAIL = (32, 24)


def record(frames: Sequence[StereoFrame], rig: StereoRig, path: Path) -> NDArray[np.float32]:
    """Write the shipped network's maps of a sequence to ``path``; return them, [N, H, W]."""
    model = load_model(
        packaged_weights_dir(),
        _NAME,
        engine="auto",
        providers=["cpu"],
        threads=2,
        allow_spinning=False,
    )
    rectified = rig.as_rectified()
    assert rectified is not None
    card, state, maps = model.card, None, []
    for frame in frames:
        pose = frame.pose.world_from_left if frame.pose else None
        view = StereoView(frame.left, frame.right, rectified, frame.capture_ns, pose)
        iterations = card.iterations_at_most(1 if state else 5)
        [result] = model.step([Step(view, state, iterations)])
        state = result.state
        maps.append(result.offset_px)
    stacked = np.stack(maps).astype(np.float32)
    np.savez(path, maps=stacked, thumbnails=np.stack([_thumbnail(each.left) for each in frames]))
    return stacked


class RecordedModel:
    """Answers each step with the recorded map of the picture that is most like it."""

    provider = "record"
    engine = "record 1"
    max_concurrent_steps = 1

    def __init__(self, path: Path) -> None:
        with np.load(path) as content:
            self._maps = content["maps"]
            self._thumbnails = content["thumbnails"]
        self.card: ModelCard = load_model_card(packaged_weights_dir(), _NAME)
        height, width = self._maps.shape[1:]
        size = self.card.step_size(height, width)
        self._memory = tuple(np.zeros(each.shape(*size), np.float32) for each in self.card.state)

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        """Do nothing."""

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        return 16 * height * width

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        ends_s = time.monotonic() + STEP_S
        results = [self._answer(each) for each in steps]
        time.sleep(max(ends_s - time.monotonic(), 0.0))
        return results

    def _answer(self, step: Step) -> StepResult:
        away = np.abs(self._thumbnails - _thumbnail(step.view.left)).mean(axis=(1, 2))
        offset_px: Plane = self._maps[int(away.argmin())]
        state = RecurrentState.after(step.view, step.state, self._memory)
        return StepResult(offset_px, np.ones_like(offset_px), state)


def _thumbnail(image: NDArray[np.uint8]) -> NDArray[np.int16]:
    return cv2.resize(image[..., 1], _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.int16)


async def _serve(record: str, host: str, flags: dict[str, str]) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    with tempfile.TemporaryDirectory() as jobs:
        settings = load_settings(
            flags={"server.host": host, "security.insecure": True, "batch.directory": jobs}
            | {"grpc.port": 0, "http.port": 0}
            | flags
        )
        model = RecallModel() if record == "recall" else RecordedModel(Path(record))
        async with running(settings, model) as server:
            print(server.grpc_address, server.http_address, flush=True)  # noqa: T201
            await stop.wait()


if __name__ == "__main__":
    _record, _host, *_flags = sys.argv[1:]
    asyncio.run(_serve(_record, _host, dict(each.split("=", 1) for each in _flags)))
