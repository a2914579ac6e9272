"""Read a graph file, and write a foreign model into a folder of weights."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
from google.protobuf.message import DecodeError
from onnx import ModelProto
from onnx.external_data_helper import load_external_data_for_model, uses_external_data

from vergence_models.foreign.compose import (
    MIRRORED,
    NETWORK,
    graph_after,
    graph_before,
    renamed,
    state_of,
)
from vergence_models.foreign.contract import Contract, ContractError
from vergence_models.foreign.trial import first_line
from vergence_proto.model_io import (
    CLASSICAL_MODELS,
    MANIFEST_FORMAT,
    MANIFEST_NAME,
    ManifestError,
    StepMemory,
)

_MOST_BYTES = (2 << 30) - (16 << 20)  # protobuf's limit of one message, with room for the names
# The server finds these before it looks into the user's folder.
_OWN_NAMES = {"lite", "full", "fast", *CLASSICAL_MODELS}
_CHECKPOINT = (b"\x80", b"PK")  # how a pickle begins, and a zip of them
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]*")


def read_graph(path: Path) -> ModelProto:
    """Read a graph with its weights. Raises ContractError in one sentence."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise ContractError(f"cannot read {path}: {error.strerror}") from None
    too_large = f"{path.name} has more than 2 GB of weights, the limit here; export it in float16"
    if size > _MOST_BYTES:
        raise ContractError(too_large)
    try:
        with path.open("rb") as file:
            if file.read(2).startswith(_CHECKPOINT):
                raise ContractError(
                    f"{path.name} is no ONNX file but a checkpoint of PyTorch; export its network "
                    "with torch.onnx.export"
                )
        model = onnx.load(path, load_external_data=False)
    except ContractError:
        raise
    except (DecodeError, ValueError, OSError, RuntimeError) as error:
        raise ContractError(f"{path.name} is no ONNX file: {first_line(error)}") from None
    if not model.graph.node:
        raise ContractError(f"{path.name} is no ONNX file: it holds no operators")
    opsets = [each.version for each in model.opset_import if each.domain in ("", "ai.onnx")]
    newest = onnx.defs.onnx_opset_version()
    if max(opsets, default=1) > newest:
        raise ContractError(
            f"{path.name} is of opset {max(opsets)}, and the newest here is {newest}; export it "
            "with an older one, or install a newer onnx"
        )
    beside = {
        entry.value
        for tensor in model.graph.initializer
        if uses_external_data(tensor)
        for entry in tensor.external_data
        if entry.key == "location"
    }
    try:
        size += sum((path.parent / name).stat().st_size for name in beside)
        if size <= _MOST_BYTES:
            load_external_data_for_model(model, str(path.parent))
    except (OSError, ValueError, onnx.checker.ValidationError) as error:
        names = ", ".join(sorted(beside))
        raise ContractError(
            f"the weights of {path.name} lie beside it in {names}, which cannot be read: "
            f"{first_line(error)}"
        ) from None
    if size > _MOST_BYTES:
        raise ContractError(too_large)
    return model


def checked_name(name: str) -> str:
    """Return the name of a model. Raises ContractError if it is not allowed."""
    if not _NAME.fullmatch(name):
        raise ContractError(
            f"expected a name of small letters, digits, dots and dashes, got {name!r}; use --name"
        )
    if name in _OWN_NAMES:
        raise ContractError(f"{name} is a model of this project; choose another --name")
    return name


@dataclass(frozen=True, slots=True)
class Written:
    """The files of a foreign model in a folder, by their part."""

    before: str
    after: str
    networks: Mapping[int, tuple[str, ...]]  # by number of iterations; two if mirrored

    @classmethod
    def of(cls, name: str, contract: Contract, counts: list[int]) -> Written:
        mirrored = contract.sigma == "left-right"
        return cls(
            f"{name}.before.onnx",
            f"{name}.after.onnx",
            {
                count: (
                    f"{name}.{count}.onnx",
                    *([f"{name}.{count}.mirrored.onnx"] if mirrored else []),
                )
                for count in counts
            },
        )

    @property
    def files(self) -> list[str]:
        return [self.before, self.after, *(f for each in self.networks.values() for f in each)]


def write_network(model: ModelProto, path: Path, prefix: str = NETWORK) -> Path:
    """Write a foreign graph with the names of its tensors changed."""
    try:
        onnx.save(renamed(model, prefix), path)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ContractError(f"the graph cannot be written: {first_line(error)}") from None
    return path


def write_model(
    folder: Path, name: str, contract: Contract, networks: Mapping[int, Path], **about: Any
) -> None:
    """Write a model and its entry in the manifest; ``networks`` are as write_network made them.

    Raises ManifestError if the folder's manifest is of another format.
    """
    manifest = read_manifest(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = Written.of(name, contract, sorted(networks))
    (folder / files.before).write_bytes(graph_before(contract).SerializeToString())
    (folder / files.after).write_bytes(graph_after(contract).SerializeToString())
    for count, source in networks.items():
        own, *mirrored = files.networks[count]
        shutil.copyfile(source, folder / own)
        for each in mirrored:
            network = onnx.load(folder / own)
            _change_prefix(network)
            onnx.save(network, folder / each)
    manifest["models"][name] = {
        "stride": contract.stride,
        "max_disparity_px": contract.max_disparity_px,
        "state": [
            {"name": each.name, "channels": each.channels, "scale": each.scale}
            for each in state_of(contract)
        ],
        "graphs": {
            str(count): [[files.before], [*network], [files.after]]
            for count, network in files.networks.items()
        },
        "files": {file: _sha256(folder / file) for file in sorted(files.files)},
        "foreign": {"contract": contract.to_json(), **about},
    }
    _replace_manifest(folder, manifest)


def note_memory(folder: Path, name: str, memory: StepMemory) -> None:
    """Write the memory of a step into the manifest."""
    manifest = read_manifest(folder)
    manifest["models"][name]["step_memory"] = dataclasses.asdict(memory)
    _replace_manifest(folder, manifest)


def _replace_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    unfinished = folder / f"{MANIFEST_NAME}.new"
    unfinished.write_text(json.dumps(manifest, indent=1) + "\n", "utf-8")
    os.replace(unfinished, folder / MANIFEST_NAME)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder; an empty one if there is none. Raises ManifestError."""
    path = folder / MANIFEST_NAME
    if not path.exists():
        return {"format": MANIFEST_FORMAT, "models": {}}
    try:
        manifest: dict[str, Any] = json.loads(path.read_bytes())
    except ValueError as error:
        raise ManifestError(f"{path} is not JSON: {error}") from None
    if manifest.get("format") != MANIFEST_FORMAT:
        raise ManifestError(
            f"{path}: expected manifest format {MANIFEST_FORMAT}, got {manifest.get('format')!r}"
        )
    return manifest


def _change_prefix(network: ModelProto) -> None:
    """Give inputs and outputs the names of the mirrored run."""
    graph = network.graph
    changed = {
        each.name: MIRRORED + each.name.removeprefix(NETWORK)
        for each in (*graph.input, *graph.output)
    }
    for each in (*graph.input, *graph.output, *graph.value_info):
        each.name = changed.get(each.name, each.name)
    for node in graph.node:
        for names in (node.input, node.output):
            for index, name in enumerate(names):
                names[index] = changed.get(name, name)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
