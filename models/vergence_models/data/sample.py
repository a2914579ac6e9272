"""The short indoor sequence that ships with the client: one furnished room, a calm head.

`python -m vergence_models.data.sample --out DIR` writes it in the `vergence:` layout. All textures
are procedural, so the pictures carry no third party's rights.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import track

from vergence_models.data import furniture
from vergence_models.data.clips import StereoClips
from vergence_models.data.materials import Material, MaterialPalette
from vergence_models.data.pool import DISPARITY_SCALE
from vergence_models.data.render import render
from vergence_models.data.scenes import Builder, PointLight, Scene
from vergence_models.data.shapes import Cutout
from vergence_models.data.textures import TextureBank
from vergence_models.data.trajectories import HeadMotion, rotation
from vergence_models.data.views import Shot

_RATE_HZ = 30
_BASELINE_M = 0.1
_FOCAL_PER_WIDTH = 0.625  # 77 degrees across
_NOISE = 1.0  # standard deviation of the sensor noise, grey levels


def living_room(kinds: tuple[str, ...]) -> Scene:
    """A room of 5.2 by 5.6 m; the camera stands at its near end and looks along z."""
    rng = np.random.default_rng(28)
    palette = MaterialPalette(rng, kinds)
    b = Builder()
    oak = _stain(palette, "wood", 1.9, (1.25, 1.06, 0.84), base=(0.10, 0.09, 0.07))
    pine = _stain(palette, "wood", 0.9, (0.95, 0.85, 0.7), base=(0.25, 0.22, 0.17))
    walnut = _stain(palette, "wood", 0.8, (0.9, 0.62, 0.42), base=(0.06, 0.03, 0.02))
    white = Material(palette.texture("clouds"), 1.0, (0.006,) * 3, (0.88, 0.87, 0.85))
    paper = _stain(palette, "weave", 0.6, (0.12, 0.12, 0.10), base=(0.62, 0.68, 0.64))
    blue = _stain(palette, "weave", 0.35, (0.22, 0.24, 0.26), base=(0.20, 0.32, 0.46))

    b.floor((0, 0, 0.4), 2.6, 2.8, oak)
    b.floor((0, -2.6, 0.4), 2.6, 2.8, white)
    for side, (away, half) in enumerate([(3.2, 2.6), (2.6, 2.8), (2.4, 2.6), (2.6, 2.8)]):
        shift = 0.4 if side % 2 else 0.0
        wall = b.at(0, 0, shift).at(0, 0, 0, yaw=side * np.pi / 2).at(0, 0, away)
        wall.wall((0, -1.3, 0), half, 1.3, paper)
        wall.box((0, -0.06, -0.01), (half, 0.06, 0.015), white)
        wall.box((0, -2.56, -0.02), (half, 0.04, 0.03), white)
    rug = _stain(palette, "plaid", 0.8, (0.9, 0.5, 0.4), base=(0.15, 0.08, 0.06))
    b.floor((0.1, -0.008, 1.0), 1.35, 0.95, rug)
    b.floor((0.1, -0.004, 1.0), 1.45, 1.05, white)

    def seeded(seed: int) -> np.random.Generator:
        return np.random.default_rng(seed)

    def decor(seed: int, wood: Material) -> MaterialPalette:
        return _Decor(seeded(seed), kinds, wood)

    furniture.sofa(b.at(-0.25, 0, 2.65), decor(2, blue), seeded(32), 1.0)
    furniture.table(b.at(0.15, 0, 1.0), decor(5, walnut), seeded(5), 0.75)
    furniture.bookshelf(b.at(2.42, 0, 2.1, yaw=np.pi / 2), decor(3, pine), seeded(3), 1.1)
    furniture.bookshelf(b.at(2.42, 0, 0.9, yaw=np.pi / 2), decor(8, pine), seeded(8), 1.1)
    furniture.plant(b.at(-2.1, 0, 2.6), decor(2, pine), seeded(2), 1.5)
    furniture.floor_lamp(b.at(1.45, 0, 2.75), decor(4, pine), seeded(4), 1.0)
    furniture.chair(b.at(-1.15, 0, 0.35, yaw=2.3), decor(9, walnut), seeded(9), 1.0)
    furniture.cabinet(b.at(-2.38, 0, 0.9, yaw=-np.pi / 2), decor(6, pine), seeded(6), 0.9)
    stool = b.at(0.95, 0, -0.35, yaw=0.5)
    stool.box((0, -0.56, 0), (0.2, 0.02, 0.2), pine)
    for x in (-0.16, 0.16):
        for z in (-0.16, 0.16):
            stool.post((x, -0.27, z), 0.018, 0.27, pine)
    furniture.plant(stool.at(0, -0.58, 0), decor(12, pine), seeded(12), 0.6)
    for x, w, h in ((-0.9, 0.26, 0.34), (-0.2, 0.34, 0.26), (0.55, 0.22, 0.3)):
        y = -1.65
        b.box((x, y, 3.185), (w + 0.03, h + 0.03, 0.015), walnut)
        b.wall((x, y, 3.168), w, h, palette.textured(0.9, "patchwork"))
    window = b.at(-2.58, -1.5, 1.9, yaw=-np.pi / 2)
    window.wall((0, 0, 0), 0.65, 0.75, palette.lamp())
    window.wall((0, 0, -0.02), 0.65, 0.75, white, cutout=Cutout.GRID)
    lights = (
        PointLight(np.array([-1.6, -2.35, -0.9]), np.array([1.0, 0.93, 0.82]) * 1.7, 3.5),
        PointLight(np.array([-2.3, -1.6, 1.9]), np.array([0.85, 0.95, 1.1]) * 0.9, 2.5),
    )
    return Scene(
        primitives=np.array(b.rows, np.float32),
        lights=lights,
        shadow_target_m=np.array([-0.4, 0.0, 0.3]),
        shadow_half_angle_rad=np.radians(50),
        ambient=np.array([0.3, 0.31, 0.34]),
        sky_texture=palette.texture("clouds"),
        sky_color=np.array([0.9, 0.95, 1.0]),
        exposure=0.5,
    )


class _Decor(MaterialPalette):
    """A palette with one fixed wood or cloth, and book covers for everything else."""

    def __init__(self, rng: np.random.Generator, kinds: tuple[str, ...], wood: Material) -> None:
        super().__init__(rng, kinds)
        self._wood = wood
        self._draw = rng

    def textured(self, size_m: float, *kinds: str) -> Material:
        return self._wood if kinds else self.any(size_m)

    def wood(self, size_m: float) -> Material:
        return self._wood

    def plain(self, *, tone: float | None = None) -> Material:
        return self._wood if tone is None else super().plain(tone=tone)

    def any(self, size_m: float) -> Material:
        hue = self._draw.uniform(0, 2 * np.pi) + np.array([0.0, 2.1, 4.2])
        r, g, b = (float(c) for c in self._draw.uniform(0.15, 0.6) + 0.13 * np.cos(hue))
        kind = str(self._draw.choice(["clouds", "weave", "print", "stripes", "dots"]))
        return Material(self.texture(kind), size_m, (0.3,) * 3, (r, g, b), specular=0.15)


def _stain(
    palette: MaterialPalette, kind: str, span_m: float, gain: tuple[float, float, float], *,
    base: tuple[float, float, float],
) -> Material:  # fmt: skip
    return Material(palette.texture(kind), span_m, gain, base, specular=0.06, shininess=25.0)


def film(*, frames: int, width: int, height: int) -> StereoClips:
    """The sequence as one clip, with a little sensor noise."""
    bank = TextureBank.create(seed=4, patterns=48, size=512)
    motion = HeadMotion.draw(np.random.default_rng(11), speed=1.1)
    times_s = np.arange(frames) / _RATE_HZ
    world_from_start = np.eye(4)
    world_from_start[:3, :3] = rotation(np.array([-0.17, 0.05, 0.0]))
    world_from_start[:3, 3] = (0.15, -1.45, -1.75)
    start_from_left = np.stack([motion.start_from_camera(t) for t in times_s])
    scene = living_room(bank.kinds)

    def shot(at: int, scale: int) -> Shot:
        return Shot(
            scene=scene,
            world_from_left=world_from_start @ start_from_left[at : at + 1],
            times_s=times_s[at : at + 1],
            focal_px=_FOCAL_PER_WIDTH * width * scale,
            cx=(width * scale - 1) / 2,
            cy=(height * scale - 1) / 2,
            baseline_m=_BASELINE_M,
        )

    noise = torch.Generator().manual_seed(1)
    parts = []
    for index in track(range(frames), description="frames"):
        truth = render([shot(index, 1)], bank, width=width, height=height)
        # Four times the pixels for colour: smooth edges and textures; truth stays at the centres.
        fine = render([shot(index, 2)], bank, width=2 * width, height=2 * height)
        eyes = [_halved(image, noise) for image in (fine.left, fine.right)]
        parts.append((eyes, truth))
    first = parts[0][1]
    return StereoClips(
        left=torch.cat([eyes[0] for eyes, _ in parts], dim=1),
        right=torch.cat([eyes[1] for eyes, _ in parts], dim=1),
        disparity_px=torch.cat([t.disparity_px for _, t in parts], dim=1),
        visible=torch.cat([t.visible for _, t in parts], dim=1),
        world_from_left=torch.cat([t.world_from_left for _, t in parts], dim=1),
        fx=first.fx, fy=first.fy, cx=first.cx, cy=first.cy, baseline_m=first.baseline_m,
    )  # fmt: skip


def _halved(image: torch.Tensor, noise: torch.Generator) -> torch.Tensor:
    clips, frames, height, width, channels = image.shape
    size = (clips, frames, height // 2, width // 2)
    blocks = image.reshape(clips, frames, height // 2, 2, width // 2, 2, channels)
    mean = blocks.float().mean(dim=(3, 5))
    # Plane by plane, as the shipped sequence was made.
    drawn = torch.randn(clips * frames * channels, *size[2:], generator=noise)
    mean += _NOISE * drawn.view(clips, frames, channels, *size[2:]).permute(0, 1, 3, 4, 2)
    return (mean + 0.5).clamp(0, 255).to(torch.uint8)


def write_sequence(folder: Path, clips: StereoClips, *, quality: int) -> None:
    """Write the first clip in the `vergence:` layout, its images as WebP."""
    folder.mkdir(parents=True, exist_ok=True)
    height, width = clips.disparity_px.shape[-2:]
    calibration = {
        "fx": float(clips.fx[0]),
        "fy": float(clips.fy[0]),
        "cx": float(clips.cx[0]),
        "cy": float(clips.cy[0]),
        "baseline_m": round(float(clips.baseline_m[0]), 6),
        "width": width,
        "height": height,
        "fps": _RATE_HZ,
        "frames": clips.frames,
    }
    (folder / "calib.json").write_text(json.dumps(calibration, indent=1) + "\n")
    world_from_left = clips.world_from_left[0].cpu().numpy()
    first_from_left = np.linalg.inv(world_from_left[0]) @ world_from_left
    np.savetxt(folder / "poses.txt", first_from_left[:, :3].reshape(-1, 12), fmt="%.9f")
    for index in range(clips.frames):
        for eye, images in (("left", clips.left), ("right", clips.right)):
            bgr = images[0, index].flip(-1).contiguous().cpu().numpy()
            path = folder / f"frame_{index:04d}_{eye}.webp"
            cv2.imwrite(str(path), bgr, [cv2.IMWRITE_WEBP_QUALITY, quality])
        disparity = clips.disparity_px[0, index].cpu().numpy().astype(np.float64)
        _save_small(
            folder / f"frame_{index:04d}_gt.npz",
            disp=np.round(disparity * DISPARITY_SCALE).astype(np.uint16),
            vis=np.packbits(clips.visible[0, index].cpu().numpy(), axis=1),
        )


def _save_small(path: Path, **arrays: NDArray[np.generic]) -> None:
    """An .npz that `np.load` reads like any other, a third smaller than numpy's own."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")  # without a date: same pixels, same bytes
            member.compress_type = zipfile.ZIP_LZMA
            with archive.open(member, "w") as file:
                np.lib.format.write_array(file, array)


def main(
    out: Annotated[Path, typer.Option(help="Folder of the sequence; made if missing.")],
    frames: Annotated[int, typer.Option(min=1)] = 48,
    size: Annotated[str, typer.Option(metavar="WxH")] = "640x480",
    quality: Annotated[int, typer.Option(min=1, max=100, help="Of the WebP images.")] = 82,
) -> None:
    """Render the sample sequence."""
    width, height = (int(side) for side in size.split("x"))
    write_sequence(out, film(frames=frames, width=width, height=height), quality=quality)


if __name__ == "__main__":
    program = typer.Typer(
        add_completion=False, context_settings={"help_option_names": ["-h", "--help"]}
    )
    program.command()(main)
    program()
