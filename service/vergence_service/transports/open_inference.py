"""Single pairs by the Open Inference Protocol v2, without its transports.

A pair is two tensors, ``left`` and ``right``, uint8 [1, H, W, 3]; the answer is ``disparity`` and
``sigma``, float32 [1, H, W]. Streams and everything that they remember stay with the protocol of
this project.
"""

from collections.abc import Mapping, Sequence
from importlib.metadata import version as installed_version

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadShape, FrameTooLarge
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Delivery, Image, OutputFormat, StereoFrame, StereoRig
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig
from vergence_service.transports.callers import CALLER

SERVER = "vergence"
MODEL_VERSION = "1"
CONFIGURATION = "model_configuration"  # an extension of Triton
INPUTS = ("left", "right")
INPUT_TYPE = "UINT8"
INPUT_SHAPE = (1, -1, -1, 3)
OUTPUTS = ("disparity", "sigma")
OUTPUT_TYPE = "FP32"
OUTPUT_SHAPE = (1, -1, -1)

Maps = Mapping[str, NDArray[np.float32]]
"""The outputs by their names, each [H, W] in pixels; a disparity of 0 is no value."""


def server_version() -> str:
    """Return the version of this server."""
    return installed_version("vergence")


def no_such_model(model: str, version: str, engine: DepthEngine) -> str | None:
    """Return what to report about a model or a version that is not served; None for the served."""
    own = engine.card.name
    if model != own:
        return f"there is no model {model[:100]!r}, only {own}"
    if version not in ("", MODEL_VERSION):
        return f"there is no version {version[:100]!r} of {own}, only {MODEL_VERSION}"
    return None


def check_inputs(names: Sequence[str]) -> None:
    """Raise BadShape unless there is one input left and one input right."""
    if sorted(names) != sorted(INPUTS):
        raise BadShape("expected one input left and one input right")


def check_shape(name: str, shape: Sequence[int], *, max_pixels: int) -> int:
    """Return the number of values in an image. Raises BadShape or FrameTooLarge."""
    if len(shape) != 4 or shape[0] != 1 or shape[3] != 3 or shape[1] < 1 or shape[2] < 1:
        raise BadShape(f"{name}: expected a shape of [1, H, W, 3], got {list(shape)}")
    _, height, width, channels = shape
    if height * width > max_pixels:
        raise FrameTooLarge(f"{name}: expected at most {max_pixels} pixels, got {width}x{height}")
    return height * width * channels


def image_of(name: str, shape: Sequence[int], values: NDArray[np.uint8]) -> Image:
    """Return the values as an image of a checked shape. Raises BadShape."""
    count = int(np.prod(shape))
    if values.size != count:
        raise BadShape(f"{name}: expected {count} values for its shape, got {values.size}")
    return values.reshape(shape[1:])


def check_pair(left: Image, right: Image) -> None:
    """Raise BadShape unless both images have the same shape."""
    if left.shape != right.shape:
        raise BadShape(f"expected two images of one shape, got {left.shape} and {right.shape}")


def bytes_of(name: str, numbers: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Return whole numbers as bytes, flat. Raises BadShape."""
    if numbers.size and (numbers.min() < 0 or numbers.max() > 255):
        raise BadShape(f"{name}: expected whole numbers from 0 to 255 in its values")
    return numbers.astype(np.uint8).ravel()


async def step_pair(engine: DepthEngine, left: Image, right: Image) -> Maps:
    """Step one rectified pair from a cold start. Raises DepthError."""
    height, width = left.shape[:2]
    rig = RectifiedRig(
        width=width,
        height=height,
        fx=float(width),  # any focal length gives the same disparity
        fy=float(width),
        cx_left=(width - 1) / 2,
        cx_right=(width - 1) / 2,
        cy=(height - 1) / 2,
        baseline_m=1.0,
    )
    config = StreamConfig(
        StereoRig.from_rectified(rig), delivery=Delivery.EVERY, output=OutputFormat(sigma=True)
    )
    frame = StereoFrame(1, 0, left, right)
    async with engine.offline(config, owner=CALLER.get().name) as stream:
        found = await engine.step_offline(stream, frame)
    assert found.sigma_px is not None
    # JSON has no NaN: 0 is no value, as in the files of KITTI.
    return {
        "disparity": np.nan_to_num(found.disparity_px, nan=0.0),
        "sigma": np.ascontiguousarray(found.sigma_px, np.float32),
    }
