"""What published stereo graphs want: the part that names and shapes do not show."""

from __future__ import annotations

from dataclasses import dataclass

SELF = "the network itself"


@dataclass(frozen=True, slots=True)
class Published:
    """A family of graphs with one contract. Names and shapes are read from the graph."""

    pixels: str  # a key of PIXELS
    factor: float  # -1: it returns the flow to the left
    licence: str  # of the code; weights may have their own
    source: str  # where the contract was read
    marks: tuple[str, ...]  # parts of file names and of tensor names that give it away
    multiple_of: int = 32
    # An initial flow: its value for each pixel of disparity, times its pixels per cell.
    flow_per_cell: float | None = None
    note: str = ""


PUBLISHED: dict[str, Published] = {
    "raft-stereo": Published(
        "0..255",
        -1.0,
        "MIT",
        "princeton-vl/RAFT-Stereo core/raft_stereo.py",
        ("raft",),
        flow_per_cell=-1.0,
        note="flow_init in cells of 1/4 or 1/8: export it as a third input for a warm start",
    ),
    "hitnet": Published(
        "0..1",
        1.0,
        "Apache-2.0",
        "ibaiGorordo/ONNX-HITNET hitnet.py",
        ("hitnet", "reference_output_disparity"),
        note="one input: 6 channels, or 2 grey ones (ETH3D)",
    ),
    "crestereo": Published(
        "0..255",
        1.0,
        "Apache-2.0",
        "ibaiGorordo/ONNX-CREStereo crestereo.py; PINTO0309 284_CREStereo",
        ("crestereo", "next_left"),
        flow_per_cell=1.0,
        note="init, combined (with half-size twins), and next (with flow_init)",
    ),
    "igev": Published(
        "0..255",
        1.0,
        "MIT",
        "gangweiX/IGEV-plusplus core/igev_stereo.py",
        ("igev",),
        note="positive, unlike RAFT-Stereo; its flow_init is not used by its forward pass",
    ),
    "acvnet": Published(
        "imagenet",
        1.0,
        "MIT",
        "ibaiGorordo/ONNX-ACVNet acvnet.py; ONNX-FastACVNet",
        ("acvnet",),
        note="also Fast-ACVNet",
    ),
    "coex": Published("imagenet", 1.0, "Apache-2.0", "ibaiGorordo/ONNX-CoEx coex.py", ("coex",)),
    "cgi-stereo": Published(
        "0..1", 1.0, "MIT", "fateshelled/cgistereo_demo demo_onnx.py", ("cgi",)
    ),
    "mobilestereonet": Published(
        "imagenet", 1.0, "Apache-2.0", "ibaiGorordo/ONNX-MobileStereoNet", ("mobilestereo",)
    ),
    "openstereo": Published(
        "imagenet",
        1.0,
        "see each network",
        "XiandaGuo/OpenStereo deploy/export.py",
        ("disp_pred", "gwcnet", "psmnet", "cfnet", "lightstereo", "fadnet"),
        note="GwcNet, PSMNet, CoEx, IGEV, CFNet, LightStereo, FADNet exported by OpenStereo",
    ),
    "liteanystereo": Published(
        "0..255", 1.0, "MIT", "TomTomTommi/LiteAnyStereo export_onnx.py", ("liteanystereo",)
    ),
    "foundationstereo": Published(
        "imagenet",
        1.0,
        "NVIDIA",
        "NVIDIA-ISAAC-ROS isaac_ros_foundationstereo_core.launch.py",
        ("foundation",),
    ),
    "ess": Published(
        "-1..1",
        1.0,
        "NVIDIA EULA",
        "NVIDIA-ISAAC-ROS/isaac_ros_dnn_stereo_depth",
        ("output_conf", "ess_"),
        note="output_conf becomes sigma; its graph needs TensorRT's plugins",
    ),
    "realtimestereo": Published(
        "imagenet", 1.0, "not stated", "nburrus/stereodemo", ("realtimestereo",)
    ),
}
