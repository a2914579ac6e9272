"""What the studies look at: held-out clips at set speeds, and sources on disk.

Clips come from a cache that is rendered once: the same scenes and camera paths at every speed,
with seeds that no training uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vergence_models.data.generator import GeneratorConfig
from vergence_models.data.pool import render_pool
from vergence_models.data.shots import Playback
from vergence_models.evaluate import footage_of_pool, footage_on_disk
from vergence_models.stepping import Footage

SEED = 910_001  # training and validation pools have others
SPEEDS = (1, 2, 6, 10, 20)


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Sequences that are judged together; read anew each time, never all in memory."""

    name: str
    words: str  # for a reader of the tables
    frames: int  # at most so many of each sequence
    read: Callable[[], Iterable[Footage]]

    def __iter__(self) -> Iterator[Footage]:
        for footage in self.read():
            yield replace(footage, views=footage.views[: self.frames])


@dataclass(frozen=True, slots=True)
class StudySettings:
    """How many held-out clips, and of what size; how long to measure times."""

    clips: int = 12
    frames: int = 30  # one second of a headset's camera
    short: int = 12  # of clips that only a change of speed or of poses is studied on
    width: int = 320
    height: int = 256
    textures: Path | None = None  # a folder of photographs; None: procedural textures only
    timed: int = 5  # frames of each method


def clips_at(
    speed: int, settings: StudySettings, cache: Path, *, frames: int, workers: int
) -> Group:
    """The scenes at one speed; renders what the cache lacks, clip by clip."""
    s = settings
    looks = f"_{s.textures.name}" if s.textures else ""
    folder = cache / f"{s.width}x{s.height}{looks}" / f"speed_{speed}_frames_{frames}"
    config = GeneratorConfig(
        width=s.width,
        height=s.height,
        frames=frames,
        playback=Playback(speed),
        textures=s.textures,
    )
    render_pool(folder, config, clips=s.clips, seed=SEED, shard_clips=1, workers=workers)
    return Group(
        f"{speed}x, {frames} frames",
        f"{s.clips} held-out clips of {frames} frames, {s.width}x{s.height}, from our generator "
        f"(seed {SEED})",
        frames,
        lambda: footage_of_pool(folder, s.clips),
    )


def group_on_disk(spec: str, frames: int) -> Group:
    """Every source under KIND:PATH. Raises LayoutError as it is read."""
    words = f"at most {frames} frames of each sequence in `{spec}`"
    return Group(spec, words, frames, lambda: footage_on_disk([spec]))
