"""Read results with the tools they are for: pycolmap, evo and nerfstudio's own parser.

``python read_results.py TOOL FOLDER``, in an environment that has the tool and numpy. FOLDER has
the results of one job as ``npz`` and as the tool reads them, see ``README.md`` beside this file.
"""

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_HALF_MM = 0.0005
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def truth(folder: Path) -> list[tuple[Any, Any]]:
    """The pose [4, 4] and the depth [H, W] of each frame with both, metres, OpenCV axes."""
    frames = []
    for line in (folder / "npz" / "frames.jsonl").read_text().splitlines():
        record = json.loads(line)
        if record["error"] is None and record["world_from_left"] is not None:
            pose = np.vstack([np.array(record["world_from_left"]), [0, 0, 0, 1]])
            depth_m = np.load(folder / "npz" / f"{record['index']:04d}.npz")["depth"]
            frames.append((pose, depth_m))
    return frames


def read_colmap(folder: Path) -> str:
    pycolmap: Any = importlib.import_module("pycolmap")
    frames = truth(folder)
    model = pycolmap.Reconstruction(str(folder / "colmap" / "sparse" / "0"))
    rig = json.loads((folder / "npz" / "rig.json").read_text())
    [camera] = model.cameras.values()
    expected = [rig["fx"], rig["fy"], rig["cx_left"] + 0.5, rig["cy"] + 0.5]
    np.testing.assert_allclose(camera.params, expected)
    images = sorted(model.images.values(), key=lambda image: str(image.name))
    assert len(images) == len(frames)
    for image, (pose, depth_m) in zip(images, frames, strict=True):
        camera_from_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(np.linalg.inv(camera_from_world), pose, atol=1e-9)
        file = folder / "colmap" / "stereo" / "depth_maps" / f"{image.name}.geometric.bin"
        read = pycolmap.DepthMap()
        read.read(str(file))
        np.testing.assert_array_equal(read.to_array(), np.nan_to_num(depth_m))
    return f"pycolmap {pycolmap.__version__}: {len(frames)} poses and depth maps are the same"


def read_evo(folder: Path) -> str:
    files: Any = importlib.import_module("evo.tools.file_interface")
    frames = truth(folder)
    tum = files.read_tum_trajectory_file(str(folder / "tum" / "groundtruth.txt"))
    kitti = files.read_kitti_poses_file(str(folder / "kitti" / "poses.txt"))
    for read in (tum, kitti):
        assert len(read.poses_se3) == len(frames)
        for found, (pose, _) in zip(read.poses_se3, frames, strict=True):
            np.testing.assert_allclose(found, pose, atol=1e-9)
    times_s = np.loadtxt(folder / "kitti" / "times.txt")
    np.testing.assert_allclose(tum.timestamps, times_s, atol=1e-6)
    return f"evo: {len(frames)} poses of tum and kitti are the same"


def read_nerfstudio(folder: Path) -> str:
    parsing: Any = importlib.import_module("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    reading: Any = importlib.import_module("nerfstudio.data.utils.data_utils")
    frames = truth(folder)
    config = parsing.NerfstudioDataParserConfig(
        data=folder / "nerfstudio",
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        downscale_factor=1,
        eval_mode="all",
    )
    outputs = config.setup().get_dataparser_outputs(split="train")
    cameras = outputs.cameras.camera_to_worlds.numpy()
    names = outputs.metadata["depth_filenames"]
    assert len(names) == len(cameras) == len(frames)
    height, width = frames[0][1].shape
    worst_m = 0.0
    for found, name, (pose, depth_m) in zip(cameras, names, frames, strict=True):
        np.testing.assert_allclose(found, (pose @ _OPENCV_FROM_OPENGL)[:3], atol=1e-6)
        read = reading.get_depth_image_from_path(
            Path(name), height, width, outputs.metadata["depth_unit_scale_factor"]
        ).numpy()[..., 0]
        known = np.isfinite(depth_m) & (depth_m < 65.535)
        worst_m = max(worst_m, float(np.abs(read - depth_m)[known].max(initial=0.0)))
        assert (read[~known] == 0).all()
    assert worst_m <= _HALF_MM + 1e-6
    return f"nerfstudio: {len(frames)} cameras are the same, depth to {1000 * worst_m:.3f} mm"


TOOLS: dict[str, Callable[[Path], str]] = {
    "colmap": read_colmap,
    "evo": read_evo,
    "nerfstudio": read_nerfstudio,
}

if __name__ == "__main__":
    sys.stdout.write(TOOLS[sys.argv[1]](Path(sys.argv[2])) + "\n")
