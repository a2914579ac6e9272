"""A live camera in two tasks: one submits frames at camera rate, the other reads results.

Run: ``python client/examples/02_live_camera.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse
import asyncio
import time
from importlib.resources import files

import numpy as np

import vergence
from vergence_proto.datasets import StereoSource, open_source


async def film(session: vergence.DepthSession, camera: StereoSource, rate_hz: float) -> None:
    """Submit frames as a camera would: submit() never waits, and drops what is too much."""
    started_s = time.monotonic()
    for index, each in enumerate(camera):
        await asyncio.sleep(started_s + index / rate_hz - time.monotonic())
        session.submit(each.frame.left, each.frame.right, each.frame.pose)
    session.end()  # the reader stops after the last answer


async def main() -> None:
    """Play the bundled sample at a camera's rate and print every result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
    parser.add_argument("--rate", type=float, default=15.0, help="frames per second")
    arguments = parser.parse_args()

    camera = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
    output = vergence.OutputFormat(confidence=True, sigma=True)
    async with (
        vergence.DepthClient(arguments.server) as client,
        client.open_session(camera.rig, output=output) as session,
    ):
        filming = asyncio.create_task(film(session, camera, arguments.rate))
        async for result in session:
            assert result.confidence is not None
            assert result.sigma_px is not None
            print(
                f"frame {result.frame_id}: median {np.nanmedian(result.depth_m):.2f} m, "
                f"confidence {np.mean(result.confidence) / 255:.2f}, "
                f"sigma {np.nanmedian(result.sigma_px):.2f} px, age {1e3 * result.age_s:.0f} ms"
            )
        await filming
        print(f"dropped: {session.drops}")


if __name__ == "__main__":
    asyncio.run(main())
