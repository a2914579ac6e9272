"""Laws of clips that do not show their disparity: the images hide it, and the truth says so."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from tests.support.wall_clips import wall_clips
from vergence_models.data.clips import StereoClips
from vergence_models.networks.losses import output_loss, sigma_loss
from vergence_models.training.no_evidence import (
    FARTHEST_PX,
    blinded,
    repeating,
    unmatched,
    without_evidence,
)

Kind = Callable[[StereoClips, StereoClips, np.random.Generator], StereoClips]
SEEDS = range(24)


def drawn(kind: Kind, seed: int) -> tuple[StereoClips, StereoClips]:
    """A clip of four frames, and the same without evidence."""
    clips = wall_clips(2, frames=4)
    return clips[:1], kind(clips[:1], clips[1:], np.random.default_rng(seed))


@pytest.mark.parametrize("kind", [blinded, unmatched, repeating])
def test_the_truth_is_negative_where_it_is_hidden_and_nowhere_else(kind: Kind) -> None:
    for seed in SEEDS:
        before, after = drawn(kind, seed)
        hidden = after.disparity_px < 0
        assert (after.disparity_px[hidden] >= -FARTHEST_PX).all()
        same = (after.left == before.left).all(-1) & (after.right == before.right).all(-1)
        # A pixel's match may lie in a hidden window of the right eye; its truth stays true.
        assert not (hidden.any() and same[0].flatten(1).all())
        untouched = same.flatten(2).all(-1)
        assert (after.disparity_px[untouched] == before.disparity_px[untouched]).all()


@pytest.mark.parametrize("kind", [blinded, unmatched, repeating])
def test_evidence_ends_with_the_first_frame_or_later(kind: Kind) -> None:
    firsts = set()
    for seed in SEEDS:
        before, after = drawn(kind, seed)
        changed = (after.right != before.right) | (after.left != before.left)
        frames = changed.flatten(2).any(-1)[0]
        firsts.add(int(frames.int().argmax()) if frames.any() else -1)
    assert firsts >= {0, 1, 2}


def test_a_blinded_eye_shows_nothing_of_the_scene_and_it_is_either_or_both() -> None:
    eyes = set()
    for seed in SEEDS:
        before, after = drawn(blinded, seed)
        scene, other = (wall_clips(2, frames=4)[k : k + 1] for k in range(2))
        brighter = torch.clamp(scene.left.int() + 40, max=255).to(torch.uint8)
        scene.left.copy_(brighter)
        scene.right.copy_(brighter)
        again = blinded(scene, other, np.random.default_rng(seed))
        covered = tuple(
            bool((getattr(after, eye) != getattr(before, eye)).any()) for eye in ("left", "right")
        )
        eyes.add(covered)
        for eye in ("left", "right"):
            unlike = (getattr(after, eye) != getattr(before, eye)).all(-1)
            shown = getattr(after, eye)[unlike], getattr(again, eye)[unlike]
            assert torch.equal(*shown)
    assert eyes >= {(True, False), (False, True), (True, True)}


def test_a_pattern_that_fills_the_image_holds_still_and_could_be_at_any_distance() -> None:
    whole = 0
    for seed in SEEDS:
        _, after = drawn(repeating, seed)
        hidden = (after.disparity_px < 0).flatten(2).all(-1)[0]
        whole += bool(hidden.any())
        if hidden.sum() > 1:
            poses = after.world_from_left[0, hidden]
            assert torch.equal(poses, poses[:1].expand_as(poses))
            shown = after.disparity_px[0, hidden]
            assert torch.equal(shown, torch.full_like(shown, float(shown.max())))
    assert whole > len(SEEDS) / 3


def test_without_shares_every_clip_stays_as_it_is_and_with_them_a_seed_decides() -> None:
    clips = wall_clips(2, frames=4)

    def made(share: float, seed: int) -> StereoClips:
        random = np.random.default_rng(seed)
        return without_evidence(
            clips, random, blinded_share=share, unmatched_share=share, repeating_share=share
        )

    assert torch.equal(made(0.0, 1).left, clips.left)
    assert torch.equal(made(0.3, 1).disparity_px, made(0.3, 1).disparity_px)
    assert not torch.equal(made(0.3, 1).disparity_px, made(0.3, 2).disparity_px)


def gradients(truth: float) -> tuple[float, float]:
    """Of the loss by disparity and by sigma, for an estimate of 20 +- 1 px within a range of 64."""
    disparity = torch.full((1, 8, 8), 20.0, requires_grad=True)
    sigma = torch.ones(1, 8, 8, requires_grad=True)
    loss = output_loss(disparity, sigma, torch.full((1, 8, 8), truth), 64)
    loss.backward()  # type: ignore[no-untyped-call]  # torch annotates it so
    assert disparity.grad is not None
    assert sigma.grad is not None
    return float(disparity.grad.sum()), float(sigma.grad.sum())


def test_a_possible_disparity_teaches_sigma_alone() -> None:
    assert gradients(-50)[0] == 0
    assert gradients(-50)[1] < 0  # the loss falls as sigma grows
    assert gradients(50)[0] < 0
    assert gradients(0) == (0, 0)


def test_beyond_the_range_even_a_near_miss_is_a_large_error() -> None:
    disparity, sigma = torch.full((1, 8, 8), 63.0), torch.full((1, 8, 8), 8.0)
    within, beyond = (
        sigma_loss(disparity, sigma, torch.full((1, 8, 8), truth), 64) for truth in (63.5, 64.5)
    )
    assert beyond > within
    assert gradients(64.5)[0] == 0
    assert gradients(64.5)[1] < 0
