"""A contact sheet: one picture of all images and truths of a frame."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_models.captions import BACKGROUND, captioned
from vergence_models.data.xrbench.writer import PASSES
from vergence_proto.datasets import read_image, read_pfm

Image = NDArray[np.uint8]  # [H, W, 3], RGB


def contact_sheet(folder: Path, name: str, frame: int) -> Image:
    """The passes there are and all truths of a frame, each with its name: [H, W, 3], RGB.

    Raises DatasetError: a file of the frame is missing or damaged.
    """
    left = Path(name) / "left"
    passes = {each: folder / f"frames_{each}pass" / left / f"{frame:04d}.png" for each in PASSES}
    tiles = {
        f"left image, {each} pass": read_image(path)
        for each, path in passes.items()
        if path.exists()
    }
    disparity_px = read_pfm(folder / "disparity" / left / f"{frame:04d}.pfm")
    far, near = np.nanpercentile(disparity_px, (1, 99))
    tiles[f"disparity, {far:.0f} (blue) to {near:.0f} px (red)"] = _heat(disparity_px)
    flow = folder / "optical_flow" / name / "into_future" / "left"
    flow_px = _read_flow(flow / f"OpticalFlowIntoFuture_{frame:04d}_L.pfm")
    fastest = np.nanpercentile(np.hypot(flow_px[..., 0], flow_px[..., 1]), 99)
    tiles[f"flow to the next frame, up to {fastest:.1f} px"] = _wheel(flow_px)
    tiles["normals"] = read_image(folder / "normals" / left / f"{frame:04d}.png")
    boxes = json.loads((folder / "object_boxes" / name / f"{frame:04d}.json").read_text("utf-8"))
    label = folder / "object_index" / left / f"{frame:04d}.png"
    tiles["objects and their boxes"] = _objects(
        np.asarray(cv2.imread(str(label), cv2.IMREAD_UNCHANGED)), boxes
    )
    named = [captioned(tile, words) for words, tile in tiles.items()]
    across = (len(named) + 1) // 2
    named += [np.full_like(named[0], BACKGROUND)] * (2 * across - len(named))
    return np.vstack([np.hstack(named[:across]), np.hstack(named[across:])])


def _heat(disparity_px: NDArray[np.float32]) -> Image:
    share = np.nan_to_num(disparity_px / np.nanpercentile(disparity_px, 99.5))
    stored = (share.clip(0, 1) * 255).astype(np.uint8)
    return _rgb(cv2.applyColorMap(stored, cv2.COLORMAP_TURBO))


def _wheel(flow_px: NDArray[np.float32]) -> Image:
    """Hue is the direction, paleness the lack of speed."""
    u, v = np.nan_to_num(flow_px[..., 0]), np.nan_to_num(flow_px[..., 1])
    speed = np.hypot(u, v)
    hue = (np.degrees(np.arctan2(v, u)) % 360) / 2
    pure = (speed / max(float(np.percentile(speed, 99)), 1e-6)).clip(0, 1) * 255
    hsv = np.dstack([hue, pure, np.full_like(hue, 255)]).astype(np.uint8)
    return _rgb(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR))


def _objects(label: NDArray[np.uint16], boxes: list[dict[str, int]]) -> Image:
    colors = np.random.default_rng(1).integers(60, 230, (int(label.max()) + 1, 3), np.uint8)
    colors[0] = 0
    picture = np.ascontiguousarray(colors[label])
    for box in boxes:
        if box["pixels"] > label.size / 500:
            corners = (box["left"], box["top"]), (box["right"], box["bottom"])
            cv2.rectangle(picture, *corners, (255, 255, 255), 1)
    return picture


def _read_flow(path: Path) -> NDArray[np.float32]:
    data = path.read_bytes()
    _, size, _, values = data.split(b"\n", 3)
    width, height = map(int, size.split())
    return np.frombuffer(values, "<f4").reshape(height, width, 3)[::-1, :, :2]


def _rgb(bgr: cv2.typing.MatLike) -> Image:
    return np.asarray(bgr, np.uint8)[..., ::-1]
