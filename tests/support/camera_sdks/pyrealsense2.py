"""The part of pyrealsense2 that the recipe calls, with a camera that films the sample."""

from enum import Enum
from types import SimpleNamespace
from typing import Any

from room_camera import RIG, grey, pair  # type: ignore[import-not-found]  # beside this file


class stream(Enum):  # noqa: N801  the SDK's name
    infrared = 3


class format(Enum):  # noqa: N801
    y8 = 9


class option(Enum):  # noqa: N801
    emitter_enabled = 18


pipeline_profile = Any  # only an annotation


class _Stream:
    def __init__(self, index: int) -> None:
        self.index = index

    def as_video_stream_profile(self) -> "_Stream":
        return self

    def get_intrinsics(self) -> SimpleNamespace:
        cx = RIG.cx_left if self.index == 1 else RIG.cx_right
        lens = {"fx": RIG.fx, "fy": RIG.fy, "ppx": cx, "ppy": RIG.cy}
        return SimpleNamespace(width=RIG.width, height=RIG.height, **lens)

    def get_extrinsics_to(self, other: "_Stream") -> SimpleNamespace:
        sign = self.index - other.index
        return SimpleNamespace(translation=[sign * RIG.baseline_m, 0, 0])


class _Sensor:
    def set_option(self, which: option, value: float) -> None:
        assert (which, value) == (option.emitter_enabled, 0)


class _Profile:
    def get_stream(self, kind: stream, index: int) -> _Stream:
        assert kind is stream.infrared
        return _Stream(index)

    def get_device(self) -> "_Profile":
        return self

    def first_depth_sensor(self) -> _Sensor:
        return _Sensor()


class config:  # noqa: N801
    def __init__(self) -> None:
        self.enabled: list[int] = []

    def enable_stream(
        self, kind: stream, index: int, width: int, height: int, how: format, fps: int
    ) -> None:
        assert (width, height, how) == (RIG.width, RIG.height, format.y8)
        self.enabled.append(index)


class _Frames:
    def __init__(self, number: int) -> None:
        self._pair = pair(number)

    def get_infrared_frame(self, index: int) -> SimpleNamespace:
        return SimpleNamespace(get_data=lambda: grey(self._pair[index - 1]))


class pipeline:  # noqa: N801
    def __init__(self) -> None:
        self._number = -1

    def start(self, chosen: config) -> _Profile:
        assert chosen.enabled == [1, 2]
        return _Profile()

    def wait_for_frames(self) -> _Frames:
        self._number += 1
        return _Frames(self._number)

    def stop(self) -> None:
        """Stop filming."""
