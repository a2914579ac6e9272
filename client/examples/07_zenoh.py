"""The same session over Zenoh, where any number of servers may share the load.

Start a server with ``vergence serve --zenoh``; it is its own router on port 7447.
Run: ``python client/examples/07_zenoh.py --server zenoh://127.0.0.1:7447``
"""

# ruff: noqa: T201  an example prints

import argparse
import asyncio
from importlib.resources import files
from itertools import islice

import numpy as np

import vergence
from vergence_proto.datasets import open_source


async def main() -> None:
    """Step five frames on the server with the lowest load."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default="zenoh://127.0.0.1:7447")
    server = parser.parse_args().server

    room = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
    async with (
        vergence.DepthClient(server) as client,
        client.open_session(room.rig, delivery=vergence.Delivery.EVERY) as session,
    ):
        for each in islice(room, 5):
            result = await session.step(each.frame.left, each.frame.right, each.frame.pose)
            print(f"frame {result.frame_id}: median {np.nanmedian(result.depth_m):.2f} m")


if __name__ == "__main__":
    asyncio.run(main())
