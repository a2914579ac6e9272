"""Laws of training: a stopped run goes on as if it had never stopped, and no other run's does."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path

import pytest
import torch

from tests.support.wall_clips import wall_clips
from vergence_models import config as configs
from vergence_models.config import Config, LiteNetworkConfig, TrainingConfig, load_config
from vergence_models.data.pool import ClipPool, write_shard
from vergence_models.networks.losses import doubt_loss, edge_weight
from vergence_models.train import main
from vergence_models.training.batches import batches
from vergence_models.training.camera_motion import perturbed, uvd_transforms
from vergence_models.training.runs import (
    CHECKPOINT_NAME,
    RunError,
    load_checkpoint,
    read_run,
    save_checkpoint,
)
from vergence_models.training.trainer import Trainer
from vergence_models.training.validation import validate

NETWORK = LiteNetworkConfig(context_eighth=16, context_low=16)
SMALL = Config(
    "lite",
    network=NETWORK,
    training=TrainingConfig(frames=2, warmup_steps=1),
)


@pytest.fixture
def pool(tmp_path: Path) -> Path:
    write_shard(tmp_path / "pool" / "shard_1_000000", wall_clips(3))
    return tmp_path / "pool"


def steps(trainer: Trainer, pool: Path, count: int) -> None:
    clips = ClipPool(pool)
    for _ in range(count):
        trainer.step(clips.sample(trainer.random, 1, frames=2))


def test_a_resumed_run_equals_one_that_was_never_stopped(pool: Path, tmp_path: Path) -> None:
    straight = Trainer(SMALL, torch.device("cpu"))
    steps(straight, pool, 3)

    stopped = Trainer(SMALL, torch.device("cpu"))
    steps(stopped, pool, 2)
    stopped.save(tmp_path)
    resumed = Trainer(SMALL, torch.device("cpu"))
    resumed.resume(tmp_path)
    steps(resumed, pool, 1)

    assert resumed.progress.steps == straight.progress.steps == 3
    assert resumed.progress.frames == straight.progress.frames
    for name, value in straight.network.state_dict().items():
        assert torch.equal(resumed.network.state_dict()[name], value), name
        assert torch.equal(resumed.average[name], straight.average[name]), name


def test_the_command_trains_saves_and_goes_on(
    pool: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "vergence_models.train")
    monkeypatch.setitem(configs.CONFIGS, "lite", SMALL)
    out = tmp_path / "run"
    command = ["--pool", str(pool), "--out", str(out), "--batch", "1", "--frames", "2"]
    main([*command, "--val", str(pool), "--minutes", "0.01", "--log-every", "1"])
    assert f"saved {out} at step " in caplog.text
    assert "--resume continues it" in caplog.text
    first = read_run(out)
    assert first.story["steps"] >= 1
    assert first.measured["warm_epe"] > 0
    main([*command, "--resume", "--minutes", "0.01", "--log-every", "1"])
    second = read_run(out)
    assert second.story["steps"] > first.story["steps"]
    assert len(second.story["commands"]) == 2
    with pytest.raises(SystemExit, match="add --resume"):
        main([*command, "--minutes", "0.01"])


def test_another_configuration_is_refused_by_file_and_expectation(tmp_path: Path) -> None:
    Trainer(SMALL, torch.device("cpu")).save(tmp_path)
    other = dataclasses.replace(SMALL, network=dataclasses.replace(NETWORK, hidden=16))
    with pytest.raises(RunError, match=rf"{CHECKPOINT_NAME}: expected hidden = 16, the run has 32"):
        Trainer(other, torch.device("cpu")).resume(tmp_path)
    contents = load_checkpoint(tmp_path)
    del contents["weights"]["update.out.bias"]
    save_checkpoint(tmp_path, contents)
    with pytest.raises(RunError, match=rf"{CHECKPOINT_NAME}: .*update.out.bias is missing"):
        Trainer(SMALL, torch.device("cpu")).resume(tmp_path)
    renamed = dataclasses.replace(SMALL, name="full")
    with pytest.raises(RunError, match="expected a run of configuration 'full', got 'lite'"):
        Trainer(renamed, torch.device("cpu")).resume(tmp_path)


def test_a_missing_or_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=f"no checkpoint at {tmp_path}"):
        load_checkpoint(tmp_path)
    (tmp_path / CHECKPOINT_NAME).write_bytes(b"not a checkpoint")
    with pytest.raises(RunError, match=f"{CHECKPOINT_NAME}: expected a checkpoint"):
        load_checkpoint(tmp_path)


def test_an_unknown_configuration_names_those_there_are() -> None:
    with pytest.raises(configs.ConfigError, match="'huge'; there are: lite"):
        load_config("huge")


def test_a_step_has_the_losses_that_were_recorded() -> None:
    """The draws of a schedule and the arithmetic of a step are part of what a seed reproduces."""
    training = TrainingConfig(frames=3, batch=2, warmup_steps=1, cutmix_share=0.4)
    trainer = Trainer(Config("lite", network=NETWORK, training=training), torch.device("cpu"))
    losses = [trainer.step(wall_clips(2))["loss"] for _ in range(4)]
    # Another CPU rounds differently; another draw would change the second digit.
    assert losses == pytest.approx([0.49101, 0.64195, 0.67347, 0.44615], rel=5e-3)


@pytest.mark.slow
def test_training_lowers_the_loss(pool: Path) -> None:
    trainer = Trainer(SMALL, torch.device("cpu"))
    clips = ClipPool(pool).clips([0])
    losses = [trainer.step(clips)["loss"] for _ in range(12)]
    assert sum(losses[-3:]) < sum(losses[:3])


def test_unknown_truth_costs_nothing() -> None:
    trainer = Trainer(SMALL, torch.device("cpu"))
    clips = wall_clips(1)
    left, right = clips.pair(0)
    network = trainer.network.eval()
    still, nothing = torch.eye(4)[None], network.cold_state(1, *left.shape[1:3])
    with torch.inference_mode():
        estimate, _ = network(left, right, still, nothing, 1)
    truth = clips.disparity_px[:, 0]
    half = truth.clone()
    half[:, :, 112:] = 0
    changed = dataclasses.replace(estimate, disparity=estimate.disparity.clone())
    changed.disparity[:, :, 112:] += 30
    assert estimate.loss(half, 192) == changed.loss(half, 192)
    assert estimate.loss(truth, 192) != estimate.loss(half, 192)


def test_the_best_sigma_is_the_scale_of_a_laplace_distribution() -> None:
    shares = torch.linspace(0.0005, 0.9995, 1000)
    errors = -1.7 * torch.log(1 - shares)  # absolute errors, mean 1.7
    errors[-1] = 700.0  # how wild the outlier is does not matter
    candidates = torch.linspace(0.5, 4, 351)
    costs = torch.stack([doubt_loss(errors, sigma).mean() for sigma in candidates])
    assert candidates[costs.argmin()].item() == pytest.approx(1.7, abs=0.02)


def test_errors_beside_a_depth_edge_weigh_twice() -> None:
    truth = torch.full((1, 16, 32), 10.0)
    truth[:, :, 16:] = 14.0
    weight = edge_weight(truth)
    assert (weight[:, :, 12:20] == 2).all()
    assert (weight[:, :, :12] == 1).all()
    assert (weight[:, :, 20:] == 1).all()
    assert (edge_weight(truth.clamp(max=12.9)) == 1).all()


def test_a_run_of_fewer_parts_is_taken_over_with_its_story(tmp_path: Path) -> None:
    old = Trainer(SMALL, torch.device("cpu"))
    old.progress.steps = 7
    old.save(tmp_path)
    contents = load_checkpoint(tmp_path)
    del contents["average"]["update.out.bias"]
    contents["average"]["update.out.weight"] += 1
    save_checkpoint(tmp_path, contents)
    new = Trainer(SMALL, torch.device("cpu"))
    assert new.start_from(tmp_path) == ["update.out.bias"]
    assert new.progress.steps == 7
    taken = contents["average"]["update.out.weight"]
    assert torch.equal(new.network.state_dict()["update.out.weight"], taken)
    assert torch.equal(new.average["update.out.weight"], taken)
    contents["average"]["odd"] = torch.zeros(1)
    save_checkpoint(tmp_path, contents)
    with pytest.raises(RunError, match="odd"):
        new.start_from(tmp_path)


def test_transforms_carry_the_wall_along() -> None:
    clips = wall_clips(2)
    matrix = uvd_transforms(clips, clips.world_from_left)
    assert torch.equal(matrix[:, 0], torch.eye(4).expand(2, 4, 4))
    moved = matrix[:, 1] @ torch.tensor([100.0, 20.0, 12.0, 1.0])
    # A step aside of half a baseline moves what is at 12 px by 6 px, and leaves its disparity.
    expected = torch.tensor([94.0, 20.0, 12.0]).expand(2, 3)
    assert torch.allclose(moved[:, :3] / moved[:, 3:], expected, atol=1e-3)


def test_noise_of_poses_stays_small_and_rigid() -> None:
    import numpy as np

    poses = wall_clips(2).world_from_left
    noisy = perturbed(poses, max_deg=0.3, max_m=0.002, random=np.random.default_rng(0))
    rotation = noisy[..., :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64), atol=1e-9)
    assert 0 < (noisy - poses).abs().max() < 0.02


@pytest.mark.slow
def test_batches_depend_on_the_step_alone_whoever_makes_them(pool: Path) -> None:
    def first_two(first_step: int, workers: int) -> list[torch.Tensor]:
        with closing(
            batches([pool], SMALL.training, first_step=first_step, workers=workers)
        ) as made:
            return [next(made).left for _ in range(2)]

    here = first_two(0, 0)
    assert torch.equal(first_two(1, 0)[0], here[1])
    assert not torch.equal(here[0], here[1])
    for made, expected in zip(first_two(0, 1), here, strict=True):
        assert torch.equal(made, expected)


def test_validation_measures_cold_and_warm(pool: Path) -> None:
    found = validate(
        Trainer(SMALL, torch.device("cpu")).network.eval(), ClipPool(pool), torch.device("cpu")
    )
    assert {"cold_epe", "warm_epe", "cold_d1", "warm_d3", "warm_cover"} <= set(found)
