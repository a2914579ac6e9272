"""Cameras and videos with the left and the right view side by side, through OpenCV.

Many stereo cameras are USB cameras of this kind: ZED, ELP, and most that have no driver of their
own. Their pictures are rarely rectified; ``--calib`` names the calibration with which the server
rectifies them.
"""

import asyncio
import time
from collections.abc import AsyncGenerator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vergence.cli.errors import CliError
from vergence_proto.datasets import SourceFrame, nominal_ns
from vergence_proto.types import Image, StereoFrame

# Below this the picture is that of one lens. The narrowest stereo pictures have two square views.
_NARROWEST = 2.0


class SideBySide:
    """One camera or video.

    ``place`` is a number or a device (``0``, ``/dev/video0``), a file, or an address
    (``rtsp://HOST/PATH``). It is opened to see what it gives, and again for each :meth:`frames`:
    pictures that wait meanwhile would be old.

    Raises CliError: it cannot be opened, or its pictures are not two views side by side.
    """

    def __init__(self, place: str) -> None:
        recorded = Path(place).is_file()
        self._place = place
        with closing(_Capture(place)) as capture:
            first = capture.read()
            fps, count = capture.fps, capture.count
        if first is None:
            what = "a video that OpenCV reads" if recorded else "a camera (0 is the first one)"
            raise CliError(f"camera:{place} cannot be opened; expected {what}", exit_code=2)
        height, width = first.picture.shape[:2]
        if width < _NARROWEST * height:
            raise CliError(
                f"camera:{place} gives {width}x{height}: expected the left and the right view side "
                f"by side, at least {_NARROWEST:g} times as wide as it is high",
                exit_code=2,
            )
        self.name: str = Path(place).stem if recorded else f"camera-{Path(place).name}"
        self.size: tuple[int, int] = (width // 2, height)
        """Width and height of one view."""
        self.fps: float | None = fps
        self.count: int | None = count if recorded else None
        """The number of frames of a video, as its file states it."""
        self.live: bool = not recorded

    async def frames(self) -> AsyncGenerator[tuple[int, SourceFrame], None]:
        """Yield index and frame until the video ends, or the camera gives no more pictures."""
        capture = await asyncio.to_thread(_Capture, self._place)
        index, reading = 0, asyncio.ensure_future(asyncio.to_thread(capture.read))
        try:
            while (taken := await reading) is not None:
                reading = asyncio.ensure_future(asyncio.to_thread(capture.read))
                capture_ns = taken.at_ns if self.live else nominal_ns(index, self.fps)
                yield index, SourceFrame(_split(taken.picture, index, capture_ns))
                index += 1
        finally:
            # A camera must not be closed while it is read.
            await asyncio.gather(reading, return_exceptions=True)
            capture.close()


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    picture: Image  # both views
    at_ns: int


class _Capture:
    """An open camera or video; if it cannot be opened, it has no pictures."""

    def __init__(self, place: str) -> None:
        # One sentence of ours says more than those of all of OpenCV's backends.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        self._video = cv2.VideoCapture(int(place) if place.isdecimal() else place)

    @property
    def fps(self) -> float | None:
        fps = self._video.get(cv2.CAP_PROP_FPS)
        return fps if np.isfinite(fps) and fps > 0 else None

    @property
    def count(self) -> int | None:
        count = self._video.get(cv2.CAP_PROP_FRAME_COUNT)
        return int(count) if count > 0 else None

    def read(self) -> _Taken | None:
        there, picture = self._video.read()
        at_ns = time.monotonic_ns()
        if not there:
            return None
        return _Taken(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8), at_ns)

    def close(self) -> None:
        self._video.release()


def _split(picture: Image, index: int, capture_ns: int) -> StereoFrame:
    half = picture.shape[1] // 2
    left, right = (
        np.ascontiguousarray(view) for view in (picture[:, :half], picture[:, half : 2 * half])
    )
    return StereoFrame(index + 1, capture_ns, left, right)
