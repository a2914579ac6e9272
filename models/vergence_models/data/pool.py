"""Pre-rendered clips on disk: `python -m vergence_models.data.pool --out DIR ...` and `ClipPool`.

A pool is a folder of shards, `shard_SEED_FIRST/`, each a few .npy files of clips of one size, so
that training memory-maps them. Clips are clean; the sensor is simulated each time they are used.
A shard is written under another name and renamed when complete: a pool may be read while it
grows, and a stopped run continues where it was.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import MofNCompleteColumn, Progress, SpinnerColumn, TimeRemainingColumn

from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator, GeneratorConfig

DISPARITY_SCALE = 64  # stored as uint16 = round(64 * px); 0 is unknown


@dataclass(frozen=True, slots=True, eq=False)
class _Shard:
    images: NDArray[np.uint8]  # [N, T, 2, H, W, 3], RGB, left and right
    disparity: NDArray[np.uint16]  # [N, T, H, W]
    visible: NDArray[np.uint8]  # [N, T, H, ceil(W / 8)], packed bits
    world_from_left: NDArray[np.float64]  # [N, T, 4, 4]
    camera: NDArray[np.float32]  # [N, 5]: fx, fy, cx, cy, baseline_m

    FILES = ("images", "disparity", "visible", "world_from_left", "camera")

    @classmethod
    def open(cls, folder: Path) -> _Shard:
        return cls(*(np.load(folder / f"{name}.npy", mmap_mode="r") for name in cls.FILES))


class ClipPool:
    """Clips of one size and length, memory-mapped from the shards of one or more folders.

    FileNotFoundError means that no folder holds a shard (of the size asked for).
    """

    def __init__(self, *folders: Path, size: tuple[int, int] | None = None) -> None:
        self._folders = folders
        self._size = size  # width, height
        self._shards: dict[Path, _Shard] = {}
        self.refresh()
        if not self._shards:
            wanted = f" of {size[0]}x{size[1]}" if size else ""
            raise FileNotFoundError(f"no shards{wanted} in {', '.join(map(str, folders))}")

    def refresh(self) -> None:
        """Add new shards on disk; the first shard fixes size and length."""
        for folder in self._folders:
            for path in sorted(folder.glob("shard_*_*")):
                if path in self._shards or path.suffix:
                    continue
                shard = _Shard.open(path)
                height, width = shard.disparity.shape[2:]
                if self._size in (None, (width, height)):
                    self._size = (width, height)
                    self._shards[path] = shard
        kept = list(self._shards.values())
        self._ends = np.cumsum([len(shard.images) for shard in kept])

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def clips(self, indices: Sequence[int]) -> StereoClips:
        """The clips with these numbers, whole."""
        shards = list(self._shards.values())
        parts = []
        for index in indices:
            which = int(np.searchsorted(self._ends, index, side="right"))
            row = index - int(self._ends[which]) + len(shards[which].images)
            parts.append(_read(shards[which], row))
        return StereoClips.concatenate(parts)

    def sample(
        self,
        rng: np.random.Generator,
        batch: int,
        *,
        frames: int | None = None,
        crop: tuple[int, int] | None = None,
        reverse: float = 0.0,
        skip: float = 0.0,
        flip: float = 0.0,
    ) -> StereoClips:
        """A random batch; the last three arguments are probabilities.

        Args:
            rng: the only source of randomness.
            batch: how many clips, drawn with replacement.
            frames: how many frames of each, by default all; a shorter clip is played to and fro.
            crop: width and height of a random window, by default the whole image.
            reverse: probability to play a clip backwards.
            skip: probability to take every other frame, where a clip is long enough.
            flip: probability to turn a clip upside down (left and right would swap the eyes).
        """
        parts = []
        for index in rng.integers(len(self), size=batch):
            clip = self.clips([int(index)])
            wanted = frames or clip.frames
            stride = 2 if rng.random() < skip and clip.frames >= 3 else 1
            first = int(rng.integers(max(1, clip.frames - (wanted - 1) * stride)))
            order = _to_and_fro(first + stride * np.arange(wanted), clip.frames)
            clip = _frames(clip, order[::-1] if rng.random() < reverse else order)
            if crop is not None:
                clip = _crop(clip, rng, *crop)
            parts.append(_upside_down(clip) if rng.random() < flip else clip)
        return StereoClips.concatenate(parts)


def _to_and_fro(steps: NDArray[np.int_], frames: int) -> NDArray[np.int_]:
    """The frames that are shown at these steps of a clip which turns round at either end."""
    last = max(frames - 1, 1)
    order: NDArray[np.int_] = np.minimum(last - np.abs(steps % (2 * last) - last), frames - 1)
    return order


def _read(shard: _Shard, row: int) -> StereoClips:
    images = torch.from_numpy(np.array(shard.images[row])).transpose(0, 1)
    disparity = shard.disparity[row].astype(np.float32) / DISPARITY_SCALE
    width = disparity.shape[-1]
    visible = np.unpackbits(shard.visible[row], axis=-1, count=width).astype(bool)
    fx, fy, cx, cy, baseline_m = torch.from_numpy(shard.camera[row].copy())[:, None]
    return StereoClips(
        left=images[:1].contiguous(),
        right=images[1:].contiguous(),
        disparity_px=torch.from_numpy(disparity)[None],
        visible=torch.from_numpy(visible)[None],
        world_from_left=torch.from_numpy(shard.world_from_left[row].copy())[None],
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        baseline_m=baseline_m,
    )


def _frames(clip: StereoClips, order: NDArray[np.int64]) -> StereoClips:
    at = torch.from_numpy(order.copy())
    return StereoClips(
        clip.left[:, at], clip.right[:, at], clip.disparity_px[:, at], clip.visible[:, at],
        clip.world_from_left[:, at], clip.fx, clip.fy, clip.cx, clip.cy, clip.baseline_m,
    )  # fmt: skip


def _crop(clip: StereoClips, rng: np.random.Generator, width: int, height: int) -> StereoClips:
    """The same window of both eyes; a point whose match falls outside it is no longer visible."""
    full_height, full_width = clip.disparity_px.shape[-2:]
    x, y = (int(rng.integers(a - b + 1)) for a, b in ((full_width, width), (full_height, height)))
    rows, columns = slice(y, y + height), slice(x, x + width)
    disparity = clip.disparity_px[..., rows, columns]
    matched = torch.arange(width) - disparity >= 0
    return StereoClips(
        clip.left[:, :, rows, columns], clip.right[:, :, rows, columns], disparity,
        clip.visible[..., rows, columns] & matched, clip.world_from_left,
        clip.fx, clip.fy, clip.cx - x, clip.cy - y, clip.baseline_m,
    )  # fmt: skip


def _upside_down(clip: StereoClips) -> StereoClips:
    """Mirror in the camera's horizontal plane: the pose is conjugated by y -> -y."""
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    height = clip.disparity_px.shape[-2]
    return StereoClips(
        clip.left.flip(2), clip.right.flip(2), clip.disparity_px.flip(2), clip.visible.flip(2),
        mirror @ clip.world_from_left @ mirror,
        clip.fx, clip.fy, clip.cx, height - 1 - clip.cy, clip.baseline_m,
    )  # fmt: skip


def write_shard(folder: Path, clips: StereoClips) -> None:
    """Write clips as one shard; the folder appears when it is complete."""
    partial = folder.with_suffix(".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    images = torch.stack([clips.left, clips.right], dim=2)
    disparity = (clips.disparity_px.double() * DISPARITY_SCALE).round().clamp(0, 65535)
    camera = torch.stack([clips.fx, clips.fy, clips.cx, clips.cy, clips.baseline_m], dim=1)
    shard = _Shard(
        images=np.ascontiguousarray(images.cpu().numpy()),
        disparity=disparity.cpu().numpy().astype(np.uint16),
        visible=np.packbits(clips.visible.cpu().numpy(), axis=-1),
        world_from_left=clips.world_from_left.cpu().numpy(),
        camera=camera.cpu().numpy(),
    )
    for name in _Shard.FILES:
        np.save(partial / f"{name}.npy", getattr(shard, name))
    partial.rename(folder)


def _render_shard(folder: Path, config: GeneratorConfig, seed: int, indices: range) -> int:
    generator = _generator(config)
    # One clip at a time: on a CPU larger batches only spill the caches.
    write_shard(
        folder,
        StereoClips.concatenate([generator.clips(seed=seed, indices=[i]) for i in indices]),
    )
    return len(indices)


_kept: dict[GeneratorConfig, ClipGenerator] = {}  # a worker uses its texture bank for all shards


def _generator(config: GeneratorConfig) -> ClipGenerator:
    if config not in _kept:
        _kept[config] = ClipGenerator(config)
    return _kept[config]


def render_pool(
    out: Path, config: GeneratorConfig, *, clips: int, seed: int, shard_clips: int, workers: int
) -> int:
    """Render the missing ones of a pool's first `clips` clips; returns their number."""
    missing = []
    for first in range(0, clips, shard_clips):
        folder = out / f"shard_{seed}_{first:06d}"
        if not folder.exists():
            missing.append((folder, range(first, min(first + shard_clips, clips))))
    columns = (SpinnerColumn(), *Progress.get_default_columns()[:2], MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn()) as progress:
        bar = progress.add_task("clips", total=sum(len(indices) for _, indices in missing))
        for count in _render_shards(missing, config, seed, workers):
            progress.advance(bar, count)
    return sum(len(indices) for _, indices in missing)


def _render_shards(
    missing: list[tuple[Path, range]], config: GeneratorConfig, seed: int, workers: int
) -> Iterator[int]:
    """Yields the number of clips of each shard as it is done."""
    if workers == 1:
        for folder, indices in missing:
            yield _render_shard(folder, config, seed, indices)
        return
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    ) as executor:
        jobs = [executor.submit(_render_shard, f, config, seed, indices) for f, indices in missing]
        for job in as_completed(jobs):
            yield job.result()


def main(
    out: Annotated[Path, typer.Option(help="Folder of the pool; made if missing.")],
    clips: Annotated[int, typer.Option(min=1)] = 1000,
    frames: Annotated[int, typer.Option(min=1)] = 4,
    size: Annotated[str, typer.Option(metavar="WxH")] = "256x192",
    seed: Annotated[int, typer.Option()] = 0,
    zoom: Annotated[
        float, typer.Option(min=1, help="Clips are windows of an image up to so many times larger.")
    ] = 1.0,
    textures: Annotated[Path | None, typer.Option(help="Folder of photographs.")] = None,
    shard_clips: Annotated[int, typer.Option(min=1, help="Clips in a shard.")] = 50,
    workers: Annotated[int, typer.Option(min=1, help="Processes, one thread each.")] = 1,
) -> None:
    """Render a pool of clean clips, or continue one that was stopped."""
    width, height = (int(side) for side in size.split("x"))
    if workers == 1:
        torch.set_num_threads(1)  # the arrays are too small to be shared among threads
    config = GeneratorConfig(
        width=width, height=height, frames=frames, largest_zoom=zoom, textures=textures
    )
    count = render_pool(
        out, config, clips=clips, seed=seed, shard_clips=shard_clips, workers=workers
    )
    typer.echo(f"{count} clips of {frames} frames rendered into {out}")


if __name__ == "__main__":
    program = typer.Typer(
        add_completion=False, context_settings={"help_option_names": ["-h", "--help"]}
    )
    program.command()(main)
    program()
