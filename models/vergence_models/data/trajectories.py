"""Smooth head motion: sums of slow sinusoids in all six degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Amplitudes of the speed of a calm head, per axis (x right, y down, z forward).
_SPEED_M_S = np.array([0.12, 0.05, 0.12])
_TURN_RAD_S = np.array([0.15, 0.30, 0.08])
_WAVES = 3


@dataclass(frozen=True, slots=True, eq=False)
class HeadMotion:
    """Poses over time: `start_from_camera` is the motion away from the start."""

    frequency_hz: NDArray[np.float64]  # [waves, 6]
    phase: NDArray[np.float64]  # [waves, 6]
    rate: NDArray[np.float64]  # [waves, 6]: metres and radians a second

    @classmethod
    def draw(cls, rng: np.random.Generator, *, speed: float) -> HeadMotion:
        """A random motion; speed 1 is a calm head, 20 a violent one, 0 a tripod."""
        scale = np.concatenate([_SPEED_M_S, _TURN_RAD_S]) * speed / np.sqrt(_WAVES)
        return cls(
            frequency_hz=rng.uniform(0.1, 0.9, (_WAVES, 6)),
            phase=rng.uniform(0, 2 * np.pi, (_WAVES, 6)),
            rate=rng.normal(0, 1.2, (_WAVES, 6)) * scale,
        )

    def start_from_camera(self, time_s: float) -> NDArray[np.float64]:
        """Pose [4, 4] at a time, in the camera frame of time zero."""
        omega = 2 * np.pi * self.frequency_hz
        swing = np.sin(omega * time_s + self.phase) - np.sin(self.phase)
        moved = (self.rate / omega * swing).sum(0)
        pose = np.eye(4)
        pose[:3, :3] = rotation(moved[3:])
        pose[:3, 3] = moved[:3]
        return pose


def rotation(axis_angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] (Rodrigues)."""
    angle = np.linalg.norm(axis_angle, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(axis_angle / np.maximum(angle, 1e-12), -1, 0)
    zero = np.zeros_like(x)
    k = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    sine, cosine = np.sin(angle)[..., None], np.cos(angle)[..., None]
    return np.asarray(np.eye(3) + sine * k + (1 - cosine) * (k @ k))
