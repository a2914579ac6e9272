"""What a published stereo graph expects and returns, as one value."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any, Literal

Order = Literal["rgb", "bgr", "grey"]
Layout = Literal["NCHW", "NHWC", "NHW", "HW"]
SigmaFrom = Literal["constant", "left-right", "confidence"]


class ContractError(ValueError):
    """A graph cannot be served, or is described wrongly; the message says what was seen."""


@dataclass(frozen=True, slots=True)
class Pixels:
    """The affine map from a byte, 0 to 255, to what the graph expects: (byte - mean) / std."""

    mean: tuple[float, ...]  # one number, or one per channel in the order of the graph
    std: tuple[float, ...]


PIXELS = {
    "0..255": Pixels((0.0,), (1.0,)),
    "0..1": Pixels((0.0,), (255.0,)),
    "-1..1": Pixels((127.5,), (127.5,)),
    "imagenet": Pixels((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
}


@dataclass(frozen=True, slots=True)
class WarmStart:
    """An input for the disparity that the graph refines, such as ``flow_init``."""

    input: str
    channels: int  # 2: (x, y) of a flow; 1: a disparity
    scale: int  # pixels of the image per cell of the input
    factor: float  # value of the input for each pixel of disparity at the graph's width
    used: bool = True  # False: the input is always zero, and the model has no memory


@dataclass(frozen=True, slots=True)
class Contract:
    """The five differences between published stereo graphs, and an initial flow if there is one."""

    left: str  # input of the left image; of both, if ``right`` is empty
    right: str
    left_half: str = ""  # inputs of the same images at half the size
    right_half: str = ""
    channels_last: bool = False
    dtype: Literal["float32", "float16", "uint8"] = "float32"  # of the images
    swapped: bool = False  # the input called ``left`` takes the right image
    order: Order = "rgb"
    pixels: str = "0..255"  # a key of PIXELS
    size: tuple[int, int] | None = None  # [H, W], if the graph has a fixed one
    multiple_of: int = 32  # otherwise, sizes are multiples of this
    output: str = ""
    output_layout: Layout = "NCHW"
    output_dtype: str = "float32"  # numpy's name
    output_channel: int = 0
    output_scale: float = 1.0  # width of the output by that of the input
    factor: float = 1.0  # disparity in pixels at the graph's width, for each unit of the output
    of_depth: bool = False  # the output is a depth: disparity is the factor divided by it
    of_width: bool = False  # the factor counts widths of the image; only if it has any size
    max_disparity_px: int = 192
    sigma: SigmaFrom = "constant"
    sigma_px: float = 1.0  # the constant; with "left-right", the least sigma
    confidence: str = ""  # output with a probability, in the layout of its own
    confidence_layout: Layout = "NCHW"
    warm_start: WarmStart | None = None

    @property
    def channels(self) -> int:
        """Channels of one image."""
        return 1 if self.order == "grey" else 3

    @property
    def stride(self) -> int:
        """Sizes of steps are multiples of this number."""
        if self.size is None:
            return self.multiple_of
        return self.warm_start.scale if self.recurrent and self.warm_start else 1

    @property
    def recurrent(self) -> bool:
        """True if a step starts from the disparity of the one before."""
        return self.warm_start is not None and self.warm_start.used

    @property
    def factor_words(self) -> str:
        each = f"{self.factor:g}{' x the width of the image' if self.of_width else ''}"
        return f"{each}, divided by the output, a depth" if self.of_depth else each

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Contract:
        """Read what :meth:`to_json` wrote. Raises TypeError."""
        size, warm = values["size"], values["warm_start"]
        return replace(
            cls(**values),
            size=tuple(size) if size else None,
            warm_start=WarmStart(**warm) if warm else None,
        )

    def words(self) -> list[tuple[str, str]]:
        """Each property and its value, for people."""
        images = f"{self.left} and {self.right}" if self.right else f"both in {self.left}"
        if self.left_half:
            images += f", at half size {self.left_half} and {self.right_half}"
        if self.swapped:
            images += ", the right image first"
        size = "{1}x{0}".format(*self.size) if self.size else f"multiples of {self.multiple_of}"
        channel = f", channel {self.output_channel}" if self.output_channel else ""
        output = f"{self.output} ({self.output_layout}{channel})"
        sigma = {
            "constant": f"{self.sigma_px:g} px everywhere; the graph says none",
            "left-right": "from a second run on mirrored images, at twice the time",
            "confidence": f"from {self.confidence}",
        }[self.sigma]
        rows = [
            ("images", images),
            ("pixels", f"{self.pixels}, {self.order}{', NHWC' if self.channels_last else ''}"),
            ("size", size),
            ("output", output),
            ("factor", self.factor_words),
            ("range", f"{self.max_disparity_px} px"),
            ("sigma", sigma),
        ]
        if self.warm_start:
            warm = self.warm_start
            about = f"{warm.input}, 1/{warm.scale} of the size, {warm.factor:g} for each px"
            rows.append(("warm start", about if warm.used else f"no: {warm.input} is zero"))
        return rows
