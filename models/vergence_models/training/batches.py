"""Batches for training, made in this process or ahead of time in worker processes.

A batch is a pure function of the seed, the step and the pool. So every process makes the same one,
and a resumed run continues with the batch that an undisturbed run would use.
"""

from __future__ import annotations

import itertools
import signal
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from vergence_models.config import TrainingConfig
from vergence_models.data.clips import StereoClips
from vergence_models.data.pool import ClipPool
from vergence_models.training.augment import filmed, stretched
from vergence_models.training.no_evidence import without_evidence

REFRESH_STEPS = 100  # a pool may still be growing


def batch_at(step: int, pool: ClipPool, training: TrainingConfig) -> StereoClips:
    """The batch of one step."""
    random = np.random.default_rng((training.seed, step))
    clips = pool.sample(
        random, training.batch, frames=training.frames, reverse=0.5, skip=0.3, flip=0.3
    )
    clips = stretched(clips, random, share=training.stretch_share)
    clips = filmed(clips, random, clean_share=training.clean_share)
    return without_evidence(
        clips,
        random,
        blinded_share=training.blinded_share,
        unmatched_share=training.unmatched_share,
        repeating_share=training.repeating_share,
    )


def batches(
    folders: Sequence[Path], training: TrainingConfig, *, first_step: int, workers: int
) -> Generator[StereoClips, None, None]:
    """Yield batches from ``first_step`` on, without end; close the iterator to end the workers.

    A single process cannot keep a GPU busy: ``workers`` processes each work two batches ahead.
    Raises FileNotFoundError: there are no clips.
    """
    if workers == 0:
        pool = ClipPool(*folders)
        for step in itertools.count(first_step):
            if step % REFRESH_STEPS == 0:
                pool.refresh()
            yield batch_at(step, pool, training)
    with ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_open, initargs=(folders, training)
    ) as executor:
        waiting: deque[Future[StereoClips]] = deque()
        try:
            for step in itertools.count(first_step):
                waiting.append(executor.submit(_batch_at, step))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


_opened: tuple[ClipPool, TrainingConfig]  # opened once in each worker process


def _open(folders: Sequence[Path], training: TrainingConfig) -> None:
    global _opened
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and ends its workers
    torch.set_num_threads(1)
    _opened = ClipPool(*folders), training


def _batch_at(step: int) -> StereoClips:
    pool, training = _opened
    if step % REFRESH_STEPS == 0:
        pool.refresh()
    return batch_at(step, pool, training)
