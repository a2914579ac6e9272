"""Add a foreign graph as a model, and prove one that was added."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from onnx import ModelProto

from vergence_models.foreign.contract import Contract, ContractError
from vergence_models.foreign.files import (
    checked_name,
    read_graph,
    read_manifest,
    write_model,
    write_network,
)
from vergence_models.foreign.guess import Given, family_of, images_of, outputs_of
from vergence_models.foreign.proof import (
    WARM_LOSS,
    Proof,
    differences,
    found_range_px,
    observe,
    prove,
    proven_flow,
    texture_size,
    warm_shares,
)
from vergence_models.foreign.textures import scene
from vergence_models.foreign.trial import Network, Trial
from vergence_proto.model_io import ManifestError, load_model_card


@dataclass(frozen=True, slots=True)
class Added:
    """A model that was written, and how far it is proven."""

    name: str
    contract: Contract
    like: str | None
    proof: Proof | None  # None: it was not asked for
    changed: tuple[str, ...]  # what the textures corrected in the guess
    pixels_known: bool = True  # said by the user, or by a published contract


def add_model(
    paths: Mapping[int, Path],
    folder: Path,
    *,
    name: str,
    given: Given,
    unproven: bool = False,
) -> Added:
    """Write a model from graphs by their numbers of iterations. All have one contract.

    What ``given`` leaves open is guessed, and corrected by what the graph makes of shifted
    textures. With ``unproven`` it is written as guessed, for weights that were not trained.

    Raises ContractError if a graph cannot be served or contradicts ``given``; nothing is written
    then. Raises ManifestError if the folder's manifest is of another format.
    """
    checked_name(name)
    read_manifest(folder)
    with TemporaryDirectory() as made:
        networks: dict[int, Path] = {}
        added: Added | None = None
        # The graph with the most iterations matches from nothing; it decides the contract.
        for count, path in sorted(paths.items(), reverse=True):
            model = read_graph(path)
            networks[count] = write_network(model, Path(made) / f"{count}.onnx")
            like = family_of(model, path.stem, given)
            if added is None:
                largest = networks[count]
                added = _guessed(name, model, largest, given, like, unproven)
            else:
                guess = images_of(model, given, like).contract
                _check_same(guess, path, added.contract, networks[count], largest, unproven)
        assert added is not None
        write_model(
            folder,
            name,
            added.contract,
            networks,
            like=added.like,
            files={str(count): path.name for count, path in paths.items()},
            proven=not unproven,
        )
    return added


def _guessed(
    name: str, model: ModelProto, path: Path, given: Given, like: str | None, unproven: bool
) -> Added:
    guess = images_of(model, given, like)
    if given.warm_start is True and guess.contract.warm_start is None:
        raise ContractError("the graph has no input for an initial flow, so it starts cold only")
    network = Network(path)
    likely = outputs_of(guess.contract, network, given)
    contract = likely[0]
    if unproven:
        return Added(name, contract, like, None, (), guess.pixels_known)
    proof = prove(contract, network, search_pixels=not guess.pixels_known)
    for other in likely[1:]:
        if proof.contract is not None:
            break
        tried = prove(other, network, search_pixels=not guess.pixels_known)
        if tried.contract is not None:
            contract, proof = other, tried
    wrong = differences(contract, proof)
    # The textures may correct a guess. What the user says is refused if it is wrong.
    guessed = {
        "sides": given.left is None and given.right is None,
        "normalisation": given.pixels is None and given.like is None,
        "sign": given.factor is None and given.like is None,
        "scale": given.factor is None and given.like is None,
        "depth": given.factor is None and given.like is None,
    }
    refused = [each for each in wrong if not guessed.get(each.partition(":")[0], False)]
    if refused or proof.contract is None:
        raise ContractError("; ".join(refused or wrong))
    contract = proof.contract
    if contract.recurrent:
        contract = proven_flow(contract, network)
    range_px = found_range_px(contract, network, contract.max_disparity_px)
    _check_range(range_px, given.max_disparity_px)
    contract = replace(contract, max_disparity_px=range_px)
    return Added(name, contract, like, proof, tuple(wrong), guess.pixels_known)


def _check_same(
    guess: Contract, path: Path, contract: Contract, network: Path, largest: Path, unproven: bool
) -> None:
    """Check a graph with fewer iterations, warm if it can start warm."""
    if (guess.left, guess.right, guess.size) != (contract.left, contract.right, contract.size):
        raise ContractError(f"{path.name} has other inputs or another size than the first graph")
    if unproven:
        return
    if contract.recurrent:
        cold, warm = warm_shares(contract, Network(network), start=Network(largest))
        if warm < cold - WARM_LOSS:
            raise ContractError(
                f"{path.name}: warm start: {100 * warm:.0f} % of the pixels are right from the "
                f"last disparity, and {100 * cold:.0f} % before"
            )
        return
    seen = observe(contract, Network(network))
    if not seen.matched:
        raise ContractError(f"{path.name}: no match: the output is {seen.words} of disparity")


def _check_range(found_px: int, wanted_px: int | None) -> None:
    if found_px == 0:
        raise ContractError("range: not even a shift of 14 px is found on a wall")
    if wanted_px is not None and found_px < wanted_px:
        raise ContractError(
            f"range: disparities up to {found_px} px are found, not up to {wanted_px}"
        )


def _check_stored(contract: Contract, network: Network, before: Path, after: Path) -> None:
    """Raise ContractError unless the graphs of a folder are those of the contract beside them."""
    size = texture_size(contract)
    pair = scene(*size, 8, 24, seed=5)
    contract = replace(contract, sigma="constant") if contract.sigma == "left-right" else contract
    as_described = Trial(contract, network).disparity_px(pair.left, pair.right)
    stored = Trial(contract, network, before=before, after=after)
    try:
        same = np.array_equal(stored.disparity_px(pair.left, pair.right), as_described)
    except (ContractError, KeyError):
        same = False
    if not same:
        raise ContractError(
            f"{before.name} or {after.name} does not do what the contract in the manifest says; "
            "add the model again"
        )


def check_model(folder: Path, name: str) -> Added:
    """Prove a model that was added. Raises ContractError with what is wrong, and ManifestError."""
    card = load_model_card(folder, name)
    entry: dict[str, Any] = read_manifest(folder)["models"][name]
    if "foreign" not in entry:
        raise ManifestError(f"{name} was exported, not added: its export has checked it")
    about = entry["foreign"]
    contract = Contract.from_json(about["contract"])
    (before, (largest, *_), after), *others = (
        stages for _, stages in sorted(card.graphs.items(), reverse=True)
    )
    network = Network(largest)
    _check_stored(contract, network, before[0], after[0])
    proof = prove(contract, network)
    if wrong := differences(contract, proof):
        raise ContractError(f"{name}: {'; '.join(wrong)}")
    if contract.recurrent and contract.warm_start and proven_flow(contract, network) != contract:
        flow = contract.warm_start.input
        raise ContractError(f"{name}: sign: {flow} is right with the other one")
    found = found_range_px(contract, network, contract.max_disparity_px)
    _check_range(found, contract.max_disparity_px)
    for _, stage, _ in others:
        _check_same(contract, stage[0], contract, stage[0], largest, unproven=False)
    return Added(name, contract, about.get("like"), proof, ())
