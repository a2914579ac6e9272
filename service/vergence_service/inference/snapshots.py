"""Recurrent states as bytes, without loss: stepping from a restored state gives the same bits."""

import dataclasses
import io
import json
import zipfile
import zlib

import numpy as np

from vergence_proto.geometry import Pose, RectifiedRig
from vergence_service.inference.model import RecurrentState
from vergence_service.inference.tensors import on_host

_ABOUT = "about"


class BadSnapshot(ValueError):
    """The bytes do not contain one complete state."""


def state_to_bytes(state: RecurrentState) -> bytes:
    """Write an NPZ with the tensors, named by their index, and a JSON document with the rest."""
    pose = state.world_from_left
    about = {
        "rig": dataclasses.asdict(state.rig),
        "capture_ns": state.capture_ns,
        "world_from_left": None if pose is None else pose.matrix.tolist(),
        "position_known": state.position_known,
        "step_count": state.step_count,
    }
    arrays = {str(index): on_host(tensor) for index, tensor in enumerate(state.tensors)}
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{_ABOUT: np.array(json.dumps(about))}, **arrays)
    return file.getvalue()


def state_from_bytes(data: bytes) -> RecurrentState:
    """Read a state. Raises BadSnapshot if the bytes do not contain one complete state."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            about = json.loads(str(arrays[_ABOUT]))
            tensors = tuple(arrays[str(index)] for index in range(len(arrays) - 1))
        pose = about.pop("world_from_left")
        return RecurrentState(
            tensors=tensors,
            rig=RectifiedRig(**about.pop("rig")),
            world_from_left=None if pose is None else Pose.from_matrix(np.array(pose)),
            **about,
        )
    except (
        OSError,
        EOFError,
        KeyError,
        TypeError,
        ValueError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise BadSnapshot(f"expected a recurrent state: {error}") from None
