"""Of every published layout: a wrong sign, scale, order of the images and range of the pixels."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.foreign_graphs import DISPARITIES, GRAPHS, written
from vergence_models.foreign.adding import add_model, check_model
from vergence_models.foreign.contract import PIXELS, Contract, ContractError
from vergence_models.foreign.files import write_model
from vergence_models.foreign.guess import Given

WRONG: dict[str, Callable[[Contract], Contract]] = {
    "sign": lambda c: replace(c, factor=-c.factor),
    "scale": lambda c: replace(c, factor=16 * c.factor),
    "sides": lambda c: replace(c, swapped=not c.swapped),
    "normalisation": lambda c: replace(c, pixels="0..1" if c.pixels == "0..255" else "0..255"),
}


@pytest.mark.slow  # 40 proofs of a second
@pytest.mark.parametrize("layout", GRAPHS)
def test_a_wrong_contract_is_refused_with_the_word_for_it(layout: str, tmp_path: Path) -> None:
    path = written(GRAPHS[layout].make(), tmp_path / "theirs.of-others")
    given = Given(max_disparity_px=DISPARITIES)
    right = add_model({1: path}, tmp_path, name="right", given=given).contract
    assert right.pixels in PIXELS
    for word, spoil in WRONG.items():
        network = {1: tmp_path / "right.1.onnx"}
        write_model(tmp_path / word, "wrong", spoil(right), network, proven=True)
        with pytest.raises(ContractError, match=rf"wrong: {word}: "):
            check_model(tmp_path / word, "wrong")
