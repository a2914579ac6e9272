"""Write the protobuf code beside the two .proto files: ``python proto/generate.py [--check]``.

Newer protobuf runtimes read older generated code and not the reverse, so this refuses to run with
any but the oldest supported generator (the pin in pyproject's ``dev`` extra). The generator leaves
types out; this adds them, for users whose type checkers are strict.
"""

import re
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from grpc_tools import protoc

ROOT = Path(__file__).resolve().parent
DEPTH = "vergence_proto/v1/depth.proto"
INFERENCE = "vergence_proto/open_inference/inference.proto"
GENERATOR = "1.72.2"


def generate(out: Path) -> list[Path]:
    _compile(out, DEPTH, "python", "pyi", "grpc_python")
    depth = (out / DEPTH).parent
    _complete_types(depth / "depth_pb2.pyi")
    (depth / "depth_pb2_grpc.pyi").write_text(_service_types(depth / "depth_pb2_grpc.py"))
    _compile(out, INFERENCE, "python", "pyi")
    inference = (out / INFERENCE).parent
    _complete_types(inference / "inference_pb2.pyi")
    _separate(inference / "inference_pb2.py")
    made = [*depth.glob("depth_pb2*"), *inference.glob("inference_pb2*")]
    return sorted(each.relative_to(out) for each in made)


def _compile(out: Path, proto: str, *kinds: str) -> None:
    include = Path(protoc.__file__).parent / "_proto"
    outputs = [f"--{kind}_out={out}" for kind in kinds]
    if protoc.main(["protoc", f"-I{ROOT}", f"-I{include}", *outputs, proto]) != 0:
        raise SystemExit(f"protoc failed on {proto}")


def _separate(messages: Path) -> None:
    """Register the messages in a pool of their own.

    Every client of the Open Inference Protocol registers the same names in protobuf's common pool,
    which accepts a name once.
    """
    text = messages.read_text()
    common = "_descriptor_pool.Default()"
    assert text.count(common) == 1
    messages.write_text(text.replace(common, "_descriptor_pool.DescriptorPool()"))


def _complete_types(messages: Path) -> None:
    text = messages.read_text()
    text = text.replace("_Mapping]", "_Mapping[str, _Any]]")
    text = text.replace(
        "from typing import ClassVar", "from typing import Any as _Any, ClassVar", 1
    )
    messages.write_text(text)


def _service_types(service: Path) -> str:
    """Return types of the stub and the servicer, which serve plain gRPC and asyncio alike."""
    servicer = service.read_text().split("class DepthServiceServicer")[1].split("\ndef ")[0]
    methods = re.findall(r"def (\w+)\(self, (\w+), context\):", servicer)
    lines = [
        "from typing import Any",
        "",
        "class DepthServiceStub:",
        *(f"    {name}: Any" for name, _ in methods),
        "    def __init__(self, channel: Any) -> None: ...",
        "",
        "class DepthServiceServicer:",
        *(
            f"    def {name}(self, {taken}: Any, context: Any) -> Any: ..."
            for name, taken in methods
        ),
        "",
        "def add_DepthServiceServicer_to_server(",
        "    servicer: DepthServiceServicer, server: Any",
        ") -> None: ...",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    if version("grpcio-tools") != GENERATOR:
        raise SystemExit(f"expected grpcio-tools {GENERATOR}, got {version('grpcio-tools')}")
    if "--check" not in sys.argv:
        generate(ROOT)
        return
    with tempfile.TemporaryDirectory() as fresh:
        for made in generate(Path(fresh)):
            committed = ROOT / made
            if (
                not committed.exists()
                or committed.read_bytes() != (Path(fresh) / made).read_bytes()
            ):
                raise SystemExit(f"{committed} differs from what is generated; run {__file__}")


if __name__ == "__main__":
    main()
