"""``python -m vergence_models.train``: train one tier on pools of clips, as long as you like.

    python -m vergence_models.train --config lite --pool pool/a --val pool/val --out runs/lite
    python -m vergence_models.train ... --out runs/lite --resume --minutes 60
    python -m vergence_models.train --config full --batch 8 --frames 16 --workers 14 ...  # on a GPU

A run can be stopped at any minute (a signal or ``--minutes``) and continues where it was: weights,
moving average, optimizer, step and random states are in its checkpoint.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import math
import shlex
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.progress import Progress

from vergence_models.config import CONFIGS, load_config
from vergence_models.data.pool import ClipPool
from vergence_models.progress import progress_bar
from vergence_models.training.batches import batches
from vergence_models.training.runs import CHECKPOINT_NAME, LOG_NAME, RunError
from vergence_models.training.trainer import Trainer, learning_rate
from vergence_models.training.validation import save_picture, validate

log = logging.getLogger("vergence_models.train")


def train(trainer: Trainer, arguments: argparse.Namespace, progress: Progress) -> None:
    """The loop: step, log, save, validate, until a signal arrives or the minutes are over."""
    stop = False

    def on_signal(number: int, frame: FrameType | None) -> None:
        nonlocal stop
        stop = True
        signal.signal(number, signal.SIG_DFL)  # a second signal ends the run at once

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    held_out = ClipPool(*arguments.val) if arguments.val else None
    out: Path = arguments.out
    started = saved = validated = last = time.monotonic()
    recent: list[dict[str, float]] = []

    def elapsed_minutes() -> float:
        return (time.monotonic() - started) / 60

    training_batches = batches(
        arguments.pool,
        trainer.config.training,
        first_step=trainer.progress.steps,
        workers=arguments.workers,
    )
    bar = progress.add_task(f"training {trainer.config.name}", total=None, note="the first step")
    if math.isfinite(arguments.minutes):
        progress.update(bar, total=round(60 * arguments.minutes))
    else:
        log.info("training until Ctrl-C; --minutes ends it by itself")
    while not stop and elapsed_minutes() < arguments.minutes:
        recent.append(trainer.step(next(training_batches)))
        now = time.monotonic()
        progress.update(
            bar, completed=round(now - started), note=note_of(trainer, recent[-1], now - last)
        )
        trainer.progress.minutes += (now - last) / 60
        last = now
        if len(recent) == arguments.log_every:
            report(out, trainer, recent)
            recent = []
        if now - saved > 60 * arguments.save_minutes:
            saved = now
            trainer.save(out)
        if held_out is not None and now - validated > 60 * arguments.val_minutes:
            progress.update(bar, note="validating")
            network = trainer.averaged_network()
            trainer.measured = validate(network, held_out, trainer.device)
            save_picture(network, held_out, out / "sample.png", trainer.device)
            write_line(out, {"step": trainer.progress.steps, "validation": trainer.measured})
            trainer.save(out)
            validated = saved = last = time.monotonic()
    training_batches.close()
    trainer.save(out)  # before the slow validation: a stopped run may be killed during it
    if held_out is not None and trainer.progress.steps:
        progress.update(bar, note="saved; validating (a second Ctrl-C skips it)")
        trainer.measured = validate(trainer.averaged_network(), held_out, trainer.device)
        write_line(out, {"step": trainer.progress.steps, "validation": trainer.measured})
    trainer.save(out)
    log.info("saved %s at step %d; --resume continues it", out, trainer.progress.steps)


def note_of(trainer: Trainer, figures: dict[str, float], step_s: float) -> str:
    """What the bar says of one step."""
    return (
        f"step {trainer.progress.steps}, {1 / max(step_s, 1e-9):.2g} steps/s, "
        f"loss {figures['loss']:.2f}, error {figures['later']:.2f} px"
    )


def report(out: Path, trainer: Trainer, recent: list[dict[str, float]]) -> None:
    means = {key: float(np.mean([entry[key] for entry in recent])) for key in recent[0]}
    progress = trainer.progress
    write_line(
        out,
        {
            "step": progress.steps,
            "minutes": round(progress.minutes, 1),
            "rate": learning_rate(trainer.config, progress.steps),
            **{key: round(value, 4) for key, value in means.items()},
        },
    )


def write_line(out: Path, values: dict[str, Any]) -> None:
    """Append one JSON line to the run's log and print it."""
    line = json.dumps(values)
    with (out / LOG_NAME).open("a", encoding="utf-8") as file:
        file.write(line + "\n")
    log.info("%s", line)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="vergence_models.train", description=__doc__)
    add = parser.add_argument
    add("--config", default="lite", choices=list(CONFIGS))
    add("--pool", type=Path, nargs="+", required=True, help="folders of pre-rendered clips")
    add("--val", type=Path, nargs="*", default=[], help="folders of held-out clips")
    add("--out", type=Path, required=True, help="folder of the run")
    add("--resume", action="store_true", help="continue the run in --out")
    add("--start-from", type=Path, metavar="RUN", help="take over another run's weights")
    add("--minutes", type=float, default=math.inf, help="stop this session after so many minutes")
    add("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    add("--workers", type=int, default=0, help="processes that make batches; 0: the main process")
    add("--log-every", type=int, default=20, help="steps between two lines of the log")
    add("--save-minutes", type=float, default=3, help="minutes between two checkpoints")
    add("--val-minutes", type=float, default=10, help="minutes between two validations")
    group = parser.add_argument_group("training", "fields of TrainingConfig")
    for entry in dataclasses.fields(type(CONFIGS["lite"].training)):
        kind = type(getattr(CONFIGS["lite"].training, entry.name))
        group.add_argument(f"--{entry.name.replace('_', '-')}", type=kind, default=None)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    given = parse(arguments)
    words = arguments if arguments is not None else sys.argv[1:]
    with progress_bar(counted=False) as progress:
        # After the bar has begun: lines of the log are then written above it.
        logging.basicConfig(level=logging.INFO, format="%(message)s")
        run(given, words, progress)


def run(given: argparse.Namespace, words: list[str], progress: Progress) -> None:
    """Make or load the trainer that the arguments ask for, and train it."""
    config = load_config(given.config)
    changed = {
        entry.name: getattr(given, entry.name)
        for entry in dataclasses.fields(config.training)
        if getattr(given, entry.name) is not None
    }
    config = dataclasses.replace(config, training=dataclasses.replace(config.training, **changed))
    trainer = Trainer(config, torch.device(given.device))
    if given.resume:
        try:
            trainer.resume(given.out)
        except RunError as error:
            sys.exit(f"vergence_models.train: {error}")
    elif (given.out / CHECKPOINT_NAME).exists():
        sys.exit(f"{given.out} already holds a run; add --resume or choose another folder")
    elif given.start_from is not None:
        try:
            missing = trainer.start_from(given.start_from)
        except RunError as error:
            sys.exit(f"vergence_models.train: {error}")
        log.info("untrained: %s", ", ".join(missing) or "nothing")
    given.out.mkdir(parents=True, exist_ok=True)
    trainer.commands.append(shlex.join(["python", "-m", "vergence_models.train", *words]))
    train(trainer, given, progress)


if __name__ == "__main__":
    main()
