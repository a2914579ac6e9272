"""Laws of large checkpoints: shards below 16 MiB, and a run that continues from them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from tests.support.wall_clips import wall_clips
from vergence_models.config import Config, Precision, RaftNetworkConfig, TrainingConfig
from vergence_models.data.clips import StereoClips
from vergence_models.training import runs
from vergence_models.training.checkpoint_shards import SHARD_BYTES, joined, split
from vergence_models.training.runs import CHECKPOINT_NAME, RunError, load_checkpoint, read_run
from vergence_models.training.trainer import Trainer

# No fewer channels: backward of a strided 1x1 convolution of 8 corrupts memory in torch 2.13.
NETWORK = RaftNetworkConfig(
    encoder_half=16,
    encoder_quarter=16,
    encoder_eighth=32,
    features=32,
    hidden=32,
    motion=8,
    head=64,
)
TINY = Config("full", NETWORK, TrainingConfig(frames=2, warmup_steps=1))
CPU = torch.device("cpu")


@pytest.fixture
def clips() -> StereoClips:
    return wall_clips(1, frames=2)


@pytest.fixture
def in_pieces(monkeypatch: pytest.MonkeyPatch) -> int:
    """Pieces as small as the network, so that it makes several."""
    limit = 2**18
    monkeypatch.setattr(runs, "SHARD_BYTES", limit)
    monkeypatch.setattr("vergence_models.training.checkpoint_shards.SHARD_BYTES", limit)
    return limit


def trained(clips: StereoClips, steps: int) -> Trainer:
    trainer = Trainer(TINY, CPU)
    for _ in range(steps):
        trainer.step(clips)
    return trainer


@pytest.mark.slow
def test_a_run_goes_on_from_pieces_elsewhere(
    in_pieces: int, clips: StereoClips, tmp_path: Path
) -> None:
    stopped = trained(clips, 2)
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    stopped.save(here)
    for path in here.iterdir():
        (there / path.name).write_bytes(path.read_bytes())
    names = [path.name for path in there.iterdir()]
    assert sum(name.startswith("weights-") for name in names) > 1
    assert sum(name.startswith("optimizer-") for name in names) > 1
    for path in there.glob("*-*.pt"):
        assert path.stat().st_size < 1.1 * in_pieces

    resumed = Trainer(TINY, CPU)
    resumed.resume(there)
    assert resumed.progress == stopped.progress
    # Half precision keeps three digits of the weights and two of the moments.
    for name, value in stopped.network.state_dict().items():
        got = resumed.network.state_dict()[name]
        assert torch.allclose(got.float(), value.float(), rtol=1e-3, atol=1e-6), name
    next_losses = [trainer.step(clips)["loss"] for trainer in (stopped, resumed)]
    assert next_losses[1] == pytest.approx(next_losses[0], rel=0.02)


def test_saving_again_leaves_no_piece_of_the_last_time(
    in_pieces: int, clips: StereoClips, tmp_path: Path
) -> None:
    trainer = trained(clips, 1)
    trainer.save(tmp_path)
    first = {path.name for path in tmp_path.glob("*-*.pt")}
    trainer.step(clips)
    trainer.save(tmp_path)
    second = {path.name for path in tmp_path.glob("*-*.pt")}
    assert len(first) == len(second)
    assert not first & second
    assert load_checkpoint(tmp_path)["progress"]["steps"] == 2


def test_export_needs_the_average_alone(in_pieces: int, clips: StereoClips, tmp_path: Path) -> None:
    trained(clips, 1).save(tmp_path)
    for path in [*tmp_path.glob("weights-*"), *tmp_path.glob("optimizer-*")]:
        path.unlink()
    run = read_run(tmp_path)
    assert run.network == NETWORK
    assert run.weights.keys() == Trainer(TINY, CPU).network.state_dict().keys()
    with pytest.raises(RunError, match=r"no .*weights-00000001-0.pt; .*expects it beside itself"):
        load_checkpoint(tmp_path)


def test_another_configuration_is_refused_by_file_and_expectation(
    in_pieces: int, clips: StereoClips, tmp_path: Path
) -> None:
    trained(clips, 1).save(tmp_path)
    wider = dataclasses.replace(TINY, network=dataclasses.replace(NETWORK, hidden=48))
    with pytest.raises(RunError, match=rf"{CHECKPOINT_NAME}: expected hidden = 48, the run has 32"):
        Trainer(wider, CPU).resume(tmp_path)
    fast = dataclasses.replace(TINY, name="fast")
    with pytest.raises(RunError, match="expected a run of configuration 'fast', got 'full'"):
        Trainer(fast, CPU).resume(tmp_path)


def test_small_runs_stay_one_exact_file(clips: StereoClips, tmp_path: Path) -> None:
    trained(clips, 1).save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT_NAME]


def test_no_piece_is_larger_than_its_limit() -> None:
    tensors = {f"layer{number}": torch.randn(2**20) for number in range(20)}
    index, pieces = split({"weights": tensors, "scale": 2.0}, torch.float16)
    assert index["scale"] == 2.0
    assert all(sum(t.nbytes for t in piece.values()) <= SHARD_BYTES for piece in pieces)
    back = joined(index, {name: value for piece in pieces for name, value in piece.items()})
    for name, value in tensors.items():
        assert torch.equal(back["weights"][name], value.half().float())


def test_bfloat16_trains_nearly_as_float32_does(clips: StereoClips) -> None:
    losses = {}
    for precision in Precision:
        training = dataclasses.replace(TINY.training, precision=precision)
        trainer = Trainer(dataclasses.replace(TINY, training=training), CPU)
        losses[precision] = [trainer.step(clips)["loss"] for _ in range(2)]
        assert all(value.dtype == torch.float32 for value in trainer.network.parameters())
    assert losses[Precision.BF16] == pytest.approx(losses[Precision.FP32], rel=0.05)
