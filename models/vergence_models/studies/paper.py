"""The paper's figures, to be read beside ours.

Z. Cheng, J. Yang, H. Li: Stereo Matching in Time: 100+ FPS Video Stereo Matching for Extended
Reality, WACV 2024, arXiv 2309.04183. Their networks, fully trained, on their XR-Stereo data set at
640x480, timed on an RTX 3090 Ti: nothing here can be compared with ours number by number, only in
its shape. The figures are those of its tables, and the points of its plots.
"""

from __future__ import annotations

from collections.abc import Mapping

from vergence_models.studies.tables import Curve, TableRow

SOURCE = (
    "Theirs: Cheng, Yang, Li, *Stereo Matching in Time*, WACV 2024 (arXiv 2309.04183), on "
    "XR-Stereo; their data, their machine (RTX 3090 Ti), so only the shape compares."
)


def _row(label: str, *figures: float) -> TableRow:
    return TableRow(label, dict(zip(("epe", "d1", "d3", "d5", "fps"), figures, strict=True)))


MAIN = [
    _row("HITNet, pre-trained", 4.51, 36.4, 24.1, 11.34, 19.48),
    _row("GA-Net-deep", 2.11, 22.56, 11.05, 8.46, 1.24),
    _row("GwcNet", 1.87, 20.45, 10.01, 7.99, 8.10),
    _row("PCW-Net", 1.77, 19.43, 9.96, 7.84, 6.53),
    _row("ACVNet", 1.69, 19.31, 8.94, 6.57, 13.89),
    _row("RAFT-Stereo RT, single frame, 7 iterations", 1.93, 20.93, 9.85, 7.03, 49.83),
    _row("RAFT-Stereo RT, single frame, 20 iterations", 1.70, 18.18, 8.37, 6.03, 19.97),
    _row("DeepVideoMVS", 2.20, 20.2, 9.52, 7.10, 13.22),
    _row("Ours-Fast", 1.67, 19.40, 8.86, 6.25, 134.05),
    _row("Ours, 1 iteration", 1.48, 18.64, 8.55, 5.95, 108.09),
    _row("Ours, 2 iterations", 1.44, 16.80, 7.89, 5.50, 90.97),
    _row("Ours, 5 iterations", 1.42, 16.31, 7.69, 5.36, 57.46),
]
WARP = [
    TableRow("with warp", {"1x": 1.48, "6x": 1.68}),
    TableRow("without warp", {"1x": 1.70, "6x": 3.18}),
]


def _kitti(label: str, *figures: float) -> TableRow:
    keys = ("epe", "d1", "d3", "d5", "p99", "p97", "p95")
    return TableRow(label, dict(zip(keys, figures, strict=True)))


KITTI = [
    _kitti("RAFT-Stereo RT, 7 iterations", 1.82, 26.47, 10.26, 6.71, 26.93, 13.69, 8.27),
    _kitti("RAFT-Stereo RT, 20 iterations", 1.77, 25.76, 9.79, 6.39, 27.01, 13.30, 7.85),
    _kitti("Ours-Fast", 1.91, 30.58, 11.92, 7.51, 25.15, 13.55, 8.64),
    _kitti("Ours, 1 iteration", 1.84, 30.33, 11.14, 6.93, 24.87, 12.82, 7.94),
    _kitti("Ours, 2 iterations", 1.72, 26.71, 10.11, 6.47, 24.71, 12.59, 7.55),
    _kitti("Ours, 5 iterations", 1.66, 24.52, 9.57, 6.22, 24.87, 12.40, 7.32),
]

_OURS_BY_SPEED = {
    **{1: 1.480, 2: 1.475, 3: 1.531, 4: 1.625, 6: 1.681, 8: 1.722, 10: 1.810},
    **{13: 1.884, 16: 1.974, 20: 2.075},
}
_FAST_BY_SPEED = {
    **{1: 1.670, 2: 1.756, 3: 2.133, 4: 2.660, 6: 3.487, 8: 4.172, 10: 5.192},
    **{13: 5.748, 16: 6.212, 20: 6.746, 25: 7.430, 30: 7.392, 40: 7.326},
}
# From level 0 to level 10, each 0.3 degrees and 1 mm more.
_BY_NOISE = (1.470, 1.511, 1.518, 1.609, 1.696, 1.783, 1.884, 1.981, 2.089, 2.196, 2.302)
# From frame 1 to frame 30.
_BY_FRAME = (
    *(0.861, 0.582, 0.495, 0.510, 0.465, 0.459, 0.433, 0.408, 0.390, 0.376),
    *(0.362, 0.356, 0.341, 0.316, 0.298, 0.286, 0.295, 0.288, 0.291, 0.292),
    *(0.288, 0.291, 0.287, 0.279, 0.273, 0.269, 0.283, 0.289, 0.291, 0.297),
)
# (milliseconds, EPE); of Ours from 1 to 5 iterations.
_FAST_BY_TIME = ((7.46, 1.67),)
_OURS_BY_TIME = ((9.25, 1.480), (10.99, 1.436), (13.35, 1.428), (15.44, 1.409), (17.40, 1.420))
_RAFT_BY_TIME = (
    *((8.08, 3.376), (10.25, 2.741), (12.2, 2.438), (16.12, 2.097)),
    *((20.08, 1.926), (26.31, 1.807), (36.9, 1.729), (50.1, 1.704)),
)


def _curve(label: str, points: Mapping[int, float]) -> Curve:
    return Curve(label, [float(x) for x in points], [*points.values()])


def _timed(label: str, points: tuple[tuple[float, float], ...]) -> Curve:
    return Curve(label, [ms for ms, _ in points], [epe for _, epe in points])


CURVES: Mapping[str, list[Curve]] = {
    "speed": [_curve("Ours", _OURS_BY_SPEED), _curve("Ours-Fast", _FAST_BY_SPEED)],
    "noise": [_curve("Ours", dict(enumerate(_BY_NOISE)))],
    "cold": [_curve("Ours", dict(enumerate(_BY_FRAME, start=1)))],
    "runtime": [
        _timed("Ours, 1 to 5 iterations", _OURS_BY_TIME),
        _timed("Ours-Fast", _FAST_BY_TIME),
        _timed("RAFT-Stereo RT", _RAFT_BY_TIME),
    ],
}
"""The paper's plots, by the name of our study."""


def _shared(curve: Curve, columns: tuple[int, ...], unit: str) -> TableRow:
    by_x = dict(zip(curve.x, curve.epe, strict=True))
    return TableRow(curve.label, {f"{x}{unit}": by_x[x] for x in columns})


SPEED = [_shared(curve, (1, 2, 6, 10, 20), "x") for curve in CURVES["speed"]]
NOISE = [_shared(curve, (*range(11),), "") for curve in CURVES["noise"]]
COLD_START = [_shared(curve, (1, 2, 3, 5, 10, 15, 30), "") for curve in CURVES["cold"]]
