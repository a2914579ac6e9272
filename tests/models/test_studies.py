"""Laws of the studies: what their rows mean, that none is missing, that they can be repeated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from rich.progress import Progress

from tests.support.wall_clips import wall_clips
from vergence_models.data.generator import ClipGenerator, GeneratorConfig
from vergence_models.data.shots import Playback
from vergence_models.evaluate import WEIGHTS
from vergence_models.evaluation.methods import (
    single_frame_method,
    warm_method,
    with_pose_noise,
    without_poses,
)
from vergence_models.evaluation.stepping import Footage, SteppedNetwork, footage_from_clip
from vergence_models.onnx_export.calibrate import PARITY_PX
from vergence_models.studies.__main__ import main, missing_tiers
from vergence_models.studies.bench import Bench
from vergence_models.studies.experiments import (
    STUDIES,
    cold_start,
    every_method,
    main_table,
    movement_speed,
    pose_noise,
    warp_ablation,
)
from vergence_models.studies.footage import SPEEDS, StudySettings
from vergence_models.studies.learning import learning_curves
from vergence_models.studies.networks import (
    StudiedNetwork,
    gather_networks,
)
from vergence_models.studies.tables import Table, TableRow, markdown, read_tables, write_tables
from vergence_models.training.runs import RunError, read_history, read_run

pytestmark = pytest.mark.slow  # it steps every method over clips

RUN = Path(__file__).parents[2] / "models" / "runs" / "lite"
TINY = StudySettings(clips=1, frames=4, short=4, width=192, height=64)


@pytest.fixture(scope="module")
def wall() -> Footage:
    return footage_from_clip(wall_clips(1, frames=4), 0, "wall")


@pytest.fixture(scope="module")
def networks() -> list[StudiedNetwork]:
    return gather_networks([WEIGHTS], [], threads=1)


@pytest.fixture(scope="module")
def with_run() -> list[StudiedNetwork]:
    """The graphs, and the run that they were exported from."""
    return gather_networks([WEIGHTS], [RUN], threads=1)


@pytest.fixture(scope="module")
def network(networks: list[StudiedNetwork]) -> SteppedNetwork:
    return networks[0].network


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("clips")


def new_bench(networks: list[StudiedNetwork], cache: Path) -> Bench:
    progress = Progress(console=Console(quiet=True))
    return Bench(networks, settings=TINY, cache=cache, workers=1, progress=progress)


@pytest.fixture(scope="module")
def bench(networks: list[StudiedNetwork], cache: Path) -> Bench:
    return new_bench(networks, cache)


@pytest.fixture(scope="module")
def tables(bench: Bench) -> dict[str, Table]:
    made = (main_table, warp_ablation, movement_speed, pose_noise, cold_start)
    return {table.name: table for table in (study(bench) for study in made)}


def test_a_faster_playback_is_the_same_path_to_the_same_last_view() -> None:
    def clips(speed: float) -> tuple[torch.Tensor, torch.Tensor]:
        config = GeneratorConfig(
            width=96, height=64, frames=5, texture_size=64, playback=Playback(speed)
        )
        found = ClipGenerator(config).clips(seed=3, indices=[0, 1])
        return found.left, found.world_from_left

    (slow, slow_poses), (fast, fast_poses) = clips(1), clips(2)
    assert torch.equal(slow[:, -1], fast[:, -1])
    assert not torch.equal(slow[:, -2], fast[:, -2])
    torch.testing.assert_close(fast_poses[:, 2:], slow_poses[:, ::2])


def test_what_has_no_past_is_the_same_at_every_speed(tables: dict[str, Table]) -> None:
    cold = [row for row in tables["warp"].rows if "no state" in row.label]
    assert cold
    assert all(row.values["loss"] == 0 for row in cold)


def test_noise_is_of_just_the_size_that_was_asked_for(wall: Footage) -> None:
    noisy = with_pose_noise(wall, deg=0.6, m=0.002)
    true, shifted = ([view.world_from_left for view in footage.views] for footage in (wall, noisy))
    for k in range(1, len(true)):
        a, b, c, d = true[k - 1], true[k], shifted[k - 1], shifted[k]
        assert a is not None and b is not None and c is not None and d is not None  # noqa: PT018
        error = (d.inverse() @ c) @ (b.inverse() @ a).inverse()
        angle = np.degrees(np.arccos((np.trace(error.rotation) - 1) / 2))
        assert angle == pytest.approx(0.6, abs=1e-5)
        assert np.linalg.norm(error.translation_m) == pytest.approx(0.002, abs=1e-9)


def test_noise_of_level_zero_is_the_true_motion(tables: dict[str, Table]) -> None:
    true = {row.label: row.values["1x"] for row in tables["speed"].rows}
    for row in tables["noise"].rows:
        assert row.values["0"] == true[row.label]
        assert row.values["10"] != row.values["0"]


def test_a_single_frame_row_sees_each_frame_for_the_first_time(
    network: SteppedNetwork, wall: Footage
) -> None:
    together = list(single_frame_method(network, "lite", 2).predict(wall))
    for view, expected in zip(wall.views, together, strict=True):
        alone = replace(wall, views=[view])
        (found,) = warm_method(network, "lite", 1, cold=2).predict(alone)
        np.testing.assert_array_equal(found.disparity_px, expected.disparity_px)


def test_a_state_that_is_not_moved_is_that_of_a_camera_that_stands_still(
    network: SteppedNetwork, wall: Footage
) -> None:
    warm = warm_method(network, "lite", 1, cold=1)
    still = replace(
        wall,
        views=[replace(v, world_from_left=wall.views[0].world_from_left) for v in wall.views],
    )
    not_moved = list(warm.with_input("state not moved", without_poses).predict(wall))
    moved = list(warm.predict(wall))
    for found, expected in zip(not_moved, warm.predict(still), strict=True):
        np.testing.assert_array_equal(found.disparity_px, expected.disparity_px)
    assert np.any(not_moved[-1].disparity_px != moved[-1].disparity_px)


def test_every_method_has_its_figures_in_every_study(
    tables: dict[str, Table], bench: Bench
) -> None:
    assert tables["main"].labels == [method.label for method in every_method(bench)]
    for row in tables["main"].rows:
        assert {"epe", "d1", "d3", "d5", "tepe"} <= set(row.values)
    for name, expected in {
        "warp": {"1x", "6x", "loss"},
        "speed": {f"{speed}x" for speed in SPEEDS},
        "noise": {str(level) for level in range(11)},
        "cold": {"1", "2", "3", "settled"},
    }.items():
        assert tables[name].rows
        for row in tables[name].rows:
            assert set(row.values) == expected
        assert tables[name].training


def test_studies_agree_with_one_another(tables: dict[str, Table]) -> None:
    main_epe = {row.label: row.values["epe"] for row in tables["main"].rows}
    for curve in tables["cold"].curves:
        if curve.label in main_epe:
            assert np.mean(curve.epe) == pytest.approx(main_epe[curve.label], abs=1e-4)


def test_the_same_seed_gives_the_same_tables(
    tables: dict[str, Table], networks: list[StudiedNetwork], tmp_path: Path
) -> None:
    again = new_bench(networks, tmp_path)  # renders its clips again
    assert warp_ablation(again) == tables["warp"]


def test_a_run_adds_only_the_counts_that_no_graph_has(
    with_run: list[StudiedNetwork], network: SteppedNetwork, wall: Footage
) -> None:
    graphs, run = with_run
    assert not set(graphs.warm) & set(run.warm)
    assert not set(graphs.single_frame) & set(run.single_frame)
    assert run.training.runtime == "PyTorch"
    assert run.training.frames == graphs.training.frames
    by_torch = list(run.network.sequence(wall, cold=2, warm=1))
    for found, expected in zip(by_torch, network.sequence(wall, cold=2, warm=1), strict=True):
        # 99 of 100 pixels agree, as export promises: between equals, rounding may choose.
        difference = np.abs(found.disparity_px - expected.disparity_px)
        assert np.quantile(difference, 0.99) < PARITY_PX


def test_a_tier_without_weights_is_named(tables: dict[str, Table]) -> None:
    only_lite = list(tables.values())
    assert missing_tiers(only_lite) == ["full", "fast"]
    assert "`full`, `fast`" in markdown([], missing_tiers(only_lite), [])


def test_a_column_has_the_same_decimals_in_every_row() -> None:
    rows = [TableRow("slow", {"ms": 1820.0, "epe": 0.5}), TableRow("quick", {"ms": 7.91})]
    table = Table("t", "T", "", {"ms": "ms", "epe": "EPE"}, rows, training=[])
    text = markdown([table], [], [])
    assert "| slow | 1820.0 | 0.50 |" in text
    assert "| quick | 7.9 |  |" in text


def test_markdown_is_written_again_without_running_a_study(
    tables: dict[str, Table], tmp_path: Path
) -> None:
    path = tmp_path / "studies.json"
    write_tables(path, [tables["speed"]])
    main(["--json", str(path), "--render"])
    assert tables["speed"].title in path.with_suffix(".md").read_text()
    assert read_tables(path) == {"speed": tables["speed"]}


def test_tables_survive_their_file(tables: dict[str, Table], tmp_path: Path) -> None:
    write_tables(tmp_path / "studies.json", tables.values())
    assert read_tables(tmp_path / "studies.json") == tables


def test_the_command_writes_what_it_ran_and_keeps_the_rest(
    tables: dict[str, Table], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out" / "studies.json"
    path.parent.mkdir()
    write_tables(path, [tables["main"], tables["speed"]])
    options = ["--studies", "times", "--quick", "--threads", "1", "--cache", str(tmp_path)]
    main(["--json", str(path), *options])
    kept = read_tables(path)
    assert set(kept) == {"main", "speed", "times"}
    assert kept["times"].labels == kept["main"].labels
    printed = capsys.readouterr().out
    assert printed == path.with_suffix(".md").read_text()
    assert "theirs, on their data" in printed
    assert "frames seen in" in printed
    for name in ("runtime", "speed", "studies"):
        assert (path.parent / f"{name}.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param(["--weights", "nowhere"], "no manifest at nowhere", id="no weights"),
        pytest.param(["--run", "nowhere"], "no checkpoint at nowhere", id="no run"),
    ],
)
def test_what_is_missing_is_said(arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=message):
        main(["--json", str(tmp_path / "out.json"), *arguments])


def test_a_file_that_holds_no_studies_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text('{"mine": 1}')
    with pytest.raises(SystemExit, match="expected the JSON of studies"):
        main(["--json", str(path), "--studies", "times"])
    assert path.read_text() == '{"mine": 1}'


def test_every_study_has_a_name_of_its_own() -> None:
    assert len({study.__doc__ for study in STUDIES.values()}) == len(STUDIES)


def test_learning_curves_are_those_of_the_log(with_run: list[StudiedNetwork], cache: Path) -> None:
    table = learning_curves(new_bench(with_run, cache))
    assert table.rows[-1].values["warm_epe"] == read_run(RUN).measured["warm_epe"]
    for curve in table.curves:
        assert curve.x == sorted(curve.x)
        assert len(curve.x) == len(curve.epe) > 1


def test_a_log_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").write_text('{"step": 1, "validation": {}}\nnot JSON\n')
    with pytest.raises(RunError, match=r"log\.jsonl: expected a line of JSON"):
        read_history(tmp_path)
