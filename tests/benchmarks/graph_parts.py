"""Compare a step of full or fast as one graph with its parts, run one after another.

    python tests/benchmarks/graph_parts.py --model fast --json FILE

Images are 640x480, the batch is 1, and the weights are new (times do not depend on them). The
methods take turns, so that a busy moment of the machine hits all of them. Times are medians in
milliseconds. The bytes are those of one graph per count, with and without weights in a file of
their own.
"""

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from vergence_models.config import RaftNetworkConfig, StepKind, load_config
from vergence_models.export import exported_parts
from vergence_models.networks.raft.network import RaftNetwork
from vergence_models.onnx_export.stitch import (
    TAKES_PLACE,
    StepParts,
    stitched,
    write_with_shared_weights,
)
from vergence_proto.instruction_set import instruction_set
from vergence_proto.model_io import LEFT, RIGHT, UVD_CURR_FROM_PREV

HEIGHT, WIDTH = 480, 640
COUNTS = (1, 2, 5, 7, 20)
MEASURED = (1, 5)
Feed = dict[str, NDArray[np.generic]]


def session_of(graph: Path | bytes, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


def in_turn(sessions: StepParts[onnxruntime.InferenceSession], feed: Feed, count: int) -> None:
    """Run a step part by part: the outputs of a part are inputs of the parts after it."""
    tensors = dict(feed)
    for session in (*sessions.begin, *([sessions.iterate] * count), sessions.end):
        given = {entry.name: tensors[entry.name] for entry in session.get_inputs()}
        names = [entry.name.removeprefix(TAKES_PLACE) for entry in session.get_outputs()]
        tensors |= zip(names, session.run(None, given), strict=True)


def measure(methods: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    times: dict[str, list[float]] = {name: [] for name in methods}
    for turn in range(rounds + 1):
        for name, run in methods.items():
            start = time.perf_counter()
            run()
            if turn:  # the first turn warms up
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: round(float(np.median(values)), 1) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--model", choices=["full", "fast"], default="fast")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=8)
    given = parser.parse_args()
    for chatty in ("torch.onnx", "onnxscript", "onnx_ir"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    config = load_config(given.model).network
    assert isinstance(config, RaftNetworkConfig)
    network = RaftNetwork(config).eval()
    parts = exported_parts(network)
    with TemporaryDirectory() as folder:
        out = Path(folder)
        paths = {count: out / f"step_{count}.onnx" for count in COUNTS}
        models = {path: stitched(parts, StepKind(count)) for count, path in paths.items()}
        whole = sum(model.ByteSize() for model in models.values())
        write_with_shared_weights(models, out / "weights")
        shared = sum(path.stat().st_size for path in (*paths.values(), out / "weights"))
        begin, *rest = (
            session_of(part.SerializeToString(), given.threads)
            for part in (*parts.begin, parts.iterate, parts.end)
        )
        sessions = StepParts((begin,), *rest)
        fused = {count: session_of(paths[count], given.threads) for count in MEASURED}
        images = np.random.default_rng(0).integers(0, 256, (2, 1, HEIGHT, WIDTH, 3), np.uint8)
        feed: Feed = {
            LEFT: images[0],
            RIGHT: images[1],
            UVD_CURR_FROM_PREV: np.eye(4, dtype=np.float32)[None],
        }
        state = network.cold_state(1, HEIGHT, WIDTH)
        for tensor, value in zip(network.state_tensors, state, strict=True):
            feed[tensor.input_name] = value.numpy()
        methods: dict[str, Callable[[], object]] = {}
        for count in MEASURED:
            methods[f"fused_{count}_ms"] = partial(fused[count].run, None, feed)
            methods[f"in_turn_{count}_ms"] = partial(in_turn, sessions, feed, count)
        results = measure(methods, given.rounds)
    results |= {"embedded_mb": round(whole / 1e6, 1), "shared_mb": round(shared / 1e6, 1)}
    row = {"isa": instruction_set(), "model": given.model, **results}
    sys.stdout.write(" ".join(f"{name} {value}" for name, value in row.items()) + "\n")
    if given.json:
        given.json.write_text(json.dumps(row) + "\n", "utf-8")


if __name__ == "__main__":
    main()
