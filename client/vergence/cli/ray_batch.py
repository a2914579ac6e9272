"""``vergence batch --ray``: the sequences of one command on the machines of a Ray cluster.

Each sequence is one row of a Ray Data pipeline. Each actor of its pool runs a server of its own, as
``vergence batch`` does without ``--server``, and writes the result. So the results are those of one
machine. Ray runs the sequences of an actor that is lost again, on another one.
"""

import io
import os
import pickle
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from vergence.cli.batch import LARGEST_PIXELS, Outcome, Query, send_all
from vergence.cli.errors import CliError
from vergence.cli.local_server import local_server
from vergence.cli.uploads import NamedUpload
from vergence.loop_thread import LoopThread
from vergence_proto.extras import how_to_install

LOCAL = "local"
_CORES = 2  # of one actor


class SequenceActor:
    """One process of the cluster, with a server of its own."""

    def __init__(self) -> None:
        os.environ.setdefault("VERGENCE_MODEL__THREADS", str(_CORES))
        self._loop = LoopThread()
        self._loop.start()
        self._open = AsyncExitStack()  # the server ends with this process
        self._address = self._loop.wait(
            self._open.enter_async_context(local_server(scheme="http", pixels=LARGEST_PIXELS))
        )

    def __call__(self, row: dict[str, Any]) -> dict[str, bytes]:
        """Make the result of one row: ``task`` is the pickled upload and its options."""
        upload, out, form, query = pickle.loads(row["task"])
        quiet = Console(file=io.StringIO())
        work = send_all([upload], self._address, out, form, query, quiet)
        [outcome], _ = self._loop.wait(work)
        return {"outcome": pickle.dumps(outcome)}


def batch_on_ray(
    address: str, uploads: Sequence[NamedUpload], out: Path, form: str, query: Query
) -> tuple[list[Outcome], float]:
    """Make the results of all uploads; return their outcomes, and the time in seconds.

    ``address``: of the cluster; ``local``: this machine. Every machine of the cluster must see the
    sequences and ``out`` under the same paths.

    Raises CliError: Ray is not installed.
    """
    try:
        import ray
        import ray.data
    except ImportError:
        raise CliError(f"Ray is not installed; install it: {how_to_install('ray')}") from None
    started_s = time.monotonic()
    ray.init(address=None if address == LOCAL else address, ignore_reinit_error=True)
    cores = int(ray.cluster_resources().get("CPU", 1))
    rows = [
        {"task": pickle.dumps((_absolute(upload), out.absolute(), form, query))}
        for upload in uploads
    ]
    # One row a block, so that every actor takes one sequence at a time.
    made = ray.data.from_items(rows, override_num_blocks=len(rows)).map(
        SequenceActor,
        compute=ray.data.ActorPoolStrategy(size=max(1, min(len(rows), cores // _CORES))),
        num_cpus=min(_CORES, cores),
    )
    outcomes = [pickle.loads(row["outcome"]) for row in made.take_all()]
    order = {upload.name: index for index, upload in enumerate(uploads)}
    outcomes.sort(key=lambda outcome: order[outcome.name])
    return outcomes, time.monotonic() - started_s


def _absolute(upload: NamedUpload) -> NamedUpload:
    return replace(upload, upload=replace(upload.upload, path=upload.upload.path.absolute()))
