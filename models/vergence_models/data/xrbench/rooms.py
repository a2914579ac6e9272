"""The rooms of the benchmark: the furniture and the light of each kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vergence_models.data.trajectories import rotation
from vergence_models.data.xrbench import furniture_meshes, meshes
from vergence_models.data.xrbench.floor_plan import FloorPlan, Wall
from vergence_models.data.xrbench.palette import SurfacePalette
from vergence_models.data.xrbench.things import Finish, Room, Surface, Thing, Workbench, placed


def build(kind: str, seed: int) -> Room:
    """A room of a kind in `ROOMS`; the same seed builds the same room."""
    # Each kind draws its own numbers: seed 1 of one is no relative of seed 1 of another.
    rng = np.random.default_rng([seed, list(ROOMS).index(kind)])
    plan = ROOMS[kind](rng, SurfacePalette(rng))
    start = np.eye(4)
    look = rng.uniform(-0.15, 0.15) - 0.5 * plan.eye_m[0] / plan.half_z
    start[:3, :3] = rotation(np.array([0, look, 0])) @ rotation(
        np.array([-rng.uniform(0.08, 0.25), 0, 0])
    )
    start[:3, 3] = plan.eye_m
    return Room(
        tuple(plan.things), tuple(plan.lamps), int(rng.integers(2**31)),
        float(rng.uniform(1.0, 2.5)), start,
    )  # fmt: skip


def living_room(rng: np.random.Generator, p: SurfacePalette) -> FloorPlan:
    plan = FloorPlan(rng, p, half_x=rng.uniform(1.9, 2.4), half_z=rng.uniform(2.2, 2.9), height=2.6)
    plan.shell(p.patterned("wood", span_m=1.6), p.plain(tone=0.6), _accent(rng, p))
    plan.against(Wall.FAR, "sofa", furniture_meshes.sofa)
    plan.against(Wall.FAR, "floor lamp", furniture_meshes.floor_lamp)
    plan.against(Wall.RIGHT, "bookshelf", furniture_meshes.bookshelf)
    plan.against(Wall.LEFT, "cabinet", furniture_meshes.cabinet)
    plan.against(Wall.LEFT, "plant", furniture_meshes.plant)
    _rug(plan, p)
    plan.anywhere("coffee table", furniture_meshes.coffee_table)
    plan.anywhere("chair", furniture_meshes.chair)
    plan.anywhere("plant", furniture_meshes.plant)
    _pictures(plan, p, rng, 3)
    plan.light(2, half_m=(0.35, 0.35), radiance=9)
    return plan


def office(rng: np.random.Generator, p: SurfacePalette) -> FloorPlan:
    plan = FloorPlan(rng, p, half_x=rng.uniform(2.0, 2.6), half_z=rng.uniform(2.2, 2.8), height=2.7)
    carpet = p.patterned("speckle", "weave", span_m=0.7)
    plan.shell(carpet, p.plain(tone=0.7))
    plan.against(Wall.FAR, "desk", furniture_meshes.desk)
    plan.against(Wall.RIGHT, "desk", furniture_meshes.desk)
    plan.against(Wall.FAR, "bookshelf", furniture_meshes.bookshelf)
    plan.against(Wall.LEFT, "cabinet", furniture_meshes.cabinet)
    plan.against(Wall.RIGHT, "plant", furniture_meshes.plant)
    for _ in range(3):
        plan.anywhere("office chair", furniture_meshes.office_chair, yaw=float(rng.uniform(0, 6.3)))
    plan.anywhere("table", furniture_meshes.table)
    _pictures(plan, p, rng, 1)
    plan.light(3, half_m=(0.6, 0.15), radiance=12)
    return plan


def kitchen(rng: np.random.Generator, p: SurfacePalette) -> FloorPlan:
    plan = FloorPlan(rng, p, half_x=rng.uniform(1.7, 2.1), half_z=rng.uniform(2.0, 2.5), height=2.5)
    tiles = p.patterned("tiles", span_m=1.2)
    plan.shell(p.patterned("tiles", "stones", span_m=1.0), p.plain(tone=0.7), tiles)
    plan.against(Wall.FAR, "counter", _counter)
    plan.against(Wall.RIGHT, "fridge", _fridge)
    plan.against(Wall.LEFT, "cabinet", furniture_meshes.cabinet)
    plan.anywhere("table", furniture_meshes.table)
    for _ in range(3):
        plan.anywhere("chair", furniture_meshes.chair, yaw=float(rng.uniform(0, 6.3)))
    shelf = Workbench()
    wood = p.wood()
    shelf.box(wood, (0, 0, 0), (0.8, 0.012, 0.1))
    furniture_meshes.set_out(shelf, p, rng, 0.75, 0.03, -0.012, count=6, tall_m=0.25)
    plan.add("shelf", shelf, placed(rng.uniform(-0.4, 0.4), -1.55, plan.half_z - 0.11))
    plan.light(2, half_m=(0.5, 0.2), radiance=10)
    return plan


def bedroom(rng: np.random.Generator, p: SurfacePalette) -> FloorPlan:
    plan = FloorPlan(rng, p, half_x=rng.uniform(1.9, 2.3), half_z=rng.uniform(2.2, 2.6), height=2.5)
    plan.shell(p.patterned("wood", "weave", span_m=1.4), p.plain(tone=0.6), _accent(rng, p))
    plan.against(Wall.FAR, "bed", furniture_meshes.bed)
    plan.against(Wall.RIGHT, "wardrobe", furniture_meshes.wardrobe)
    plan.against(Wall.LEFT, "cabinet", furniture_meshes.cabinet)
    plan.against(Wall.FAR, "floor lamp", furniture_meshes.floor_lamp)
    plan.anywhere("clothes rack", furniture_meshes.clothes_rack)
    plan.anywhere("chair", furniture_meshes.chair)
    _pictures(plan, p, rng, 2)
    plan.hang(Wall.RIGHT, p.mirror(), 0.25, 0.5, 1.4)
    plan.light(1, half_m=(0.5, 0.5), radiance=11)
    return plan


def studio(rng: np.random.Generator, p: SurfacePalette) -> FloorPlan:
    """Bare walls and few things: the hardest room for a matcher."""
    plan = FloorPlan(rng, p, half_x=rng.uniform(2.2, 2.8), half_z=rng.uniform(2.4, 3.0), height=3.0)
    plan.shell(p.plain(tone=0.5, finish=Finish.SATIN), p.plain(tone=0.75))
    plan.anywhere("table", furniture_meshes.table)
    plan.anywhere("chair", furniture_meshes.chair)
    plan.anywhere("plant", furniture_meshes.plant)
    plan.anywhere("floor lamp", furniture_meshes.floor_lamp)
    plan.anywhere("clothes rack", furniture_meshes.clothes_rack)
    plan.against(Wall.FAR, "sofa", furniture_meshes.sofa)
    plan.hang(Wall.RIGHT, p.mirror(), 0.3, 0.8, 1.2)
    plan.light(2, half_m=(0.7, 0.4), radiance=8)
    return plan


def playroom(rng: np.random.Generator, p: SurfacePalette) -> FloorPlan:
    """Objects move: a ball rolls, a box spins in the air, a balloon rises."""
    plan = living_room(rng, p)
    ball, box, balloon = Workbench(), Workbench(), Workbench()
    ball.add(p.patterned("dots", "plaid", span_m=0.3), meshes.ball((0.14,) * 3))
    box.box(p.patterned("print", "bricks", span_m=0.3), (0, 0, 0), (0.16, 0.1, 0.12))
    balloon.add(p.plain(finish=Finish.SATIN), meshes.ball((0.13, 0.16, 0.13)))
    balloon.rods(p.plain(), 0.003, ((0, 0.16, 0), (0, 0.6, 0)))
    ahead = plan.eye_m + np.array([0, 0, 1.5])
    moving = (
        ("ball", ball, (-0.9, -ahead[1] - 0.14, 0.4), (0.5, 0, 0.05), (0, 0, 3.5)),
        ("box", box, (0.45, 0.25, 0.2), (-0.25, 0.03, -0.1), (1.2, 1.9, 0.4)),
        ("balloon", balloon, (-0.35, -0.05, 0.7), (0.06, -0.12, 0.03), (0, 0.3, 0)),
    )  # fmt: skip
    for name, bench, offset, velocity, spin in moving:
        thing = Thing(name, bench.parts(), placed(*(ahead + np.array(offset))))
        plan.things.append(
            replace(thing, velocity_m_s=np.array(velocity, float), spin_rad_s=np.array(spin, float))
        )
    return plan


ROOMS: dict[str, Callable[[np.random.Generator, SurfacePalette], FloorPlan]] = {
    "living_room": living_room,
    "office": office,
    "kitchen": kitchen,
    "bedroom": bedroom,
    "studio": studio,
    "playroom": playroom,
}


def _accent(rng: np.random.Generator, p: SurfacePalette) -> Surface | None:
    """Wallpaper or bricks on the far wall, or paint like everywhere else."""
    if rng.random() < 0.5:
        return None
    return p.patterned("bricks", "stripes", "clouds", "dots", span_m=float(rng.uniform(0.5, 1.2)))


def _rug(plan: FloorPlan, p: SurfacePalette) -> None:
    bench = Workbench()
    bench.box(p.patterned("plaid", "patchwork", "stripes", span_m=1.0), (0, -0.006, 0),
              (0.9, 0.006, 0.65))  # fmt: skip
    plan.add("rug", bench, placed(0, 0, plan.half_z * 0.2, yaw=0.1))


def _pictures(plan: FloorPlan, p: SurfacePalette, rng: np.random.Generator, count: int) -> None:
    for _ in range(count):
        side = (Wall.FAR, Wall.RIGHT)[int(rng.integers(2))]
        half_x, half_y = rng.uniform(0.15, 0.4, 2)
        plan.hang(side, p.picture(), half_x, half_y, rng.uniform(1.4, 1.7))


def _counter(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """Cupboards under a worktop, with a tap, pots and crockery."""
    half_x, body, metal = rng.uniform(1.0, 1.3), p.plain(finish=Finish.SATIN), p.metal()
    b.box(body, (0, -0.44, 0.02), (half_x, 0.44, 0.27))
    b.box(p.patterned("stones", "speckle", "wood", span_m=0.6), (0, -0.9, 0), (half_x, 0.02, 0.3))
    doors = int(half_x / 0.25)
    for k in range(doors):
        x, half = (2 * (k + 0.5) / doors - 1) * half_x, half_x / doors
        b.box(body, (x, -0.46, -0.258), (half - 0.006, 0.4, 0.009))
        b.rods(metal, 0.006, ((x - 0.08, -0.8, -0.285), (x + 0.08, -0.8, -0.285)))
    foot, bend, mouth = (-0.3, -0.92, 0.2), (-0.3, -1.2, 0.2), (-0.3, -1.17, 0.02)
    b.rods(metal, 0.012, (foot, bend), (bend, mouth))
    for x in (0.15, 0.42):
        b.add(metal, meshes.lathe([(0.11, -0.13), (0.11, 0), (0.001, 0)]), (x, -0.92, 0.05))
    furniture_meshes.set_out(
        b, p, rng, half_x * 0.9, 0.1, -0.92, count=5, tall_m=0.3, front_m=-0.12
    )


def _fridge(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    paint = p.plain(tone=0.7, finish=Finish.SATIN)
    b.box(paint, (0, -0.9, 0.02), (0.3, 0.9, 0.3))
    for y, half in ((-0.6, 0.58), (-1.5, 0.28)):
        b.box(paint, (0, y, -0.3), (0.295, half, 0.02))
        b.box(p.metal(), (-0.24, y, -0.35), (0.01, min(half, 0.2), 0.01))
    for _ in range(4):
        x, y = rng.uniform(-0.15, 0.2), -rng.uniform(0.7, 1.6)
        b.add(p.picture(), meshes.sheet(0.06, 0.08), (x, y, -0.322))
