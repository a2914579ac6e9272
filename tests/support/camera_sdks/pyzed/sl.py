"""The part of the ZED SDK that the recipe calls, with a camera that films the sample."""

from enum import Enum
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from room_camera import RIG, pair, world_from_left  # type: ignore[import-not-found]  # beside this


class VIEW(Enum):
    LEFT = 0
    RIGHT = 1


class ERROR_CODE(Enum):  # noqa: N801  the SDK's name
    SUCCESS = 0


class RESOLUTION(Enum):
    HD720 = 3


class DEPTH_MODE(Enum):  # noqa: N801
    NONE = 0


class UNIT(Enum):
    METER = 2


class COORDINATE_SYSTEM(Enum):  # noqa: N801
    IMAGE = 0


class REFERENCE_FRAME(Enum):  # noqa: N801
    WORLD = 0


class POSITIONAL_TRACKING_STATE(Enum):  # noqa: N801
    OK = 1
    SEARCHING = 0


class Mat:
    image: NDArray[np.uint8]

    def get_data(self) -> NDArray[np.uint8]:
        return self.image


class Pose:
    matrix: NDArray[np.float64]

    def pose_data(self) -> SimpleNamespace:
        return SimpleNamespace(m=self.matrix)


class InitParameters:
    """Settings."""


class PositionalTrackingParameters:
    """Settings."""


class Camera:
    def __init__(self) -> None:
        self._number = -1

    def open(self, settings: InitParameters) -> ERROR_CODE:
        assert settings.coordinate_units is UNIT.METER  # type: ignore[attr-defined]
        assert settings.coordinate_system is COORDINATE_SYSTEM.IMAGE  # type: ignore[attr-defined]
        return ERROR_CODE.SUCCESS

    def get_camera_information(self) -> SimpleNamespace:
        lenses = [
            SimpleNamespace(fx=RIG.fx, fy=RIG.fy, cx=cx, cy=RIG.cy)
            for cx in (RIG.cx_left, RIG.cx_right)
        ]
        calibration = SimpleNamespace(
            left_cam=lenses[0], right_cam=lenses[1], get_camera_baseline=lambda: RIG.baseline_m
        )
        size = SimpleNamespace(width=RIG.width, height=RIG.height)
        seen = SimpleNamespace(calibration_parameters=calibration, resolution=size)
        return SimpleNamespace(camera_configuration=seen)

    def enable_positional_tracking(self, settings: PositionalTrackingParameters) -> ERROR_CODE:
        return ERROR_CODE.SUCCESS

    def grab(self) -> ERROR_CODE:
        self._number += 1
        return ERROR_CODE.SUCCESS

    def get_position(self, pose: Pose, frame: REFERENCE_FRAME) -> POSITIONAL_TRACKING_STATE:
        pose.matrix = world_from_left(self._number)
        return POSITIONAL_TRACKING_STATE.OK

    def retrieve_image(self, into: Mat, view: VIEW) -> None:
        rgb = pair(self._number)[view.value]
        into.image = np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 255, np.uint8)])

    def close(self) -> None:
        """Stop filming."""
