"""Sequences on disk, in the layout of SceneFlow, and further truths that SceneFlow lacks.

For a sequence NAME in a folder::

    frames_cleanpass|frames_finalpass/NAME/left|right/0000.png
    disparity/NAME/left|right/0000.pfm                     pixels, positive in both views
    camera_data/NAME/camera_data.txt                       L and R: camera-to-world, Blender's axes
    camera_data/NAME/intrinsics.json                       fx, fy, cx, cy (pixels), baseline_m, fps
    optical_flow/NAME/into_future|into_past/left/OpticalFlowInto{Future,Past}_0000_L.pfm
    depth/NAME/left/0000.pfm                               metres along the axis; inf is the sky
    normals/NAME/left/0000.png                             16 bits: round(32767 (n + 1)), R = x
    object_index/NAME/left/0000.png                        16 bits; 0 is the sky
    object_boxes/NAME/0000.json                            see truths.Box
    specular/NAME/left/0000.png                            255: a mirror or glass
    rays/NAME/left.npy                                     float32 [H, W, 3], unit, every frame's
    recipes/NAME.json

Every file is written under another name and renamed when complete: a stopped run continues at its
last frame, and finished files can be read meanwhile.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_models.data.xrbench import truths
from vergence_models.data.xrbench.camera import Eye, FrameTruth, StereoCamera
from vergence_models.data.xrbench.meshes import Matrix
from vergence_models.data.xrbench.recipe import BadRecipe, Recipe
from vergence_proto.datasets import encode_pfm

PASSES = ("clean", "final")
_BLENDER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def render_sequence(
    recipe: Recipe, folder: Path, *, passes: tuple[str, ...] = PASSES,
    variant: str | None = None, on_frame: Callable[[], None] = lambda: None,
) -> Path:  # fmt: skip
    """Render the missing frames of a sequence, and return the folder of its best pass.

    Raises BadRecipe: the folder holds a sequence of the same name by another recipe. NoRenderer:
    as `StereoCamera`.
    """
    frames = _claim(recipe, folder)
    todo = [k for k in range(recipe.frames) if not _whole(recipe, folder, k, passes)]
    for _ in range(recipe.frames - len(todo)):
        on_frame()
    camera = StereoCamera(recipe, variant=variant) if todo else None
    if camera:
        _write_calibration(camera, folder, frames)
        for frame in todo:
            for path, data in _files(camera, frame, passes).items():
                _write(folder / path, data)
            on_frame()
    return folder / f"frames_{passes[-1]}pass" / recipe.name


def _claim(recipe: Recipe, folder: Path) -> int:
    """Write the recipe to the folder, and return the number of frames of the sequence there."""
    path = folder / "recipes" / f"{recipe.name}.json"
    if path.exists():
        there = Recipe.from_json(path.read_text("utf-8"), path)
        # A sequence may grow: its first frames stay what they are.
        if replace(there, frames=recipe.frames) != recipe:
            raise BadRecipe(f"{path} is another recipe; render into another folder or remove it")
        if there.frames >= recipe.frames:
            return there.frames
    _write(path, recipe.to_json().encode())
    return recipe.frames


def _whole(recipe: Recipe, folder: Path, frame: int, passes: tuple[str, ...]) -> bool:
    images = (folder / _image_path(recipe.name, each, eye, frame) for each in passes for eye in Eye)
    return all(path.exists() for path in images)


def _image_path(name: str, which: str, eye: Eye, frame: int) -> Path:
    return Path(f"frames_{which}pass") / name / eye.name.lower() / f"{frame:04d}.png"


def _files(camera: StereoCamera, frame: int, passes: tuple[str, ...]) -> Mapping[Path, bytes]:
    """All files of a frame. The left images come last: if one exists, so do all other files."""
    name = camera.recipe.name
    shoot = {"clean": camera.clean, "final": camera.final}
    images = {
        _image_path(name, each, eye, frame): encode_png(shoot[each](frame, eye))
        for eye in (Eye.RIGHT, Eye.LEFT)
        for each in passes
    }
    return {**_truth_files(camera.truth(frame), name, frame), **images}


def _truth_files(truth: FrameTruth, name: str, frame: int) -> Mapping[Path, bytes]:
    still, plane = Path(name) / "left", f"{frame:04d}.pfm"
    flow, picture = Path("optical_flow") / name, f"{frame:04d}.png"
    stored_normals = np.round(32767 * (truth.normals + 1)).astype(np.uint16)
    return {
        "disparity" / still / plane: encode_pfm(truth.disparity_px),
        Path("disparity") / name / "right" / plane: encode_pfm(truth.right_disparity_px),
        "depth" / still / plane: encode_pfm(truth.depth_m),
        flow / "into_future" / "left" / f"OpticalFlowIntoFuture_{frame:04d}_L.pfm":
            _flow_pfm(truth.into_future),
        flow / "into_past" / "left" / f"OpticalFlowIntoPast_{frame:04d}_L.pfm":
            _flow_pfm(truth.into_past),
        "normals" / still / picture: encode_png(stored_normals),
        "object_index" / still / picture: encode_png(truth.label),
        "specular" / still / picture: encode_png(truth.specular.astype(np.uint8) * 255),
        Path("object_boxes") / name / f"{frame:04d}.json": json.dumps(truth.boxes).encode(),
    }  # fmt: skip


def _write_calibration(camera: StereoCamera, folder: Path, frames: int) -> None:
    recipe = camera.recipe
    blocks = []
    for frame in range(frames):
        time_s = camera.path.frame_time_s(frame)
        left, right = (_words(camera.world_from_eye(time_s, eye)) for eye in Eye)
        blocks += [f"Frame {frame}", f"L {left}", f"R {right}", ""]
    intrinsics = {
        "width": recipe.width, "height": recipe.height,
        "fx": recipe.focal_px, "fy": recipe.focal_px,
        "cx": (recipe.width - 1) / 2, "cy": (recipe.height - 1) / 2,
        "baseline_m": recipe.baseline_m, "fps": recipe.fps,
    }  # fmt: skip
    data = folder / "camera_data" / recipe.name
    _write(data / "camera_data.txt", "\n".join(blocks).encode())
    _write(data / "intrinsics.json", (json.dumps(intrinsics, indent=1) + "\n").encode())
    rays = BytesIO()
    np.save(rays, truths.rays(camera.optics))
    _write(folder / "rays" / recipe.name / "left.npy", rays.getvalue())


def _words(world_from_camera: Matrix) -> str:
    return " ".join(f"{x:.12g}" for x in np.ravel(world_from_camera @ _BLENDER_FROM_OPENCV))


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode grey [H, W] or RGB [H, W, 3]."""
    turned = image[..., ::-1] if image.ndim == 3 else image
    done, data = cv2.imencode(".png", np.ascontiguousarray(turned))
    assert done, f"OpenCV encodes every image of {image.dtype} {image.shape}"
    return data.tobytes()


def _flow_pfm(motion: truths.Motion) -> bytes:
    """Three channels as SceneFlow has them, the last one zero."""
    height, width = motion.flow_px.shape[:2]
    three = np.dstack([motion.flow_px, np.zeros((height, width), np.float32)])
    return f"PF\n{width} {height}\n-1.0\n".encode() + three[::-1].astype("<f4").tobytes()


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_bytes(data)
    partial.replace(path)
