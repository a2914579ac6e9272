"""The link of one session: measured, and used for as much as it takes."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

from vergence.image_format import ImageFormat
from vergence.link_control import (
    DOWNLOADS,
    UPLOADS,
    Download,
    LimitedBy,
    LinkChoice,
    LinkController,
    Upload,
)
from vergence.link_meter import LinkMeter
from vergence.results import NotSent
from vergence_proto.v1 import depth_pb2 as pb

_USUAL_CAMERA_S = 1 / 30
_CAMERA_S = (1 / 240, 0.5)
_SUBMITS_KEPT = 16
_ENDS_KEPT = 20
_FIRST_FRAMES = 2  # unanswered, before anything is known of the link
# Frames are sent while the oldest one without an answer is younger than its usual answer time and
# this, so what a stall leaves on the way is bounded.
_PATIENCE_S = 0.05
_MBIT = 8e-6


@dataclass(frozen=True, slots=True)
class LinkRules:
    """The choices of ``open_session`` about the link."""

    images: ImageFormat
    """The format to start with, or to stay with."""
    map_step: int
    """That of the output format."""
    adapts: bool
    """Frames are paced, and what is not fixed is chosen by the link."""
    fixed_images: bool = False
    """The caller chose the format of images."""
    fixed_maps: bool = False
    """The caller chose the map_step."""


@dataclass(frozen=True, slots=True)
class LinkState:
    """What a session measured of its link, and what it chose. None: not known yet."""

    adapts: bool
    """True for ``link="auto"``: the session chooses format and pace."""
    jpeg_quality: int
    """The quality of JPEG, if images travel as JPEG."""
    scale: int
    """2: images travel at half size."""
    map_step: int
    """Every map_step-th row and column of a map travels."""
    interval_s: float
    """The least time between two frames, in seconds; frames in between are not sent."""
    limited_by: LimitedBy
    """The part that decides the rate of results."""
    up_mbit_s: float | None
    """The rate of the uplink in Mbit/s, as frames measure it."""
    down_mbit_s: float | None
    """The rate of the downlink in Mbit/s, as maps measure it; a lower bound for small maps."""
    path_round_trip_s: float | None
    """The round trip without queues, in seconds."""
    up_queue_s: float
    """The time in seconds that a frame waits in the uplink behind earlier ones."""
    down_queue_s: float
    """The same for a map in the downlink."""
    server_s: float | None
    """The time in seconds that the server is busy with one frame."""


class SessionLink:
    """Measures the link of a session, and says what to send and when."""

    def __init__(
        self, rules: LinkRules, *, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._rules = rules
        self._clock_ns = clock_ns
        self._meter = LinkMeter()
        self._controller = self._made(half_size=False)
        self._submitted_ns: deque[int] = deque(maxlen=_SUBMITS_KEPT)
        self._returned: deque[bool] = deque(maxlen=_ENDS_KEPT)
        self._due_s = 0.0
        self._half_size = False
        self._attached = False
        self.waiting: int = 0
        """Frames that were submitted and wait for an earlier one to leave."""

    @property
    def adapts(self) -> bool:
        """True if the session paces its frames."""
        return self._rules.adapts

    @property
    def images(self) -> ImageFormat:
        """The format of the next frame's images."""
        if not self._rules.adapts or self._rules.fixed_images:
            return self._rules.images
        upload = self._choice.upload
        return replace(self._rules.images, jpeg_quality=upload.jpeg_quality, scale=upload.scale)

    @property
    def map_step(self) -> int:
        """The ``map_step`` to ask for with the next frame; 0: that of the stream."""
        step = self._choice.download.map_step
        return step if self._rules.adapts and step != self._rules.map_step else 0

    def attached(self, opened: pb.StreamOpened) -> None:
        """Start with a new connection."""
        self._meter.begin()
        self._returned.clear()
        self.waiting = 0
        half_size = opened.max_frame_scale >= 2
        if half_size is not self._half_size:
            self._half_size = half_size
            self._controller = self._made(half_size=half_size)
        if self._attached:
            self._controller.lost()
        self._attached = True

    def refusal(self, unanswered: int) -> NotSent | None:
        """Return the reason not to send a live frame now; None: send it.

        ``unanswered`` is the number of frames without an answer.
        """
        now_ns = self._clock_ns()
        self._submitted_ns.append(now_ns)
        if not self._rules.adapts:
            return None
        times = self._meter.times()
        if times.answer_s is None:
            return NotSent.CREDIT if unanswered >= _FIRST_FRAMES else None
        oldest_ns = self._meter.oldest_sent_ns
        patience_s = times.answer_s + max(_PATIENCE_S, 2 * self._camera_s)
        if oldest_ns is not None and now_ns - oldest_ns > patience_s * 1e9:
            return NotSent.CREDIT
        now_s = now_ns * 1e-9
        if self.waiting or now_s < self._due_s:
            return NotSent.PACED
        self._due_s = max(self._due_s, now_s - self._camera_s) + self._choice.interval_s
        return None

    def frame_sent(self, frame_id: int, nbytes: int, *, ping_ns: int | None) -> None:
        """Record a frame whose first byte leaves now; ``ping_ns``: of the ping just before it."""
        self._meter.frame_sent(frame_id, nbytes, self._clock_ns(), ping_ns=ping_ns)

    def heard(self, response: pb.StreamDepthResponse) -> None:
        """Record a message that has arrived now."""
        arrived_ns = self._clock_ns()
        match response.WhichOneof("message"):
            case "pong":
                self._meter.ponged(response.pong, arrived_ns)
            case "disparity":
                self._meter.answered(response.disparity, response.ByteSize(), arrived_ns)
                self._returned.append(True)
                self._update(arrived_ns * 1e-9)
            case "frame_error":
                self._over(response.frame_error.frame_id)
            case "frames_dropped":
                for frame_id in response.frames_dropped.frame_ids:
                    self._over(frame_id)

    @property
    def state(self) -> LinkState:
        """What is known, and what was chosen, now."""
        times, choice, images = self._meter.times(), self._choice, self.images
        return LinkState(
            adapts=self._rules.adapts,
            jpeg_quality=images.jpeg_quality,
            scale=images.scale,
            map_step=self.map_step or self._rules.map_step,
            interval_s=choice.interval_s if self._rules.adapts else 0.0,
            limited_by=choice.limited_by,
            up_mbit_s=_mbit(times.up_bytes_s),
            down_mbit_s=_mbit(times.down_bytes_s),
            path_round_trip_s=times.path_round_trip_s,
            up_queue_s=times.up_queue_s,
            down_queue_s=times.down_queue_s,
            server_s=times.server_s,
        )

    @property
    def _choice(self) -> LinkChoice:
        return self._controller.choice

    @property
    def _camera_s(self) -> float:
        """The time between two frames of the camera."""
        submitted_ns = list(self._submitted_ns)
        if len(submitted_ns) < 4:
            return _USUAL_CAMERA_S
        gaps_ns = [b - a for a, b in pairwise(submitted_ns)]
        return min(max(median(gaps_ns) * 1e-9, _CAMERA_S[0]), _CAMERA_S[1])

    def _over(self, frame_id: int) -> None:
        self._meter.frame_over(frame_id)
        self._returned.append(False)

    def _update(self, now_s: float) -> None:
        few = len(self._returned) < _ENDS_KEPT
        share = 1.0 if few else sum(self._returned) / len(self._returned)
        self._controller.update(
            self._meter.times(), camera_s=self._camera_s, returned_share=share, now_s=now_s
        )

    def _made(self, *, half_size: bool) -> LinkController:
        rules = self._rules
        uploads = tuple(each for each in UPLOADS if half_size or each.scale == 1)
        if rules.fixed_images:
            uploads = (Upload(rules.images.jpeg_quality, rules.images.scale, 1.0),)
        downloads = DOWNLOADS
        if rules.fixed_maps:
            downloads = (Download(rules.map_step, 1.0),)
        start = next((each for each in uploads if each.jpeg_quality <= 80), uploads[0])
        return LinkController(uploads, downloads, first=start)


def _mbit(bytes_s: float | None) -> float | None:
    return None if bytes_s is None else bytes_s * _MBIT
