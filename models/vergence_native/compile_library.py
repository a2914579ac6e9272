"""Compile the library, with any C compiler that takes the options of gcc. Standard library only.

    python models/vergence_native/compile_library.py

An installation runs this by itself (``hatch_build.py``).
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY = HERE / f"vergence_native{SUFFIX}"

# No contraction: every variant rounds as the source says. The other two change no result.
FLAGS = (
    "-std=c11",
    "-O3",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
)
SHARED_SOURCES = ("api.c", "pool.c", "weights.c", "workspace.c")
_AVX2 = ("-mavx2", "-mfma")
_AVX512 = (
    *_AVX2,
    *(f"-mavx512{part}" for part in ("f", "dq", "bw", "vl", "vnni")),
    "-mprefer-vector-width=512",
)
# The step is compiled once for each; ``api.c`` chooses at run time.
VARIANTS: dict[str, dict[str, tuple[str, ...]]] = {
    "x86_64": {
        "scalar": (),
        "avx2": _AVX2,
        "avx2_vnni": (*_AVX2, "-mavxvnni"),
        "avx512_vnni": _AVX512,
    },
}
_ONLY_SCALAR: dict[str, tuple[str, ...]] = {"scalar": ()}


class CannotCompile(RuntimeError):
    """There is no compiler, or it refused the sources."""


def find_compiler() -> list[str]:
    """The command of a C compiler. Raises CannotCompile."""
    if chosen := os.environ.get("CC"):
        return shlex.split(chosen)
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return [found]
    raise CannotCompile(
        "no C compiler: neither cc, gcc nor clang is on the PATH, and CC is not set"
    )


def machine() -> str:
    """The architecture that is compiled for, as in :data:`VARIANTS` if it is there."""
    name = os.environ.get("_PYTHON_HOST_PLATFORM", "").rpartition("-")[2] or platform.machine()
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(name.lower(), name.lower())


def compile_library(target: Path = LIBRARY, *, extra: tuple[str, ...] = ()) -> Path:
    """Compile to ``target``, with ``extra`` options, and return it. Raises CannotCompile."""
    compiler = [*find_compiler(), *FLAGS, *extra]
    if sys.platform != "win32":
        compiler.append("-fPIC")
    if sys.platform == "darwin":
        compiler += ["-arch", "arm64" if machine() == "aarch64" else machine()]
    variants = VARIANTS.get(machine(), _ONLY_SCALAR)
    with tempfile.TemporaryDirectory() as folder:
        jobs: list[tuple[str, Path, tuple[str, ...]]] = [
            (source, Path(folder, f"{source}.o"), ()) for source in SHARED_SOURCES
        ]
        jobs += [
            ("step.c", Path(folder, f"{name}.o"), (f"-DVARIANT={name}", *flags))
            for name, flags in variants.items()
        ]

        def compile_one(job: tuple[str, Path, tuple[str, ...]]) -> Path:
            source, object_file, flags = job
            _run([*compiler, *flags, "-c", str(HERE / "csrc" / source), "-o", str(object_file)])
            return object_file

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            objects = [*map(str, pool.map(compile_one, jobs))]
        libraries = [] if sys.platform == "win32" else ["-lm", "-lpthread"]
        linked = Path(folder, target.name)
        _run([*compiler, "-shared", *objects, "-o", str(linked), *libraries])
        # A process that has the old file open keeps it.
        target.unlink(missing_ok=True)
        shutil.move(linked, target)
    return target


def _run(command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise CannotCompile(f"{command[0]} cannot be run: {error}") from None
    if done.returncode:
        raise CannotCompile(f"{shlex.join(command)} failed:\n{done.stderr}")


if __name__ == "__main__":
    try:
        sys.stdout.write(f"{compile_library()}\n")
    except CannotCompile as failure:
        sys.exit(str(failure))
