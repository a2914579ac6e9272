"""Depth of one pair, in one call.

Run: ``python client/examples/01_one_pair.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse
from importlib.resources import files

import numpy as np

import vergence
from vergence_proto.datasets import open_source


def main() -> None:
    """Send the first pair of the bundled sample and print its median depth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
    server = parser.parse_args().server

    room = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
    pair = next(iter(room)).frame
    # Of your own cameras: uint8 images [H, W, 3] in RGB, and the calibration as a rig.
    # rig = vergence.RectifiedRig(width=640, height=480, fx=400, fy=400,
    #                             cx_left=319.5, cx_right=319.5, cy=239.5, baseline_m=0.1)
    result = vergence.depth(pair.left, pair.right, room.rig, server=server)

    depth_m = result.depth_m  # float32 [H, W], metres, NaN where there is no value
    print(f"depth {depth_m.shape}, median {np.nanmedian(depth_m):.2f} m")


if __name__ == "__main__":
    main()
