"""``vergence batch --ray`` on a cluster of two nodes, one of whose actors is killed.

``python -m`` this module, with the folder of sequences and the one of results.
"""

import os
import signal
import sys
import threading
from pathlib import Path

from vergence.cli.batch import Query
from vergence.cli.ray_batch import batch_on_ray
from vergence.cli.uploads import find_uploads

_BEFORE = 3  # results that are there before the actor is killed


def _kill_an_actor(out: Path, done: threading.Event) -> None:
    while not done.wait(0.1):
        if len(list(out.glob("*/manifest.json"))) < _BEFORE:
            continue
        for process in Path("/proc").glob("[0-9]*"):
            try:
                command = (process / "cmdline").read_bytes()
            except OSError:  # it has ended
                continue
            if command.startswith(b"ray::MapWorker"):
                os.kill(int(process.name), signal.SIGKILL)
                print("killed", flush=True)  # noqa: T201  the parent reads it
                return


def main() -> None:
    import ray
    from ray.cluster_utils import Cluster

    sequences, out = map(Path, sys.argv[1:])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2})
    cluster.add_node(num_cpus=2)
    done = threading.Event()
    killer = threading.Thread(target=_kill_an_actor, args=(out, done))
    killer.start()
    query: Query = {"output": ["disparity"], "iterations": 0, "quality": "fast", "on_error": "skip"}
    outcomes, _ = batch_on_ray(cluster.address, find_uploads([sequences]), out, "png16", query)
    done.set()
    killer.join()
    print("errors", [each.error for each in outcomes if each.error], flush=True)  # noqa: T201
    ray.shutdown()
    cluster.shutdown()


if __name__ == "__main__":
    main()
