"""Write the protobuf code for depth.proto beside it: ``python proto/generate.py [--check]``.

Newer protobuf runtimes read older generated code and not the reverse, so this refuses to run with
any but the oldest supported generator (the pin in pyproject's ``dev`` extra).
"""

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
    return sorted((out / PROTO).parent.glob("depth_pb2*"))


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
