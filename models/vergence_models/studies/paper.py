"""The paper's figures, to be read beside ours.

Z. Cheng, J. Yang, H. Li: Stereo Matching in Time: 100+ FPS Video Stereo Matching for Extended
Reality, WACV 2024, arXiv 2309.04183. Their networks, fully trained, on their XR-Stereo data set at
640x480, timed on an RTX 3090 Ti: nothing here can be compared with ours number by number, only in
its shape. Figures were taken from published reading notes that quote the paper's tables; what those
do not give (D1 to D5, two iterations, RAFT-Stereo at seven) is left out rather than guessed.
"""

from __future__ import annotations

from vergence_models.studies.tables import TableRow

SOURCE = (
    "Theirs: Cheng, Yang, Li, *Stereo Matching in Time*, WACV 2024 (arXiv 2309.04183), on "
    "XR-Stereo, as quoted in published notes on the paper; their data, their machine (RTX 3090 "
    "Ti), so only the shape compares."
)

MAIN = [
    TableRow("RAFT-Stereo RT, single frame, 20 iterations", {"epe": 1.70, "fps": 20}),
    TableRow("Ours, 1 iteration (Table 2)", {"epe": 1.48, "fps": 108}),
    TableRow("Ours, 5 iterations (Table 2)", {"epe": 1.42, "fps": 57}),
    TableRow("Ours-Fast, 1 iteration (Table 2)", {"epe": 1.67, "fps": 134}),
]
SPEED = [
    TableRow("with warp (Table 4)", {"1x": 1.48, "6x": 1.68}),
    TableRow("without warp (Table 4)", {"1x": 1.70, "6x": 3.18}),
]
COLD_START = [TableRow("Ours (Figure 7)", {"1": 0.86, "15": 0.29})]
NOISE_NOTE = (
    "The paper's Figure 6 varies the noise in the same steps; its values are not quoted anywhere "
    "we found. It states that ORB-SLAM3 on their headset stays within 0.3 degrees and 0.5 mm."
)
KITTI = [
    TableRow("Ours, 5 iterations, trained on KITTI", {"epe": 1.66}),
    TableRow("RAFT-Stereo RT, single frame, 20 iterations, trained on KITTI", {"epe": 1.77}),
]
