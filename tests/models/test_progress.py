"""Long commands say what they do: a bar on the terminal, a line for each sequence."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

from vergence_models.evaluate import evaluate
from vergence_models.evaluation.methods import Method
from vergence_models.evaluation.stepping import Footage, FootageView, Prediction
from vergence_models.progress import progress_bar
from vergence_proto.geometry import RectifiedRig

HEIGHT, WIDTH = 8, 12
RIG = RectifiedRig(WIDTH, HEIGHT, 20, 20, 5.5, 5.5, 3.5, 0.1)


def footage(name: str, frames: int) -> Footage:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    truth_px = np.full((HEIGHT, WIDTH), 5, np.float32)
    return Footage(name, RIG, [FootageView(image, image, None, truth_px)] * frames)


def off_by(error_px: float) -> Method:
    def predict(shown: Footage) -> Iterator[Prediction]:
        for _ in shown.views:
            yield Prediction(np.full((HEIGHT, WIDTH), 5 + error_px, np.float32))

    return Method(f"off by {error_px:g}", predict)


def test_an_evaluation_counts_its_frames_and_says_what_it_has_found() -> None:
    text = io.StringIO()
    progress = Progress(console=Console(file=text, width=200))
    counted: list[float] = []

    def counting(shown: Footage) -> Iterator[Prediction]:
        for prediction in off_by(2).predict(shown):
            counted.append(max(task.completed for task in progress.tasks))
            yield prediction

    results = evaluate(
        [off_by(1), Method("counting", counting)],
        iter([("a", footage("a", 3)), ("b", footage("b", 2))]),
        progress=progress,
        count=2,
    )
    # While the second method runs, the frames of the first are done: 3 of 6, then 2 of 4.
    assert counted == [3, 4, 5, 2, 3]
    [whole] = progress.tasks
    assert whole.finished
    assert "a, EPE in px: off by 1 1.00; counting 2.00" in text.getvalue()
    assert set(results) == {"a", "b"}


def test_a_file_gets_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar() as progress:
        progress.add_task("work", total=3, note="a note")
    assert capsys.readouterr().err.strip() == ""
