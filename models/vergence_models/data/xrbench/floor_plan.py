"""The floor plan of a room: its shell, and places for things that do not stand in one another."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vergence_models.data.xrbench import meshes
from vergence_models.data.xrbench.furniture_meshes import Maker
from vergence_models.data.xrbench.palette import SurfacePalette
from vergence_models.data.xrbench.things import Panel, Surface, Thing, Workbench, placed

# A head sways less than this from where it starts, and still has arm's length to the next thing.
_CLEARANCE_M = 0.95
_TRIES = 40
_THICK_M = 0.1  # thickness of walls


class Wall(Enum):
    """By the turn that brings a thing's back against it."""

    FAR = 0.0
    LEFT = -np.pi / 2
    RIGHT = np.pi / 2
    NEAR = np.pi


class FloorPlan:
    """A room around the origin, x in +-half_x and z in +-half_z, and what was put into it."""

    def __init__(
        self, rng: np.random.Generator, palette: SurfacePalette, *, half_x: float, half_z: float,
        height: float,
    ) -> None:  # fmt: skip
        self.half_x, self.half_z, self.height = half_x, half_z, height
        self.things: list[Thing] = []
        self.lamps: list[Panel] = []
        self._rng, self._palette = rng, palette
        eye_x = rng.uniform(-0.35, 0.35) * half_x
        self.eye_m = np.array([eye_x, -rng.uniform(1.25, 1.6), -half_z + rng.uniform(0.55, 0.8)])
        self._hung: list[tuple[Wall, float, float, float, float]] = []  # x, y, half its size
        self._taken: list[NDArray[np.float64]] = []  # x0, z0, x1, z1

    def add(self, name: str, bench: Workbench, frame: meshes.Matrix | None = None) -> None:
        """Put a thing where it says, whatever else is there."""
        self.things.append(Thing(name, bench.parts(), np.eye(4) if frame is None else frame))

    def shell(self, floor: Surface, walls: Surface, accent: Surface | None = None) -> None:
        """Floor and ceiling; the walls come with `wall`."""
        half = (self.half_x, _THICK_M, self.half_z)
        for name, y, surface in (
            ("floor", _THICK_M, floor),
            ("ceiling", -self.height - _THICK_M, self._palette.plain(tone=0.75)),
        ):
            bench = Workbench()
            bench.box(surface, (0, y, 0), half)
            self.add(name, bench)
        for side in Wall:
            self.wall(side, accent if accent and side is Wall.FAR else walls)

    def wall(self, side: Wall, surface: Surface) -> None:
        """A wall; the left one has a window."""
        width, away = self._extent(side)
        bench = Workbench()
        skirting = self._palette.plain(tone=0.6)
        bench.box(skirting, (0, -0.04, away - 0.008), (width, 0.04, 0.008))
        z, tall = away + _THICK_M, self.height / 2
        if side is not Wall.LEFT:
            bench.box(surface, (0, -tall, z), (width + _THICK_M, tall, _THICK_M))
            self.add("wall", bench, placed(0, 0, 0, yaw=side.value))
            return
        x, half = self._rng.uniform(-0.5, 0.3) * width, self._rng.uniform(0.5, 0.8)
        low, high = 0.9, min(2.1, self.height - 0.2)
        for x0, x1 in ((-width - _THICK_M, x - half), (x + half, width + _THICK_M)):
            bench.box(surface, ((x0 + x1) / 2, -tall, z), ((x1 - x0) / 2, tall, _THICK_M))
        for y0, y1 in ((0.0, low), (high, self.height)):
            bench.box(surface, (x, -(y0 + y1) / 2, z), (half, (y1 - y0) / 2, _THICK_M))
        frame = placed(0, 0, 0, yaw=side.value)
        self.add("wall", bench, frame)
        self.add(
            "window", self._window(half, (high - low) / 2), frame @ placed(x, -(low + high) / 2, z)
        )

    def _window(self, half_x: float, half_y: float) -> Workbench:
        """A frame with bars, perhaps blinds. No pane: it would cost samples and change little."""
        bench, paint = Workbench(), self._palette.plain(tone=0.75)
        for sign in (-1, 1):
            bench.box(paint, (sign * (half_x - 0.025), 0, 0), (0.025, half_y, 0.04))
            bench.box(paint, (0, sign * (half_y - 0.025), 0), (half_x, 0.025, 0.04))
        for x in np.linspace(-half_x, half_x, int(self._rng.integers(3, 5)))[1:-1]:
            bench.box(paint, (x, 0, 0), (0.012, half_y, 0.012))
        bench.box(paint, (0, 0, 0), (half_x, 0.012, 0.012))
        if self._rng.random() < 0.4:
            for y in np.arange(-half_y, self._rng.uniform(-0.5, 0.5) * half_y, 0.05):
                bench.box(paint, (0, y, -0.07), (half_x, 0.002, 0.018))
        return bench

    def against(self, side: Wall, name: str, make: Maker) -> None:
        """Build a thing and put it with its back to a wall; omit it if no place is free."""
        bench = self._built(make)
        low, high = _bounds(bench)
        width, away = self._extent(side)
        room = width - max(high[0], -low[0]) - 0.03
        for _ in range(_TRIES):
            at = placed(self._rng.uniform(-1, 1) * room, 0, away - high[2] - 0.03)
            if self._put(name, bench, placed(0, 0, 0, yaw=side.value) @ at):
                return

    def anywhere(self, name: str, make: Maker, *, yaw: float | None = None) -> Thing | None:
        """Build a thing and stand it free in the room, in front of the eye."""
        bench = self._built(make)
        for _ in range(_TRIES):
            x = self._rng.uniform(-0.8, 0.8) * self.half_x
            z = self._rng.uniform(self.eye_m[2] + 0.9, self.half_z * 0.7)
            turned = self._rng.uniform(-0.6, 0.6) if yaw is None else yaw
            if self._put(name, bench, placed(x, 0, z, yaw=turned)):
                return self.things[-1]
        return None

    def hang(self, side: Wall, surface: Surface, half_x: float, half_y: float, y_m: float) -> None:
        """Hang a picture or a mirror in a frame on a wall; omit it where another one hangs."""
        width, away = self._extent(side)
        bench, wood = Workbench(), self._palette.wood()
        bench.add(surface, meshes.sheet(half_x, half_y), (0, 0, -0.021))
        bench.box(wood, (0, 0, -0.01), (half_x, half_y, 0.01))
        for sign in (-1, 1):
            bench.box(wood, (sign * half_x, 0, -0.02), (0.015, half_y + 0.015, 0.02))
            bench.box(wood, (0, sign * half_y, -0.02), (half_x, 0.015, 0.02))
        x = self._rng.uniform(-0.8, 0.8) * (width - half_x)
        for other, other_x, other_y, reach_x, reach_y in self._hung:
            beside = abs(x - other_x) > half_x + reach_x + 0.05
            if other is side and not beside and abs(y_m - other_y) < half_y + reach_y + 0.05:
                return
        self._hung.append((side, x, y_m, half_x, half_y))
        turn = placed(0, 0, 0, yaw=side.value)
        self.add("mirror" if surface.finish.value == "mirror" else "picture", bench,
                 turn @ placed(x, -y_m, away))  # fmt: skip

    def light(self, count: int, *, half_m: tuple[float, float], radiance: float) -> None:
        """A row of panels under the ceiling."""
        warm = self._rng.uniform(-0.12, 0.12)
        color = radiance * (1 + warm), radiance, radiance * (1 - warm)
        for z in np.linspace(-self.half_z, self.half_z, count + 2)[1:-1]:
            frame = np.eye(4)
            frame[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its -z looks down, along +y
            frame[:3, 3] = (0, -self.height + 0.02, z)
            self.lamps.append(Panel("lamp", frame, half_m, color))

    def _extent(self, side: Wall) -> tuple[float, float]:
        """Half the width of a wall, and how far away it is."""
        if side in (Wall.FAR, Wall.NEAR):
            return self.half_x, self.half_z
        return self.half_z, self.half_x

    def _built(self, make: Maker) -> Workbench:
        bench = Workbench()
        make(bench, self._palette, self._rng)
        return bench

    def _put(self, name: str, bench: Workbench, frame: meshes.Matrix) -> bool:
        low, high = _bounds(bench)
        corners = np.array([[x, 0, z] for x in (low[0], high[0]) for z in (low[2], high[2])])
        ground = (corners @ frame[:3, :3].T + frame[:3, 3])[:, [0, 2]]
        own = np.concatenate([ground.min(0), ground.max(0)])
        eye = self.eye_m[[0, 2]]
        nearest = np.clip(eye, own[:2], own[2:])
        inside = (
            np.abs(own[[0, 2]]).max() <= self.half_x and np.abs(own[[1, 3]]).max() <= self.half_z
        )
        overlaps = any(
            (own[:2] < other[2:] - 0.02).all() and (own[2:] > other[:2] + 0.02).all()
            for other in self._taken
        )
        if not inside or overlaps or np.hypot(*(nearest - eye)) < _CLEARANCE_M:
            return False
        self._taken.append(own)
        self.add(name, bench, frame)
        return True


def _bounds(bench: Workbench) -> tuple[meshes.Matrix, meshes.Matrix]:
    points = np.concatenate([mesh.points for _, mesh in bench.parts()])
    return points.min(0), points.max(0)
