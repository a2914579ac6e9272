"""``python -m vergence_models.export``: one ONNX graph per iteration count, and the manifest.

The graphs hold the same weights, those of large networks in one file beside them. Each is checked
against PyTorch over a short sequence before it is written down in the manifest.

``--sigma`` writes only what ``train_sigma`` trained into the graphs that are there already: their
disparity keeps its bits.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import logging
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import ModelProto
from rich.progress import Progress

from vergence_models.config import Config, ConfigError, StepKind, load_config
from vergence_models.data.pool import ClipPool
from vergence_models.evaluation.stepping import OnnxNetwork, StepInputs, SteppedNetwork
from vergence_models.networks.base import AnyNetwork, StepOutput
from vergence_models.networks.lite.network import LiteNetwork
from vergence_models.networks.raft.network import RaftNetwork
from vergence_models.onnx_export.calibrate import make_int8
from vergence_models.onnx_export.lite_parts import parts_of as lite_parts_of
from vergence_models.onnx_export.lite_parts import sigma_part
from vergence_models.onnx_export.modules import GraphPart, export_part, folded
from vergence_models.onnx_export.raft_parts import parts_of as raft_parts_of
from vergence_models.onnx_export.stages import handed_on, in_stages
from vergence_models.onnx_export.stitch import (
    RefinementAt2x,
    StepParts,
    stitched,
    with_sigma,
    write_with_shared_weights,
)
from vergence_models.progress import no_progress, progress_bar, silent
from vergence_models.training.runs import Run, RunError, read_run, trained_network
from vergence_proto.model_io import (
    MANIFEST_FORMAT,
    MANIFEST_NAME,
    ManifestError,
    load_model_card,
)

log = logging.getLogger("vergence_models.export")

# PyTorch and onnxruntime sum in different orders. Where two hypotheses are equally good that can
# tip the choice, so a pixel here and there may differ by any amount; 99 of 100 must agree to this.
PARITY_PX = 0.02


class ParityError(RuntimeError):
    """A graph does not compute what the PyTorch network computes."""


def shifted_pair(
    height: int, width: int, seed: int, *, pan_px: int = 0
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A textured pair, uint8 [1, H, W, 3], whose disparity grows from the top to the bottom.

    ``pan_px`` up to 40 looks so far to the right of where it looks by default.
    """
    rng = np.random.default_rng(seed)
    noise = rng.uniform(0, 255, (height // 4 + 1, width // 4 + 31, 3))
    wall = np.repeat(np.repeat(noise, 4, axis=0), 4, axis=1)[:height]
    shift = np.linspace(4, 40, height).astype(int)
    left = wall[:, pan_px : pan_px + width]
    right = np.stack([wall[y, pan_px + s :][:width] for y, s in enumerate(shift)])
    return left[None].astype(np.uint8), right[None].astype(np.uint8)


def check_parity(
    network: AnyNetwork, graphs: SteppedNetwork, kind: StepKind, *, frames: int = 3
) -> float:
    """The largest difference from PyTorch among 99 % of pixels, over a short sequence, in px.

    A cold kind steps the first frame; the plain kind of the same count steps the others.
    Raises ParityError if the difference is more than :data:`PARITY_PX`.
    """
    height, width = 6 * network.config.stride, 8 * network.config.stride
    state, carried = network.cold_state(1, height, width), graphs.cold_state(height, width)
    matrix = np.eye(4, dtype=np.float32)[None]
    matrix[0, 0, 3] = -2.0  # the view pans
    worst = 0.0
    for frame in range(frames):
        pair = shifted_pair(height, width, 0, pan_px=2 * frame)
        left, right = (torch.from_numpy(image) for image in pair)
        with torch.inference_mode():
            if kind.at_2x and frame == 0:
                disparity, sigma, carried = graphs.start(*pair, kind.iterations)
                expected = network.cold_step(left, right, kind.iterations, at_2x=kind.at_2x)
            else:
                inputs = StepInputs(*pair, matrix, carried)
                disparity, sigma, carried = graphs.run(inputs, kind.iterations)
                estimate, state = network(
                    left, right, torch.from_numpy(matrix), state, kind.iterations
                )
                expected = StepOutput(estimate.disparity, estimate.sigma, state)
        state = expected.state
        for got, wanted in ((disparity, expected.disparity), (sigma, expected.sigma)):
            worst = max(worst, float(np.quantile(np.abs(got - wanted.numpy()), 0.99)))
    if not worst < PARITY_PX:
        raise ParityError(
            f"{graphs.card.name}_{kind}: differs from PyTorch by {worst:.2g} px at the 99th "
            f"percentile, expected less than {PARITY_PX:g}"
        )
    return worst


def export_run(
    run: Run,
    config: Config,
    out: Path,
    *,
    int8_clips: ClipPool | None = None,
    progress: Progress | None = None,
) -> None:
    """Write every graph of one tier and its entry of the manifest; other entries stay.

    With ``int8_clips`` the graphs are int8 ones, made of those that were checked.
    """
    network = trained_network(run)
    progress = progress or no_progress()
    kinds = [StepKind(count) for count in config.iterations]
    kinds += [StepKind(count, at_2x) for count, at_2x in config.iterations_at_2x.items()]
    bar = progress.add_task("export", total=None, note="")
    parts = exported_parts(network, lambda note: progress.update(bar, advance=1, note=note))
    models = {kind: stitched(parts, kind) for kind in kinds}
    entry: dict[str, object] = {
        "stride": run.network.stride,
        "max_disparity_px": run.network.max_disparity_px,
        "state": [dataclasses.asdict(tensor) for tensor in network.state_tensors],
        "cold_max_pixels": config.max_pixels_at_2x if config.iterations_at_2x else 0,
        "architecture": dataclasses.asdict(run.network),
        "parameters": sum(p.numel() for p in network.parameters()),
        "training": run.story,
        "measured": run.measured,
    }
    with TemporaryDirectory() as folder:
        write_model(Path(folder), config.name, models, parts, entry)
        graphs = OnnxNetwork(Path(folder), config.name)
        for kind in models:
            progress.update(bar, advance=1, note=f"checking {config.name}_{kind} against PyTorch")
            worst = check_parity(network, graphs, kind)
            log.info("%s_%s: within %.1e px of PyTorch", config.name, kind, worst)
    if int8_clips is not None:
        models, entry["int8"] = make_int8(
            models,
            network.state_tensors,
            int8_clips,
            max_disparity_px=run.network.max_disparity_px,
            on_step=lambda note: progress.update(bar, advance=1, note=note),
        )
        log.info("int8: %s", entry["int8"])
    write_model(out, config.name, models, parts, entry)


def export_sigma(run: Run, config: Config, out: Path) -> None:
    """Put a run's part for sigma into the graphs in ``out``, and its story into their manifest.

    Raises ManifestError if ``out`` has no graphs of this network, and RunError.
    """
    network = folded(trained_network(run))
    if not isinstance(network, LiteNetwork):
        raise ConfigError(f"{config.name}: only lite has a part for sigma of its own")
    card = load_model_card(out, config.name)
    part = exported_part(sigma_part(network))
    manifest = json.loads((out / MANIFEST_NAME).read_text("utf-8"))
    entry = manifest["models"][config.name]
    steps = (*card.graphs.values(), *card.cold_graphs.values())
    for path in {stages[-1][0] for stages in steps}:
        onnx.save(with_sigma(onnx.load(path), part), path)
        entry["files"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    entry["parameters"] = sum(p.numel() for p in network.parameters())
    entry |= {"training": run.story, "measured": run.measured}
    write_entry(out / MANIFEST_NAME, config.name, entry)


def write_model(
    out: Path,
    name: str,
    models: Mapping[StepKind, ModelProto],
    parts: StepParts[ModelProto],
    entry: Mapping[str, object],
) -> None:
    """Write whole steps as the files they are served from.

    A step with one graph in ``begin`` stays whole: one call is simple to serve, and nothing is
    handed from graph to graph. With the weights shared, five counts take little more room than one.
    Of `fast` on two cores: 162 ms against 198 at one iteration, 259 against 301 at five; 9.5 MB
    where five whole graphs would take 43.6 (``tests/benchmarks/graph_parts.py --model fast``).
    """
    out.mkdir(parents=True, exist_ok=True)
    if len(parts.begin) == 1:
        files = {f"{name}_{kind}.onnx": model for kind, model in models.items()}
        stages = {kind: [[file]] for kind, file in zip(models, files, strict=True)}
        shared = out / f"{name}.weights"
        write_with_shared_weights({out / file: model for file, model in files.items()}, shared)
        written = [*files, shared.name]
    else:
        stages, files = in_stages(name, models, handed_on(parts))
        for file, model in files.items():
            onnx.save(model, out / file)
        written = [*files]
    digests = {file: hashlib.sha256((out / file).read_bytes()).hexdigest() for file in written}
    graphs, cold_graphs = (
        {str(kind.iterations): each for kind, each in stages.items() if bool(kind.at_2x) == cold}
        for cold in (False, True)
    )
    complete = {**entry, "graphs": graphs, "cold_graphs": cold_graphs, "files": digests}
    write_entry(out / MANIFEST_NAME, name, complete)


def exported_parts(
    network: AnyNetwork, on_step: Callable[[str], None] = silent
) -> StepParts[ModelProto]:
    """The graphs that :func:`stitched` takes, batch norms folded.

    ``on_step`` gets the name of each part before it is traced.
    """
    match folded(network):
        case LiteNetwork() as lite:
            parts = lite_parts_of(lite)
        case RaftNetwork() as raft:
            parts = raft_parts_of(raft)
        case other:
            raise ConfigError(f"no parts of a {type(other).__name__}")

    def exported(part: GraphPart) -> ModelProto:
        on_step(f"tracing {type(part.module).__name__}")
        return exported_part(part)

    look = parts.at_2x
    return StepParts(
        tuple(exported(part) for part in parts.begin),
        exported(parts.iterate),
        exported(parts.end),
        None
        if look is None
        else RefinementAt2x(exported(look.enter), look.moved, exported(look.join)),
        None if parts.sigma is None else exported(parts.sigma),
    )


def exported_part(part: GraphPart) -> ModelProto:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "part.onnx"
        export_part(part, path)
        return onnx.load(path)


def write_entry(path: Path, name: str, entry: dict[str, object]) -> None:
    """Add or replace one model of the manifest."""
    manifest: dict[str, object] = {"format": MANIFEST_FORMAT, "models": {}}
    if path.exists():
        before = json.loads(path.read_text("utf-8"))
        # The entries of another format would be misread.
        manifest = before if before["format"] == MANIFEST_FORMAT else manifest
    cast("dict[str, object]", manifest["models"])[name] = entry
    path.write_text(json.dumps(manifest, indent=1) + "\n", "utf-8")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="vergence_models.export", description=__doc__)
    parser.add_argument("--run", type=Path, required=True, help="folder of a training run")
    parser.add_argument("--out", type=Path, required=True, help="folder for graphs and manifest")
    parser.add_argument(
        "--int8", type=Path, metavar="POOL", help="make int8 graphs, their ranges from its clips"
    )
    parser.add_argument(
        "--sigma", action="store_true", help="change only the sigma of the graphs in --out"
    )
    given = parser.parse_args(arguments)
    for chatty in ("torch.onnx", "onnxscript", "onnx_ir"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    try:
        run = read_run(given.run)
        int8_clips = None if given.int8 is None else ClipPool(given.int8)
        with progress_bar(counted=False) as progress:
            # After the bar has begun: lines of the log are then written above it.
            logging.basicConfig(level=logging.INFO, format="%(message)s")
            if given.sigma:
                export_sigma(run, load_config(run.config_name), given.out)
                return
            export_run(
                run,
                load_config(run.config_name),
                given.out,
                int8_clips=int8_clips,
                progress=progress,
            )
    except (ConfigError, FileNotFoundError, ManifestError, RunError) as error:
        sys.exit(f"vergence_models.export: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
