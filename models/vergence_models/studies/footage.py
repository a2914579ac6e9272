"""The footage of the studies: held-out clips at set speeds, and sources on disk.

Clips are rendered once into a cache: the same scenes and camera paths at every speed, with seeds
that no training uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vergence_models.data.generator import GeneratorConfig
from vergence_models.data.pool import render_pool
from vergence_models.data.shots import Mix, Playback
from vergence_models.evaluate import footage_of_pool, footage_on_disk
from vergence_models.evaluation.stepping import Footage
from vergence_proto.datasets import find_sources

SEED = 910_001  # training and validation pools have others
SPEEDS = (1, 2, 6, 10, 20)
# A headset is worn indoors; one blank street at 100 px would outweigh all rooms in a mean.
ROOMS = Mix(streets=0.0, swarms=0.0, clutter=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class FootageGroup:
    """Sequences that are measured together; read again each time, never all in memory."""

    name: str
    words: str  # description for readers of the tables
    frames: int  # most frames of each sequence
    read: Callable[[], Iterable[Footage]]
    last_only: bool = False  # judge the last frame alone

    def __iter__(self) -> Iterator[Footage]:
        for footage in self.read():
            views = list(footage.views[: self.frames])
            if self.last_only:
                views[:-1] = [replace(view, truth_px=None) for view in views[:-1]]
            yield replace(footage, views=views)


@dataclass(frozen=True, slots=True)
class StudySettings:
    """The number and size of held-out clips, and the number of timed frames."""

    clips: int = 12
    frames: int = 30  # one second of a headset's camera
    short: int = 12  # frames of the clips on which speed and pose noise are studied
    width: int = 320
    height: int = 256
    textures: Path | None = None  # a folder of photographs; None: procedural textures only
    timed: int = 5  # frames of each method that are timed


def clips_at(speed: int, settings: StudySettings, cache: Path, *, workers: int) -> FootageGroup:
    """Short clips at one speed, judged by their last frame: the same view at every speed."""
    s = settings
    folder = rendered(Playback(speed), s.short, s, cache, workers=workers)
    return FootageGroup(
        f"clips, {speed}x",
        f"the last of {s.short} frames of {s.clips} held-out clips of rooms, {s.width}x{s.height}, "
        f"from our generator (seed {SEED}): the same view whatever the speed",
        s.short,
        lambda: footage_of_pool(folder, s.clips),
        last_only=True,
    )


def whole_clips(settings: StudySettings, cache: Path, *, workers: int) -> FootageGroup:
    """The clips as a calm head films them."""
    s = settings
    folder = rendered(Playback(), s.frames, s, cache, workers=workers)
    return FootageGroup(
        "clips",
        f"{s.clips} held-out clips of rooms, {s.frames} frames, {s.width}x{s.height}, from our "
        f"generator (seed {SEED})",
        s.frames,
        lambda: footage_of_pool(folder, s.clips),
    )


def rendered(
    playback: Playback, frames: int, settings: StudySettings, cache: Path, *, workers: int
) -> Path:
    """The folder of a pool in the cache; renders what it lacks, clip by clip."""
    s = settings
    looks = f"_{s.textures.name}" if s.textures else ""
    speed = f"speed_{playback.speed:g}_frames_{frames}"
    folder = cache / f"{s.width}x{s.height}{looks}" / speed
    config = GeneratorConfig(
        width=s.width,
        height=s.height,
        frames=frames,
        mix=ROOMS,
        playback=playback,
        textures=s.textures,
    )
    render_pool(folder, config, clips=s.clips, seed=SEED, shard_clips=1, workers=workers)
    return folder


def group_on_disk(spec: str, frames: int) -> FootageGroup:
    """Every source under KIND:PATH. Raises DatasetError as it is read."""
    words = f"at most {frames} frames of each sequence in `{spec}`"
    return FootageGroup(spec, words, frames, lambda: footage_on_disk(find_sources(spec)))
