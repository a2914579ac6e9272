"""Compare lossless compressions of a 16-bit disparity map in size and time.

    python tests/benchmarks/codec_size.py --data DIR --json FILE

DIR holds sequences in the ``vergence:`` layout. Without it, maps are of a smooth synthetic room.
``wire`` is what the service sends. Optional codecs are measured if they are installed.
``install_mb`` is what a codec adds to the thin client, with its own dependencies.
"""

import argparse
import json
import re
import sys
import time
import zlib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.codec.planes import compress_plane, decompress_plane
from vergence_proto.instruction_set import instruction_set

if sys.version_info >= (3, 14):
    from compression import zstd

    ZSTD = None
else:
    from backports import zstd

    ZSTD = "backports.zstd"

Map = NDArray[np.uint16]
Encode = Callable[[Map], Any]  # bytes, or a type of the codec's own
Decode = Callable[[Any], Any]

REPEATS = 15
DENOMINATOR = 64


def candidates(shape: tuple[int, int]) -> dict[str, tuple[str | None, Encode, Decode]]:
    """Return name -> (distribution that the base install lacks, encode, decode)."""
    size = shape[0] * shape[1] * 2
    dtype = np.dtype("<u2")

    def raw(data: Any) -> Map:
        return np.frombuffer(data, dtype).reshape(shape)

    found: dict[str, tuple[str | None, Encode, Decode]] = {
        "raw": (None, lambda m: m.tobytes(), raw),
        "wire": (ZSTD, compress_plane, lambda d: decompress_plane(d, size, shape, dtype)),
        "zlib-1": (None, lambda m: zlib.compress(m.data, 1), lambda d: raw(zlib.decompress(d))),
        "png-1": (
            None,
            lambda m: cv2.imencode(".png", m, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1],
            lambda d: cv2.imdecode(d, cv2.IMREAD_UNCHANGED),
        ),
    }
    for level in (-1, 1, 3):
        found[f"horizontal+shuffle+zstd{level}"] = (ZSTD, *_shuffled_zstd(level, shape))
    if find_spec("blosc2"):
        found["blosc2 bitshuffle+zstd1"] = ("blosc2", *_blosc2(raw))
    if find_spec("imagecodecs"):
        found["imagecodecs delta+bitshuffle+zstd1"] = ("imagecodecs", *_imagecodecs(raw, shape))
    return found


def _shuffled_zstd(level: int, shape: tuple[int, int]) -> tuple[Encode, Decode]:
    def encode(m: Map) -> bytes:
        delta = np.diff(m, axis=1, prepend=np.uint16(0))
        shuffled = np.ascontiguousarray(delta.view(np.uint8).reshape(-1, 2).T)
        return zstd.compress(shuffled.data, level)

    def decode(data: bytes) -> Map:
        shuffled = np.frombuffer(zstd.decompress(data), np.uint8).reshape(2, -1)
        delta = np.ascontiguousarray(shuffled.T).view("<u2").reshape(shape)
        stored: Map = np.add.accumulate(delta, axis=1, dtype=np.uint16)
        return stored

    return encode, decode


def _blosc2(raw: Decode) -> tuple[Encode, Decode]:
    import blosc2

    def encode(m: Map) -> Any:
        return blosc2.compress2(
            m,
            clevel=1,
            codec=blosc2.Codec.ZSTD,
            filters=[blosc2.Filter.BITSHUFFLE],
            filters_meta=[0],
            typesize=2,
            nthreads=1,
        )

    return encode, lambda data: raw(blosc2.decompress2(data, nthreads=1))


def _imagecodecs(raw: Decode, shape: tuple[int, int]) -> tuple[Encode, Decode]:
    import imagecodecs

    def encode(m: Map) -> Any:
        delta = imagecodecs.delta_encode(m, axis=1)
        return imagecodecs.zstd_encode(imagecodecs.bitshuffle_encode(delta), level=1)

    def decode(data: Any) -> Any:
        shuffled = raw(imagecodecs.zstd_decode(data))
        return imagecodecs.delta_decode(imagecodecs.bitshuffle_decode(shuffled), axis=1)

    return encode, decode


def real_maps(data_dir: Path, shape: tuple[int, int]) -> list[Map]:
    """Read every fourth true map of that size; pixels without truth are 0."""
    maps = [np.load(path)["disp"] for path in sorted(data_dir.glob("*/frame_???[048]_gt.npz"))]
    return [m.astype("<u2") for m in maps if m.shape == shape]


def synthetic_maps(shape: tuple[int, int]) -> list[Map]:
    """Make slanted planes with steps between them and a tenth of a pixel of smooth error."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    maps = []
    for _ in range(4):
        room = 12 + 0.03 * v
        for _ in range(12):
            u0, v0 = rng.uniform(0, shape[1]), rng.uniform(0, shape[0])
            inside = (abs(u - u0) < rng.uniform(20, 120)) & (abs(v - v0) < rng.uniform(20, 120))
            slant_u, slant_v = rng.uniform(-0.02, 0.02, 2)
            room[inside] = (rng.uniform(10, 60) + slant_u * (u - u0) + slant_v * (v - v0))[inside]
        error = cv2.resize(
            rng.normal(0, 0.1, (shape[0] // 4, shape[1] // 4)).astype(np.float32), shape[::-1]
        )
        maps.append(np.rint((room + error) * DENOMINATOR).astype("<u2"))
    return maps


def median_ms(call: Callable[[Any], object], argument: object) -> float:
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call(argument)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def install_mb(name: str | None) -> float:
    """Return what a distribution adds to the base install, with its dependencies, in MB."""
    base = _closure("numpy") | _closure("opencv-python-headless") | _closure("protobuf")
    added = _closure(name) - base if name else set()
    paths = [file.locate() for each in added for file in distribution(each).files or ()]
    return sum(Path(str(path)).stat().st_size for path in paths if Path(str(path)).exists()) / 1e6


def _closure(name: str) -> set[str]:
    found, waiting = set[str](), [name]
    while waiting:
        current = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        try:
            requires = distribution(current).requires or []
        except PackageNotFoundError:
            continue  # it is for another platform
        if current not in found:
            found.add(current)
            plain = [line for line in requires if "extra ==" not in line]
            waiting += [re.split(r"[\s;<>=!~\[(]", line)[0] for line in plain]
    return found


def measure(maps: list[Map]) -> list[dict[str, float | str]]:
    rows: list[dict[str, float | str]] = []
    for name, (package, encode, decode) in candidates(maps[0].shape).items():
        files = [encode(m) for m in maps]
        for m, file in zip(maps, files, strict=True):
            np.testing.assert_array_equal(decode(file), m, err_msg=name)
        rows.append(
            {
                "codec": name,
                "kib": float(np.mean([len(file) for file in files])) / 1024,
                "encode_ms": float(np.mean([median_ms(encode, m) for m in maps])),
                "decode_ms": float(np.mean([median_ms(decode, file) for file in files])),
                "install_mb": install_mb(package),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of sequences with truth")
    parser.add_argument("--json", type=Path, help="write the table here")
    options = parser.parse_args()
    shape = (480, 640)
    maps = real_maps(options.data, shape) if options.data else synthetic_maps(shape)
    if not maps:
        parser.error(f"no true disparity of {shape[1]}x{shape[0]} under {options.data}")
    cv2.setNumThreads(1)
    rows = measure(maps)
    sys.stdout.write(f"isa {instruction_set()}\n")
    sys.stdout.write(f"{len(maps)} maps of {shape[1]}x{shape[0]}, uint16 at 1/{DENOMINATOR} px\n")
    sys.stdout.write(
        f"{'codec':36}{'KiB':>8}{'encode ms':>11}{'decode ms':>11}{'install MB':>12}\n"
    )
    for row in rows:
        sys.stdout.write(
            f"{row['codec']:36}{row['kib']:8.1f}{row['encode_ms']:11.2f}{row['decode_ms']:11.2f}"
            f"{row['install_mb']:12.1f}\n"
        )
    if options.json:
        source = str(options.data) if options.data else "synthetic"
        about = {"isa": instruction_set(), "maps": len(maps), "source": source}
        options.json.write_text(json.dumps({**about, "rows": rows}))


if __name__ == "__main__":
    main()
