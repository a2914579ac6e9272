"""Recipes, what is written for them, and what the command says."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from vergence_models.data.xrbench import rooms, truths
from vergence_models.data.xrbench.__main__ import main
from vergence_models.data.xrbench.camera import Eye, StereoCamera
from vergence_models.data.xrbench.floor_plan import FloorPlan, Wall
from vergence_models.data.xrbench.head_path import HeadPath
from vergence_models.data.xrbench.meshes import Matrix
from vergence_models.data.xrbench.palette import SurfacePalette
from vergence_models.data.xrbench.recipe import KINDS, SETS, BadRecipe, Effects, Recipe
from vergence_models.data.xrbench.sheet import contact_sheet
from vergence_models.data.xrbench.things import Room, Thing
from vergence_models.data.xrbench.writer import render_sequence
from vergence_proto.datasets import open_source

pytestmark = pytest.mark.slow  # it renders with a path tracer

TINY = Recipe("studio", frames=1, width=32, height=24, samples=4, fps=20, baseline_m=0.07)


@pytest.fixture(scope="module")
def camera() -> StereoCamera:
    """A camera that films TINY, for any number of frames."""
    return StereoCamera(TINY, variant="scalar_rgb")


@pytest.fixture(scope="module")
def rendered_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tiny")
    render_sequence(TINY, out, passes=("clean",), variant="scalar_rgb")
    return out


@pytest.fixture
def rendered(rendered_once: Path, tmp_path: Path) -> Path:
    """The clean pass of TINY, in a folder of the test's own."""
    return shutil.copytree(rendered_once, tmp_path / "tiny")


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vergence_models.data.xrbench", *arguments],
        capture_output=True, text=True, env=os.environ | environment, check=False,
    )  # fmt: skip


class TestRecipe:
    def test_json_keeps_every_field(self) -> None:
        recipe = Recipe("office", seed=7, speed=6.0, effects=Effects(glare=0.5))
        assert Recipe.from_json(recipe.to_json(), Path("x.json")) == recipe

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ('{"room": "attic"}', "there are living_room, office"),
            ('{"room": "office", "frames": 0}', "frames must be at least 1"),
            ('{"room": "office", "baseline_m": -1}', "baseline_m must be positive"),
            ('{"room": "office", "fov_deg": 180}', "fov_deg must lie in"),
            ('{"room": "office", "height": 2}', "8x8"),
            ('{"room": "office", "speed": -1}', "must not be negative"),
            ('{"room": "office", "effects": {"glare": 2}}', "shares up to 1"),
            ('{"room": "office", "effects": {"flicker_hz": NaN}}', "flicker_hz"),
            ('{"room": "office", "lens": 1}', "unexpected keyword argument 'lens'"),
            ('{"room": "office", "frames": "many"}', "frames must be of type int"),
            ('{"room": "office", "effects": {"flicker": "no"}}', "effects.flicker"),
            ("[]", "no recipe"),
            ("{", "no recipe"),
        ],
    )
    def test_what_cannot_be_rendered_is_refused_by_name(self, text: str, message: str) -> None:
        with pytest.raises(BadRecipe, match=r"x\.json") as caught:
            Recipe.from_json(text, Path("x.json"))
        assert message in str(caught.value)

    @pytest.mark.parametrize("name", SETS)
    def test_sequences_of_a_set_have_folders_of_their_own(self, name: str) -> None:
        names = [recipe.name for recipe in SETS[name]]
        assert len(set(names)) == len(names)


def hung_boxes(things: Sequence[Thing]) -> list[tuple[Matrix, Matrix]]:
    """The lowest and the highest corner of every picture and mirror, in world axes."""
    boxes = []
    for thing in things:
        if thing.name in ("picture", "mirror"):
            (_, mesh), *_ = thing.parts
            points = mesh.moved(thing.pose(0)).points
            boxes.append((points.min(0), points.max(0)))
    return boxes


def are_apart(box: tuple[Matrix, Matrix], other: tuple[Matrix, Matrix]) -> bool:
    """Two surfaces in one place have no truth that could tell them apart."""
    return bool(((box[0] > other[1]) | (box[1] < other[0])).any())


@pytest.mark.parametrize("kind", ["living_room", "bedroom", "playroom"])
def test_no_picture_hangs_in_another_one(kind: str) -> None:
    rooms_boxes = [hung_boxes(rooms.build(kind, seed).things) for seed in range(1, 6)]
    pairs = [pair for boxes in rooms_boxes for pair in itertools.combinations(boxes, 2)]
    assert len(pairs) >= 5  # other kinds of room hang one picture or none
    assert all(are_apart(*pair) for pair in pairs)


def test_a_crowded_wall_refuses_pictures_that_would_overlap() -> None:
    random = np.random.default_rng(1)
    palette = SurfacePalette(random)
    plan = FloorPlan(random, palette, half_x=2.0, half_z=2.0, height=2.6)
    for _ in range(30):
        plan.hang(Wall.FAR, palette.picture(), 0.3, 0.2, random.uniform(1.2, 1.8))
    boxes = hung_boxes(plan.things)
    assert 3 <= len(boxes) < 30
    assert all(are_apart(*pair) for pair in itertools.combinations(boxes, 2))


@pytest.mark.parametrize("kind", KINDS)
class TestRooms:
    def test_a_seed_builds_one_room(self, kind: str) -> None:
        def numbers(room: Room) -> bytes:
            return b"".join(
                mesh.moved(thing.world_from_thing).points.tobytes()
                for thing in room.things
                for _, mesh in thing.parts
            )

        assert numbers(rooms.build(kind, 3)) == numbers(rooms.build(kind, 3))
        assert numbers(rooms.build(kind, 3)) != numbers(rooms.build(kind, 4))

    def test_the_head_stays_in_the_room_and_out_of_things(self, kind: str) -> None:
        room = rooms.build(kind, 1)
        path = HeadPath(Recipe(kind), room)
        eyes = np.array([path.world_from_left(t)[:3, 3] for t in np.arange(0, 60, 0.1)])
        floor = next(thing for thing in room.things if thing.name == "floor")
        low, high = floor.bounds_m()
        assert (eyes[:, [0, 2]] > low[[0, 2]] + 0.1).all()
        assert (eyes[:, [0, 2]] < high[[0, 2]] - 0.1).all()
        points = np.concatenate(
            [mesh.moved(thing.pose(0)).points for thing in room.things for _, mesh in thing.parts]
        )
        nearest_m = min(float(np.linalg.norm(points - eye, axis=1).min()) for eye in eyes[::10])
        assert nearest_m > 0.25

    def test_normals_are_unit_and_agree_with_how_faces_are_wound(self, kind: str) -> None:
        for thing in rooms.build(kind, 1).things:
            for _, mesh in thing.parts:
                np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)
                a, b, c = (mesh.points[mesh.faces[:, k]] for k in range(3))
                wound = np.cross(b - a, c - a)
                assert (np.einsum("fk,fk->f", wound, mesh.normals[mesh.faces[:, 0]]) >= 0).all()


def test_at_six_times_the_speed_a_frame_is_six_frames_on() -> None:
    room = rooms.build("office", 1)
    calm, fast = (HeadPath(Recipe("office", speed=speed), room) for speed in (1.0, 6.0))
    for frame in range(5):
        np.testing.assert_allclose(
            fast.world_from_left(fast.frame_time_s(frame)),
            calm.world_from_left(calm.frame_time_s(6 * frame)),
            atol=1e-12,
        )


def test_what_is_written_reads_as_sceneflow(camera: StereoCamera, tmp_path: Path) -> None:
    recipe = dataclasses.replace(TINY, frames=2)
    folder = render_sequence(recipe, tmp_path, variant="scalar_rgb")
    assert folder == tmp_path / "frames_finalpass" / recipe.name
    for which in ("clean", "final"):
        source = open_source(f"sceneflow:{tmp_path}/frames_{which}pass/{recipe.name}")
        assert (len(source), source.fps, source.metric) == (2, 20, True)
        rig = source.rig.as_rectified()
        assert rig is not None
        assert rig.fx == pytest.approx(recipe.focal_px)
        assert rig.baseline_m == pytest.approx(0.07)
        for frame, read in enumerate(source):
            truth = camera.truth(frame)
            assert read.truth_px is not None
            assert read.truth_mask is not None
            assert read.frame.pose is not None
            known = np.isfinite(truth.depth_m)
            np.testing.assert_array_equal(read.truth_px[known], truth.disparity_px[known])
            assert np.isnan(read.truth_px[~known]).all()
            np.testing.assert_array_equal(read.truth_mask, ~truth.specular)
            expected = camera.world_from_eye(frame / 20, Eye.LEFT)
            np.testing.assert_allclose(read.frame.pose.world_from_left.matrix, expected, atol=1e-9)
            if which == "clean":
                np.testing.assert_array_equal(read.frame.left, camera.clean(frame, Eye.LEFT))
                np.testing.assert_array_equal(read.frame.right, camera.clean(frame, Eye.RIGHT))
    sheet = contact_sheet(tmp_path, recipe.name, 0)
    # Each tile is 320 wide here, ten times its size, with margins of 8 and a name below.
    assert sheet.shape == (2 * (240 + 40), 3 * (320 + 16), 3)
    first = sheet[8 : 8 + 240, 8 : 8 + 320]
    np.testing.assert_array_equal(first[5::10, 5::10], camera.clean(0, Eye.LEFT))
    assert sheet[8 + 240 : 240 + 40, :320].std() > 5  # its name


def test_every_file_of_a_frame_holds_what_is_known_of_it(
    camera: StereoCamera, rendered: Path
) -> None:
    truth, name = camera.truth(0), TINY.name

    def picture(kind: str) -> NDArray[np.generic]:
        path = rendered / kind / name / "left" / "0000.png"
        return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))

    def pfm(path: str) -> NDArray[np.float32]:
        """By OpenCV's reader, not ours."""
        return np.asarray(cv2.imread(str(rendered / path), cv2.IMREAD_UNCHANGED))

    np.testing.assert_array_equal(picture("object_index"), truth.label)
    np.testing.assert_array_equal(picture("specular") != 0, truth.specular)
    normals = picture("normals")[..., ::-1].astype(float) / 32767 - 1
    np.testing.assert_allclose(normals, truth.normals, atol=2e-5)
    for side, expected in (("left", truth.disparity_px), ("right", truth.right_disparity_px)):
        np.testing.assert_array_equal(pfm(f"disparity/{name}/{side}/0000.pfm"), expected)
    np.testing.assert_array_equal(pfm(f"depth/{name}/left/0000.pfm"), truth.depth_m)
    for way, motion in (("Future", truth.into_future), ("Past", truth.into_past)):
        file = f"into_{way.lower()}/left/OpticalFlowInto{way}_0000_L.pfm"
        flow = pfm(f"optical_flow/{name}/{file}")[..., ::-1]  # OpenCV turns channels around
        np.testing.assert_array_equal(flow[..., :2], motion.flow_px)
        assert (flow[..., 2] == 0).all()
    boxes = rendered / "object_boxes" / name / "0000.json"
    assert json.loads(boxes.read_text()) == truth.boxes
    rays = np.load(rendered / "rays" / name / "left.npy")
    np.testing.assert_array_equal(rays, truths.rays(camera.optics))


def test_the_sample_that_is_shipped_is_what_its_recipe_renders() -> None:
    (recipe,) = SETS["sample"]
    sample = Path(__file__).parents[2] / "models" / "xrbench_sample"
    shipped = (sample / "recipes" / f"{recipe.name}.json").read_text()
    assert Recipe.from_json(shipped, sample) == recipe
    camera = StereoCamera(recipe, variant="scalar_rgb")
    source = open_source(f"sceneflow:{sample}/frames_finalpass/{recipe.name}")
    assert len(source) == recipe.frames
    for frame, read in enumerate(source):
        truth = camera.truth(frame)
        assert read.truth_px is not None
        error_px = np.abs(np.nan_to_num(read.truth_px) - truth.disparity_px)
        # LLVM and scalar code round differently, and so may disagree on an outline.
        assert (error_px < 1e-3).mean() > 0.999


def test_a_stopped_run_goes_on_and_keeps_what_is_there(rendered: Path) -> None:
    first = {path: path.stat().st_mtime_ns for path in rendered.rglob("*0000*") if path.is_file()}
    lost = rendered / "frames_cleanpass" / TINY.name / "left" / "0000.png"
    assert len(first) > 8

    frames: list[int] = []
    longer = dataclasses.replace(TINY, frames=2)
    render_sequence(
        longer, rendered, passes=("clean",), variant="scalar_rgb", on_frame=lambda: frames.append(1)
    )
    assert len(frames) == 2
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert (rendered / "disparity" / TINY.name / "right" / "0001.pfm").exists()

    image = lost.read_bytes()
    lost.unlink()
    render_sequence(TINY, rendered, passes=("clean",), variant="scalar_rgb")
    assert lost.read_bytes() == image  # the same recipe, the same picture
    # Fewer frames were asked for than are there: those that are there keep their poses.
    source = open_source(f"sceneflow:{rendered}/frames_cleanpass/{TINY.name}")
    assert [each.frame.pose is not None for each in source] == [True, True]


def test_another_recipe_may_not_mix_with_a_sequence_that_is_there(rendered: Path) -> None:
    brighter = dataclasses.replace(TINY, samples=5)
    with pytest.raises(BadRecipe, match="is another recipe"):
        render_sequence(brighter, rendered, passes=("clean",), variant="scalar_rgb")


class TestCommand:
    def test_it_lists_every_sequence(self) -> None:
        listed = run("--list", COLUMNS="200").stdout
        assert all(recipe.name in listed for recipes in SETS.values() for recipe in recipes)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((), "give one of --set, --recipe and --room"),
            (("--set", "huge"), "no set 'huge'; there are benchmark, small, sample"),
            (("--room", "attic"), "no room 'attic'"),
            (("--room", "office"), "--out DIR is needed"),
            (("--room", "office", "--size", "big"), "--size takes WxH"),
            (("--room", "office", "--passes", "best", "--out", "x"), "no pass 'best'"),
            (("--recipe", "none.json"), "none.json"),
            (("--room", "office", "--out", "x", "--variant", "fast"), "no variant 'fast'"),
        ],
    )
    def test_a_wrong_argument_is_named(
        self, arguments: tuple[str, ...], message: str, tmp_path: Path
    ) -> None:
        if "x" in arguments:
            arguments = tuple(str(tmp_path) if each == "x" else each for each in arguments)
        app = typer.Typer()
        app.command()(main)
        said = CliRunner().invoke(app, arguments)
        assert said.exit_code == 1
        assert isinstance(said.exception, SystemExit)
        assert message in said.output

    def test_without_llvm_it_says_what_to_install(self, tmp_path: Path) -> None:
        arguments = ("--room", "studio", "--out", str(tmp_path), "--variant", "llvm_ad_rgb")
        said = run(*arguments, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
        assert said.returncode == 1
        assert "apt-get install libllvm19" in said.stderr
        assert "Traceback" not in said.stderr
