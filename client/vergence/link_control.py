"""The choice of a live session's format and pace by what its link takes.

Sources of the rules:

- NeSt-VR (arXiv:2407.15614, 2502.14947): stay below 0.9 of the capacity measured; one step down
  when too few frames return or they return late, one step up only after a calm time.
- Google Congestion Control (draft-ietf-rmcat-gcc-02): a queue that grows is the first sign of a
  link that takes less; the rate is then multiplied by 0.85, and grows again by 8 % a second.
- BBR (draft-ietf-ccwg-bbr): what is sent is paced by the bottleneck, so that no queue forms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vergence.link_meter import LinkTimes

LimitedBy = Literal["camera", "uplink", "downlink", "server"]


@dataclass(frozen=True, slots=True)
class Upload:
    """One rung of the ladder of uploads: the quality of JPEG, and 2 for images of half size."""

    jpeg_quality: int
    scale: int
    relative_bytes: float
    share: float = 1.0
    """Share of the limit on time that it may take."""
    climb: float = 0.8
    """It is chosen again if it takes less than this share of its limit."""


@dataclass(frozen=True, slots=True)
class Download:
    """One rung of the ladder of downloads: every ``map_step``-th row and column."""

    map_step: int
    relative_bytes: float
    climb: float = 0.8


# Best first. The bytes are those of a grey pair of 640x480, in kB; only their ratios matter. Half
# size is better bought than quality below 50: at 18 kB its error is 0.69 px, that of JPEG 15 1.0.
# JPEG 90 hardly helps, so it is for links on which it costs nothing.
UPLOADS: tuple[Upload, ...] = (
    Upload(90, 1, 93.0, share=0.4, climb=0.4),
    Upload(80, 1, 64.7),
    Upload(70, 1, 52.7),
    Upload(50, 1, 39.4),
    Upload(90, 2, 32.1),
    Upload(70, 2, 18.3),
    Upload(50, 2, 14.0),
)
DOWNLOADS: tuple[Download, ...] = (Download(2, 28.0), Download(4, 10.0))

# Most time on each way, in seconds. It adds to the age of every result.
_UP_S, _DOWN_S = 0.024, 0.016
# Most time on each way as a share of the time between two frames of the camera.
_SHARE = 0.85
# A rung is left above this share of its limit, and chosen again below its ``climb``. The gap
# between them is wider than the noise of the measurement, so that a steady link has a steady rung.
_LEAVE = 1.15
_CALM_S = 1.0
_FRAMES_NEEDED = 3
# Google Congestion Control: overuse is a queue above its threshold that grows.
_OVERUSE_S = 0.0125
_OVERUSE_GROWTH = 0.05
_DECREASE, _INCREASE_PER_S, _LEAST_HEADROOM = 0.85, 0.08, 0.5
_DECREASE_EVERY_S = 0.3
_RETURNED_SHARE = 0.9


@dataclass(frozen=True, slots=True)
class LinkChoice:
    """What the controller chose."""

    upload: Upload
    download: Download
    interval_s: float
    """Least time between two frames: what the slowest part of the way needs for one."""
    limited_by: LimitedBy


class LinkController:
    """Chooses the rungs and the pace. It has no clock, and reads nothing but its arguments.

    ``uploads`` and ``downloads`` are the rungs that it may choose, best first.
    """

    def __init__(
        self,
        uploads: tuple[Upload, ...] = UPLOADS,
        downloads: tuple[Download, ...] = DOWNLOADS,
        *,
        first: Upload | None = None,
    ) -> None:
        self._uploads = uploads
        self._downloads = downloads
        self._up = uploads.index(first) if first in uploads else 0
        self._down = 0
        self._headroom = 1.0
        self._calm_since_s: float | None = None
        self._updated_s: float | None = None
        self._decreased_s: float | None = None
        self._fresh = True  # the first measurement of a connection may choose any rung
        self.choice: LinkChoice = self._chosen(0.0, "camera")

    @property
    def headroom(self) -> float:
        """Return the share of the measured rates that is used, 0.5 to 1."""
        return self._headroom

    def lost(self) -> None:
        """Start low, because the connection is a new one; its first measurement may climb."""
        self._up, self._down = len(self._uploads) - 1, len(self._downloads) - 1
        self._headroom, self._fresh = 1.0, True
        self._calm_since_s = self._updated_s = self._decreased_s = None
        self.choice = self._chosen(0.0, "camera")

    def update(
        self, times: LinkTimes, *, camera_s: float, returned_share: float, now_s: float
    ) -> LinkChoice:
        """Choose again after an answer.

        ``camera_s`` is the time between two frames of the camera. ``returned_share`` is the share
        of the latest frames sent that became a result.
        """
        if times.frames < _FRAMES_NEEDED or not times.up_bytes_s or not times.down_bytes_s:
            return self.choice
        self._update_headroom(times, returned_share, now_s)
        up_rate, down_rate = (
            rate * self._headroom for rate in (times.up_bytes_s, times.down_bytes_s)
        )
        up_kb = times.frame_bytes / self.choice.upload.relative_bytes
        down_kb = times.map_bytes / self.choice.download.relative_bytes
        ups_s = [each.relative_bytes * up_kb / up_rate for each in self._uploads]
        downs_s = [each.relative_bytes * down_kb / down_rate for each in self._downloads]
        up_limit_s = min(_SHARE * camera_s, _UP_S)
        down_limit_s = min(_SHARE * camera_s, _DOWN_S)
        up_limits_s = [each.share * up_limit_s for each in self._uploads]
        down_limits_s = [down_limit_s] * len(self._downloads)
        calm = self._is_calm(now_s)
        up = _next_rung(self._up, ups_s, up_limits_s, self._uploads, calm=calm, fresh=self._fresh)
        down = _next_rung(
            self._down, downs_s, down_limits_s, self._downloads, calm=calm, fresh=self._fresh
        )
        if (up, down) != (self._up, self._down):
            self._calm_since_s = now_s
        self._up, self._down, self._fresh = up, down, False
        parts: dict[LimitedBy, float] = {
            "uplink": ups_s[up],
            "downlink": downs_s[down],
            "server": times.server_s or 0.0,
        }
        slowest = max(parts, key=lambda part: parts[part])
        interval_s = parts[slowest]
        self.choice = self._chosen(interval_s, slowest if interval_s > camera_s else "camera")
        return self.choice

    def _chosen(self, interval_s: float, limited_by: LimitedBy) -> LinkChoice:
        upload, download = self._uploads[self._up], self._downloads[self._down]
        return LinkChoice(upload, download, interval_s, limited_by)

    def _is_calm(self, now_s: float) -> bool:
        if self._calm_since_s is None:
            self._calm_since_s = now_s
        return now_s - self._calm_since_s >= _CALM_S

    def _update_headroom(self, times: LinkTimes, returned_share: float, now_s: float) -> None:
        elapsed_s = now_s - (self._updated_s if self._updated_s is not None else now_s)
        self._updated_s = now_s
        overused = times.up_queue_s > _OVERUSE_S and times.up_queue_growth > _OVERUSE_GROWTH
        if overused or returned_share < _RETURNED_SHARE:
            self._calm_since_s = now_s
            since_s = now_s - (self._decreased_s if self._decreased_s is not None else -1e9)
            if since_s >= _DECREASE_EVERY_S:
                self._decreased_s = now_s
                self._headroom = max(self._headroom * _DECREASE, _LEAST_HEADROOM)
        else:
            self._headroom = min(self._headroom * (1 + _INCREASE_PER_S * elapsed_s), 1.0)


def _next_rung(
    now: int,
    times_s: list[float],
    limits_s: list[float],
    rungs: Sequence[Upload | Download],
    *,
    calm: bool,
    fresh: bool,
) -> int:
    """Return the next rung: down as far as it must, up by one at a time."""
    fitting = (rung for rung, time_s in enumerate(times_s) if time_s <= limits_s[rung])
    best = next(fitting, len(times_s) - 1)
    if fresh or times_s[now] > _LEAVE * limits_s[now]:
        return best
    if calm and now > 0 and times_s[now - 1] <= rungs[now - 1].climb * limits_s[now - 1]:
        return now - 1
    return now
