"""The part of DepthAI 3 that the recipe calls, with a camera that films the sample."""

from collections.abc import Callable
from enum import Enum
from types import SimpleNamespace, TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from room_camera import RIG, grey, pair  # type: ignore[import-not-found]  # beside this file

TOP = 40  # 400 rows of the sample's 480


class CameraBoardSocket(Enum):
    CAM_B = 1
    CAM_C = 2


class LengthUnit(Enum):
    METER = 0


class ImgFrame:
    class Type(Enum):
        GRAY8 = 30

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self._image = image

    def getCvFrame(self) -> NDArray[np.uint8]:  # noqa: N802  the SDK's name
        return self._image


class MessageGroup(dict[str, ImgFrame]):
    """The images of one moment."""


class CalibrationHandler:
    def getCameraIntrinsics(  # noqa: N802
        self, socket: CameraBoardSocket, width: int, height: int
    ) -> list[list[float]]:
        assert (width, height) == (640, 400)
        cx = RIG.cx_left if socket is CameraBoardSocket.CAM_B else RIG.cx_right
        return [[RIG.fx, 0, cx], [0, RIG.fy, RIG.cy - TOP], [0, 0, 1]]

    def getDistortionCoefficients(self, socket: CameraBoardSocket) -> list[float]:  # noqa: N802
        return [0.0] * 14

    def getCameraExtrinsics(  # noqa: N802
        self, source: CameraBoardSocket, target: CameraBoardSocket, unit: LengthUnit
    ) -> list[list[float]]:
        assert unit is LengthUnit.METER
        target_from_source = np.eye(4)
        # A point of the right camera has a larger x in the left camera.
        target_from_source[0, 3] = RIG.baseline_m * (source.value - target.value)
        rows: list[list[float]] = target_from_source.tolist()
        return rows


class _Output:
    def __init__(self, socket: CameraBoardSocket) -> None:
        self.socket = socket

    def link(self, take: Callable[["_Output"], None]) -> None:
        take(self)


class _Camera:
    def build(self, socket: CameraBoardSocket) -> Self:
        self._socket = socket
        return self

    def requestOutput(  # noqa: N802
        self,
        size: tuple[int, int],
        kind: ImgFrame.Type,
        *,
        enableUndistortion: bool,  # noqa: N803
    ) -> _Output:
        assert (size, kind, enableUndistortion) == ((640, 400), ImgFrame.Type.GRAY8, False)
        return _Output(self._socket)


class _Inputs(dict[str, CameraBoardSocket]):
    def __getitem__(self, name: str) -> Any:  # an input, which an output is linked to
        return lambda output: self.update({name: output.socket})


class _Sync:
    def __init__(self) -> None:
        self.inputs = _Inputs()
        self._number = -1

    @property
    def out(self) -> "_Sync":
        return self

    def createOutputQueue(self, maxSize: int, blocking: bool) -> "_Sync":  # noqa: N802, N803
        assert (maxSize, blocking) == (1, False)
        return self

    def get(self) -> MessageGroup:
        self._number += 1
        views = dict(zip(CameraBoardSocket, pair(self._number), strict=True))
        return MessageGroup(
            {name: ImgFrame(grey(views[socket][TOP:440])) for name, socket in self.inputs.items()}
        )


node = SimpleNamespace(Sync=_Sync, Camera=_Camera)


class Pipeline:
    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop filming."""

    def create(self, kind: type) -> Any:
        return kind()

    def getDefaultDevice(self) -> SimpleNamespace:  # noqa: N802
        return SimpleNamespace(readCalibration=CalibrationHandler)

    def start(self) -> None:
        """Start filming."""
