"""Write the protobuf code for depth.proto beside it: ``python proto/generate.py [--check]``.

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
PROTO = "vergence_proto/v1/depth.proto"
GENERATOR = "1.72.2"


def generate(out: Path) -> list[Path]:
    include = Path(protoc.__file__).parent / "_proto"
    outputs = [f"--{kind}_out={out}" for kind in ("python", "pyi", "grpc_python")]
    if protoc.main(["protoc", f"-I{ROOT}", f"-I{include}", *outputs, PROTO]) != 0:
        raise SystemExit(f"protoc failed on {PROTO}")
    folder = (out / PROTO).parent
    _complete_types(folder / "depth_pb2.pyi")
    (folder / "depth_pb2_grpc.pyi").write_text(_service_types(folder / "depth_pb2_grpc.py"))
    return sorted(folder.glob("depth_pb2*"))


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
            committed = (ROOT / PROTO).parent / made.name
            if not committed.exists() or committed.read_bytes() != made.read_bytes():
                raise SystemExit(f"{committed} differs from what {PROTO} generates; run {__file__}")


if __name__ == "__main__":
    main()
