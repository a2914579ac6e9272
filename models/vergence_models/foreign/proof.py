"""Prove a contract on shifted textures: sign, sides, scale, pixels and range."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vergence_models.foreign.contract import Contract, ContractError
from vergence_models.foreign.textures import Plane, Scene, scene, texture
from vergence_models.foreign.trial import Network, Trial
from vergence_proto.model_io import DISPARITY

# Wall and board of each scene, in px of disparity at the graph's width.
_SCENES = ((4, 16), (8, 40))
_TOLERANCE_PX = 1.0
_TOLERANCE = 0.06  # of the disparity
_LEAST_SHARE = 0.6  # of pixels that must be right
_COMMON_FIRST = ("imagenet", "0..255", "0..1", "-1..1")
_AS_GOOD = 0.02  # difference of scores
_MUCH_BETTER = 0.1
_RANGES = (16, 24, 32, 48, 64, 96, 128, 160, 192, 256, 320, 384)
WARM_LOSS = 0.05  # share of pixels that a warm step of the same pair may lose
_NEAR_THE_END = 0.9  # of a range: the shift that is tried


@dataclass(frozen=True, slots=True)
class Seen:
    """What a graph returned for the scenes."""

    expected_px: tuple[float, ...]  # disparity of each wall and board
    found: tuple[float, ...]  # median of the output there, in its own unit
    of_the_right: bool  # the map belongs to the right view
    share: float  # pixels whose value, times ``factor``, is right
    dim_share: float  # the same in poor light, where a wrong range of the pixels shows
    factor: float | None  # what makes the output a disparity; None: nothing does
    of_depth: bool = False  # the output is a depth, and the factor is divided by it

    @property
    def matched(self) -> bool:
        return self.factor is not None and not self.of_the_right and self.share >= _LEAST_SHARE

    @property
    def score(self) -> float:
        return (self.share + self.dim_share) / 2

    @property
    def words(self) -> str:
        pairs = zip(self.expected_px, self.found, strict=True)
        return ", ".join(f"{value:.4g} for {px:g} px" for px, value in pairs)


@dataclass(frozen=True, slots=True)
class Proof:
    """The contract under which a graph finds the textures, if there is one, and what was seen."""

    contract: Contract | None
    seen: Seen  # under the contract that was tried first, or the one that was found
    as_good: tuple[str, ...]  # other ranges of the pixels that the textures cannot rule out
    blind_to: str = ""  # an image that changes nothing


def texture_size(contract: Contract, range_px: int = 64) -> tuple[int, int]:
    """The size [H, W] of a scene: the graph's own, or one that is large enough."""
    if contract.size is not None:
        return contract.size
    whole = max(contract.multiple_of, 1)
    height, width = 192, max(384, 2 * range_px + 64)
    return -(-height // whole) * whole, -(-width // whole) * whole


def scenes_for(contract: Contract) -> list[Scene]:
    height, width = texture_size(contract)
    # A board at the largest disparity must not leave a narrow image.
    most = width // 5
    return [
        scene(height, width, min(wall, most // 4), min(board, most), seed=7 + wall)
        for wall, board in _SCENES
    ]


def observe(contract: Contract, network: Network) -> Seen:
    """Run the scenes. Raises ContractError if the graph fails on a pair."""
    plain = replace(contract, factor=1.0, of_depth=False, of_width=False, sigma="constant")
    trial = Trial(plain, network)
    scenes = scenes_for(contract)
    values = [trial.disparity_px(each.left, each.right) for each in scenes]
    expected: list[float] = []
    found: list[float] = []
    right_views = 0
    for each, value in zip(scenes, values, strict=True):
        wall, board = (each.truth_px == px for px in (each.wall_px, each.board_px))
        expected += [each.wall_px, each.board_px]
        medians = [float(np.median(value[where])) for where in (wall, board)]
        found += medians
        telling = float(np.median(value[each.telling]))
        right_views += abs(telling - medians[0]) < abs(telling - medians[1])
    factor, of_depth = _factor_of(expected, found), False
    if factor is None and np.all(found):
        factor, of_depth = _factor_of(expected, [1 / each for each in found]), True
    of_the_right = right_views > len(scenes) / 2
    if factor is None:
        return Seen(tuple(expected), tuple(found), of_the_right, 0.0, 0.0, None)

    def share_of(value: Plane, each: Scene) -> float:
        with np.errstate(divide="ignore"):
            return _share(factor / value if of_depth else factor * value, each)

    share = float(np.mean([share_of(*each) for each in zip(values, scenes, strict=True)]))
    dim = scenes[-1].dimmed()
    dim_share = share_of(trial.disparity_px(dim.left, dim.right), dim)
    return Seen(tuple(expected), tuple(found), of_the_right, share, dim_share, factor, of_depth)


def _share(found_px: Plane, pair: Scene) -> float:
    """The share of right pixels, of those that both cameras see."""
    known = np.isfinite(pair.truth_px)
    return float(_right(found_px[known], pair.truth_px[known]).mean())


def _right(found_px: Plane, truth_px: Plane) -> NDArray[np.bool_]:
    within: Plane = np.maximum(_TOLERANCE_PX, _TOLERANCE * truth_px)
    right: NDArray[np.bool_] = np.abs(found_px - truth_px) <= within
    return right


def _factor_of(expected_px: list[float], found: list[float]) -> float | None:
    """Return the factor that makes ``found`` the disparity, or None if there is no such factor."""
    wanted, got = np.array(expected_px), np.array(found)
    if not np.isfinite(got).all() or not np.dot(got, got):
        return None
    factor = float(np.dot(wanted, got) / np.dot(got, got))
    return _simple(factor) if _near(got * factor, wanted) else None


def _near(found_px: ArrayLike, wanted_px: ArrayLike) -> bool:
    found, wanted = np.asarray(found_px), np.asarray(wanted_px)
    within = np.maximum(_TOLERANCE_PX, _TOLERANCE * wanted)
    return bool(np.all(np.abs(found - wanted) <= within))


def _simple(factor: float) -> float:
    # Whole factors and their reciprocals are what networks use.
    for simple in (abs(factor), 1 / abs(factor)):
        whole = round(simple)
        if whole and abs(simple / whole - 1) < 0.04:
            near = whole if simple == abs(factor) else 1 / whole
            return float(np.copysign(near, factor))
    return factor


def prove(contract: Contract, network: Network, *, search_pixels: bool = False) -> Proof:
    """Find the contract, nearest to this one, under which the graph sees the textures.

    The pixels are those of the contract, unless others give many more right values. With
    ``search_pixels`` they are unknown: the most common of the best are taken.

    Raises ContractError if the graph fails.
    """
    own = observe(contract, network)
    for swapped in (contract.swapped, not contract.swapped):
        seen = {
            pixels: own
            if (pixels, swapped) == (contract.pixels, contract.swapped)
            else observe(replace(contract, pixels=pixels, swapped=swapped), network)
            for pixels in _COMMON_FIRST
        }
        matched = {pixels: each for pixels, each in seen.items() if each.matched}
        if not matched:
            continue
        best = max(each.score for each in matched.values())
        as_good = [pixels for pixels in matched if matched[pixels].score > best - _AS_GOOD]
        chosen = as_good[0]
        given = matched.get(contract.pixels)
        if not search_pixels and given is not None and given.score > best - _MUCH_BETTER:
            chosen = contract.pixels
        factor = matched[chosen].factor
        assert factor is not None
        found = replace(
            contract,
            pixels=chosen,
            swapped=swapped,
            factor=factor,
            of_depth=matched[chosen].of_depth,
            of_width=False,
        )
        found = _at_another_width(found, network)
        return Proof(found, matched[chosen], tuple(each for each in as_good if each != chosen))
    return Proof(None, own, (), _blind_to(contract, network))


def _at_another_width(contract: Contract, network: Network) -> Contract:
    """Return the contract, with ``of_width`` if the factor grows with the width of the image.

    Raises ContractError if the output there is no disparity.
    """
    if contract.size is not None:
        return contract
    height, width = texture_size(contract)
    whole = max(contract.multiple_of, 1)
    wider = -(-3 * width // 2 // whole) * whole
    pair = scene(height, wider, 8, 32, seed=13)
    found = Trial(replace(contract, sigma="constant"), network).disparity_px(pair.left, pair.right)
    medians = [float(np.median(found[pair.truth_px == px])) for px in (8, 32)]
    if _near(medians, [8, 32]):
        return contract
    growth = wider / width
    if _near([growth * each for each in medians], [8, 32]):
        return replace(contract, factor=_simple(contract.factor / width), of_width=True)
    raise ContractError(
        f"scale: right in images {width} px wide, but in those {wider} px wide the disparity is "
        f"{medians[0]:.4g} for 8 px and {medians[1]:.4g} for 32 px"
    )


def _blind_to(contract: Contract, network: Network) -> str:
    """Return the image that the output does not depend on; empty if it depends on both."""
    trial = Trial(replace(contract, sigma="constant"), network)
    pair = scenes_for(contract)[0]
    height, width = texture_size(contract)
    other = texture(height, width, 99)
    seen = trial.disparity_px(pair.left, pair.right)
    for side, images in (("right", (pair.left, other)), ("left", (other, pair.right))):
        if np.array_equal(seen, trial.disparity_px(*images)):
            return side
    return ""


def warm_shares(
    contract: Contract, network: Network, *, start: Network | None = None
) -> tuple[float, float]:
    """Return the share of right pixels of a cold step, and of a warm one of the same pair.

    ``start`` takes the cold step; by default the same network.
    """
    contract = replace(contract, sigma="constant")
    warm = Trial(contract, network)
    cold = warm if start is None else Trial(contract, start)
    shares = []
    for each in scenes_for(contract):
        first = cold.step(each.left, each.right)
        second = warm.step(each.left, each.right, first)
        shares.append([_share(step[DISPARITY][0], each) for step in (first, second)])
    before, after = np.mean(shares, axis=0)
    return float(before), float(after)


def proven_flow(contract: Contract, network: Network) -> Contract:
    """Choose the sign of the initial flow with which a warm step is right most often.

    Raises ContractError if it is worse than a cold step with either.
    """
    warm = contract.warm_start
    assert warm is not None
    best: tuple[float, Contract] | None = None
    cold = 0.0
    for factor in (warm.factor, -warm.factor):
        each = replace(contract, warm_start=replace(warm, factor=factor))
        cold, share = warm_shares(each, network)
        if best is None or share > best[0] + 0.02:
            best = share, each
    assert best is not None
    if best[0] < cold - WARM_LOSS:
        raise ContractError(
            f"warm start: {100 * best[0]:.0f} % of the pixels are right from the last disparity in "
            f"{warm.input}, and {100 * cold:.0f} % from nothing; use --no-warm-start"
        )
    return best[1]


def found_range_px(contract: Contract, network: Network, at_most: int) -> int:
    """Return the largest disparity that the graph finds, of those that are tried; 0 for none."""
    _, width = texture_size(contract, at_most)
    trial = Trial(replace(contract, sigma="constant"), network)
    for range_px in sorted({at_most, *_RANGES}, reverse=True):
        shift = round(_NEAR_THE_END * range_px)
        if range_px > at_most or (contract.size is not None and shift > 0.6 * width):
            continue
        height, width = texture_size(contract, range_px)
        wall = scene(height, width, shift, shift, seed=3)
        found = trial.disparity_px(wall.left, wall.right)
        inner = found[:, shift + 10 : -10]
        if abs(float(np.median(inner)) - shift) <= max(_TOLERANCE_PX, _TOLERANCE * shift):
            return range_px
    return 0


def differences(given: Contract, proof: Proof) -> list[str]:
    """Return what is wrong with a contract, a sentence each; empty if it is proven."""
    found = proof.contract
    if proof.blind_to:
        return [
            f"one image: the {proof.blind_to} image changes nothing in the output; exporters join "
            "the two if they are given the same example for both"
        ]
    if found is None:
        return [
            f"no match: the output is {proof.seen.words} of disparity, under every order of the "
            "images and every range of the pixels; weights that were not trained cannot match"
        ]
    wrong = []
    if found.swapped != given.swapped:
        wrong.append("sides: the textures are found when left and right are exchanged")
    if found.pixels != given.pixels:
        wrong.append(
            f"normalisation: the textures are found with pixels {found.pixels}, not {given.pixels}"
        )
    if found.of_depth != given.of_depth:
        return [
            *wrong,
            f"depth: the output is {proof.seen.words} of disparity, so it is "
            f"{'a depth' if found.of_depth else 'a disparity'}",
        ]
    if found.factor * given.factor < 0:
        wrong.append(f"sign: the output is {proof.seen.words} of disparity")
    same_scale = found.of_width == given.of_width
    if not same_scale or abs(abs(found.factor / given.factor) - 1) > _TOLERANCE:
        wrong.append(
            f"scale: the output is {proof.seen.words} of disparity, so the factor is "
            f"{found.factor_words}, not {given.factor_words}"
        )
    return wrong
