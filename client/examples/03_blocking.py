"""A lossless sequence without asyncio: every step waits for its result.

Run: ``python client/examples/03_blocking.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse
from importlib.resources import files
from itertools import islice

import numpy as np

import vergence
from vergence_proto.datasets import open_source


def main() -> None:
    """Step ten frames of the bundled sample and print their depth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
    server = parser.parse_args().server

    room = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
    with (
        vergence.BlockingClient(server) as client,
        client.open_session(room.rig, delivery=vergence.Delivery.EVERY) as session,
    ):
        print(f"model {session.model.name} of {client.server_info().version}")
        for each in islice(room, 10):
            frame = each.frame
            result = session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
            print(
                f"frame {result.frame_id}: median {np.nanmedian(result.depth_m):.2f} m, "
                f"{result.origin.value}, model {1e3 * result.timings.model_s:.0f} ms"
            )


if __name__ == "__main__":
    main()
