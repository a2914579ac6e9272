"""What the commands stream: data sets, two images, folders of images, and cameras."""

from collections.abc import AsyncGenerator, Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from vergence.cli.errors import CliError
from vergence_proto.calibration import load_calibration
from vergence_proto.datasets import (
    DATASETS,
    DatasetError,
    RecordedOptions,
    RecordedSource,
    SourceFrame,
    StereoSource,
    detect_sources,
    nominal_rig,
    open_image_folder,
    open_images,
    open_source,
    read_ahead,
)
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import StereoRig

CAMERA = "camera:"
_VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".xz", ".bz2")
_NAMED_AT_MOST = 12


@dataclass(frozen=True, slots=True)
class CalibrationFlags:
    """The calibration on the command line, for images that come without one."""

    file: Path | None = None
    """A file of any tool that ``vergence calib`` reads."""
    fx_px: float | None = None
    """Focal length of rectified images."""
    baseline_m: float | None = None
    """Distance of the cameras."""

    def __bool__(self) -> bool:
        return self != CalibrationFlags()

    def rig_of(self, size: tuple[int, int]) -> StereoRig | None:
        """Make the rig of images of ``size`` (width, height); None: it is not known.

        Raises CliError: the flags contradict each other or the images. Raises BadCalibration: the
        file or a number is not that of a rig.
        """
        width, height = size
        if self.file is not None:
            if self.fx_px is not None or self.baseline_m is not None:
                raise CliError("give either --calib or --fx and --baseline", exit_code=2)
            rig = load_calibration(self.file, size=size).rig
            if (rig.left.width, rig.left.height) != size:
                raise CliError(
                    f"{self.file} is for images of {rig.left.width}x{rig.left.height}, "
                    f"these are {width}x{height}",
                    exit_code=2,
                )
            return rig
        if self.fx_px is None and self.baseline_m is None:
            return None
        if self.fx_px is None or self.baseline_m is None:
            raise CliError("metres need both --fx PIXELS and --baseline METRES", exit_code=2)
        middle_x, middle_y = (width - 1) / 2, (height - 1) / 2
        return StereoRig.from_rectified(
            RectifiedRig(
                width=width,
                height=height,
                fx=self.fx_px,
                fy=self.fx_px,
                cx_left=middle_x,
                cx_right=middle_x,
                cy=middle_y,
                baseline_m=self.baseline_m,
            )
        )


@dataclass(frozen=True, slots=True, eq=False)
class Footage:
    """Frames that ``vergence run`` streams, from files or from a camera."""

    name: str
    rig: StereoRig
    fps: float | None
    """Frames per second; None for a single pair, or if it is not known."""
    count: int | None
    """The number of frames; None for a camera."""
    frames: Callable[[], AsyncGenerator[tuple[int, SourceFrame], None]]
    """Read the frames, with their index from 0. Raises DatasetError."""
    alone: bool = False
    """True for a pair that is no frame of a sequence."""
    live: bool = False
    """True if frames come when they come, and cannot wait."""
    metric: bool = True
    """False without a calibration: there is disparity, but no metres."""
    loose: bool = False
    """True for images and cameras that come without a calibration: a picture is drawn, and if the
    command line has calibrated them, depth is written."""
    notes: tuple[str, ...] = ()
    """What a user should know of these frames."""
    replay: RecordedOptions | None = None
    """The options of a recorded session, for the same results; the poses have its axes."""
    unread: dict[int, str] = field(default_factory=dict)
    """Why a file of a frame could not be read, by its index; filled while frames are read."""

    @property
    def has_depth(self) -> bool:
        """True if depth in metres is written too."""
        return self.loose and self.metric


def source_at(text: str) -> StereoSource:
    """Open ``KIND:PATH``, or the one data set in a folder.

    Raises CliError: it does not exist, is damaged, or has no frames.
    """
    try:
        source = open_source(text if _has_kind(text) else _detected(text))
    except DatasetError as error:
        raise CliError(str(error), exit_code=2) from None
    if len(source) == 0:
        raise CliError(f"{text}: no frames", exit_code=2)
    return source


def footage_at(texts: Sequence[str], flags: CalibrationFlags) -> Footage:
    """Open what the arguments of ``vergence run`` name.

    Raises CliError: it does not exist, is damaged or has no frames, or the flags do not fit it.
    """
    try:
        match texts:
            case [left, right]:
                pair = open_images(Path(left), Path(right), flags.rig_of)
                return _footage(pair, loose=True)
            case [text] if text.startswith(CAMERA):
                return _camera(text.removeprefix(CAMERA), flags)
            case [text] if not _has_kind(text) and Path(text).suffix.lower() in _VIDEOS:
                return _camera(text, flags)
            case [text]:
                if loose := _loose_images(text, flags):
                    return _footage(loose, loose=True)
                if flags:
                    raise CliError(
                        f"{text} has a calibration of its own; --calib, --fx and --baseline are "
                        "for images and cameras without one",
                        exit_code=2,
                    )
                return _footage(source_at(text))
            case _:
                raise CliError(
                    f"expected one source or two images, got {len(texts)} arguments", exit_code=2
                )
    except DatasetError as error:
        raise CliError(str(error), exit_code=2) from None


def _camera(place: str, flags: CalibrationFlags) -> Footage:
    from vergence.cli.cameras import SideBySide

    camera = SideBySide(place)
    rig = flags.rig_of(camera.size)
    return Footage(
        camera.name,
        rig or nominal_rig(Path(place), camera.size),
        camera.fps,
        camera.count,
        camera.frames,
        live=camera.live,
        metric=rig is not None,
        loose=True,
        notes=("without camera poses every frame is a cold start, and takes longer",),
    )


def _footage(source: StereoSource, *, loose: bool = False) -> Footage:
    replay = source.options if isinstance(source, RecordedSource) else None
    if isinstance(source, RecordedSource):
        source = replace(source, as_sent=True)
    unread: dict[int, str] = {}

    def skip(index: int, error: DatasetError) -> None:
        unread[index] = str(error)

    return Footage(
        source.name,
        source.rig,
        source.fps,
        len(source),
        partial(read_ahead, source, on_unreadable=skip),
        alone=source.is_single_pair,
        metric=source.metric,
        loose=loose,
        notes=source.notes,
        replay=replay,
        unread=unread,
    )


def _loose_images(text: str, flags: CalibrationFlags) -> StereoSource | None:
    """Open a folder of images, unless it is a data set with a calibration of its own."""
    folder = Path(text)
    if _has_kind(text) or not folder.is_dir() or detect_sources(folder):
        return None
    return open_image_folder(folder, flags.rig_of)


def _has_kind(text: str) -> bool:
    kind, colon, _ = text.partition(":")
    return bool(colon) and kind in DATASETS


def _detected(text: str) -> str:
    path = Path(text)
    if path.is_file():
        if path.suffix.lower() == ".mcap":
            return f"mcap:{path}"
        if path.suffix.lower() in _ARCHIVES:
            raise CliError(f"{text} is an archive: use vergence batch {text}", exit_code=2)
        raise CliError(f"{text} is one file; expected two images, LEFT and RIGHT", exit_code=2)
    if not path.is_dir():
        kinds = ", ".join(f"{kind}:PATH" for kind in DATASETS)
        raise CliError(
            f"{text!r}: no such file or folder; expected one of {kinds}, a folder in one of their "
            f"layouts, LEFT and RIGHT images, or {CAMERA}DEVICE",
            exit_code=2,
        )
    found = detect_sources(path)
    if len(found) == 1:
        return found[0]
    if not found:
        raise CliError(
            f"{text}: no data set in a known layout ({', '.join(DATASETS)}), and no folders left "
            "and right with images",
            exit_code=2,
        )
    named = ", ".join(found[:_NAMED_AT_MOST])
    more = f" and {len(found) - _NAMED_AT_MOST} more" if len(found) > _NAMED_AT_MOST else ""
    raise CliError(
        f"{text} holds {len(found)} sources; name one of them: {named}{more}", exit_code=2
    )
