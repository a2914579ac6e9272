"""Films that browsers play: H.264 in MP4, or VP9 where PyAV has no encoder of H.264."""

from collections.abc import Collection, Mapping
from fractions import Fraction
from pathlib import Path
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Self, cast

import numpy as np
from numpy.typing import NDArray

from vergence_proto.extras import how_to_install

if TYPE_CHECKING:  # an optional package
    from av.container import OutputContainer
    from av.video.stream import VideoStream

# In order of preference, with options that keep thin lines and text sharp.
_ENCODERS: Mapping[str, dict[str, str]] = {
    "libx264": {"crf": "18", "preset": "veryfast"},
    "libvpx-vp9": {"crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "8"},
}


class CannotFilm(OSError):
    """No film can be written: PyAV or its encoders are missing, or the file cannot be made."""


class FilmWriter:
    """A film that is open for writing; the end of its ``with`` block completes the file.

    Parameters
    ----------
    path
        The file, whose name ends in .mp4.
    fps
        Frames per second.

    Raises
    ------
    CannotFilm
        PyAV is not installed or has none of the encoders, or the file cannot be written.
    """

    def __init__(self, path: Path, *, fps: float) -> None:
        av = _pyav()
        self._fps = Fraction(fps).limit_denominator(1001)
        self._encoder = _encoder(av.codecs_available)
        self._stream: VideoStream | None = None
        try:
            path.open("wb").close()  # PyAV itself would open it with the first frame
        except OSError as error:
            raise CannotFilm(f"cannot write the video {path}: {error.strerror}") from None
        # faststart: a browser can play the film before all of it has arrived.
        self._film: OutputContainer = av.open(str(path), "w", options={"movflags": "faststart"})
        self._new_frame = av.VideoFrame.from_ndarray

    def __enter__(self) -> Self:
        """Return the film."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Complete the file, also after an error."""
        with self._film:
            if self._stream is not None:
                self._film.mux(self._stream.encode(None))

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Append a picture: uint8 [H, W, 3], RGB, each of the first one's size.

        Films have an even width and height, so an odd last row or column is left out.
        """
        height, width = (side - side % 2 for side in picture.shape[:2])
        if self._stream is None:
            self._stream = self._started(width, height)
        even = np.ascontiguousarray(picture[:height, :width])
        self._film.mux(self._stream.encode(self._new_frame(even, format="rgb24")))

    def _started(self, width: int, height: int) -> "VideoStream":
        stream = cast(
            "VideoStream",
            self._film.add_stream(self._encoder, rate=self._fps, options=_ENCODERS[self._encoder]),
        )
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p"  # the only one that every browser decodes
        # The caller's thread does the work, with its priority.
        stream.codec_context.thread_count = 1
        return stream


def _pyav() -> ModuleType:
    try:
        import av
    except ImportError:
        raise CannotFilm(
            f"videos need PyAV, which is not installed: {how_to_install('cli')}"
        ) from None
    return av


def _encoder(known: Collection[str]) -> str:
    for name in _ENCODERS:
        if name in known:
            return name
    raise CannotFilm(f"this build of PyAV has none of the encoders {', '.join(_ENCODERS)}")
