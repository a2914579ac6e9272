"""Steps of all kinds and damaged weights, for `sanitize`: any fault ends the process.

    python tests/native/fuzz.py [ROUNDS]

It imports nothing besides numpy and the package: a sanitizer watches all that is loaded.
"""

import random
import sys
import tempfile
from pathlib import Path

import numpy as np

from vergence_native import LiteStep, NotFinite, Threads, UnsupportedWeights, variants

WEIGHTS = Path(__file__).parents[2] / "models/vergence_models/weights"
FILES = [WEIGHTS / f"lite_{name}.onnx" for name in ("begin_0", "begin_1", "1")]
ODD = (np.nan, np.inf, -np.inf, 3e38, -1e30, 1e-40, 0.0, 191.9, 5000.0)


def stepped(step: LiteStep, height: int, width: int, chance: np.random.Generator) -> None:
    """A step on noise, with a state of odd values and a transform that leads anywhere."""
    left, right = (chance.integers(0, 256, (height, width, 3), np.uint8) for _ in range(2))
    disparity = chance.uniform(0, 220, (1, height // 4, width // 4)).astype(np.float32)
    hidden = chance.uniform(-1, 1, (32, height // 8, width // 8)).astype(np.float32)
    for array in (disparity, hidden):
        some = chance.integers(0, array.size, array.size // 20)
        array.reshape(-1)[some] = chance.choice(ODD, some.size).astype(np.float32)
    matrix = np.eye(4) + chance.normal(0, 1, (4, 4)) * chance.choice([0, 1e-3, 1, 1e4, 1e30])
    try:
        step.step(left, right, matrix.astype(np.float32), disparity, hidden)
        step.step(left, right, None, disparity, hidden)
    except NotFinite:
        pass


def damaged(folder: Path, chance: random.Random) -> list[Path]:
    """The files of a step, one of them with wrong bytes and perhaps cut off."""
    files = [folder / path.name for path in FILES]
    for source, path in zip(FILES, files, strict=True):
        path.write_bytes(source.read_bytes())
    path = chance.choice(files)
    content = bytearray(path.read_bytes())
    for _ in range(chance.randint(1, 12)):
        content[chance.randrange(len(content))] = chance.randrange(256)
    end = chance.choice([len(content), chance.randrange(len(content))])
    path.write_bytes(content[:end])
    return files


def main(rounds: int) -> None:
    """Fuzz shapes, states and transforms in every variant, then weights."""
    pools = [Threads(count) for count in (1, 3)]
    numbers = np.random.default_rng(rounds)
    for variant in variants():
        steps = [LiteStep(FILES, iterations=1, threads=pool, variant=variant) for pool in pools]
        for round_ in range(rounds if variant != "scalar" else max(1, rounds // 8)):
            size = 32 * int(numbers.integers(1, 7)), 32 * int(numbers.integers(6, 14))
            stepped(steps[round_ % 2], *size, numbers)
        for step in steps:
            step.close()
    largest = LiteStep(FILES, iterations=1, threads=pools[1])
    for size in ((1600, 2496), (32, 16384), (16384, 192)):
        stepped(largest, *size, numbers)
    largest.close()
    taken = 0
    with tempfile.TemporaryDirectory() as name:
        for round_ in range(10 * rounds):
            try:
                step = LiteStep(damaged(Path(name), random.Random(round_)), iterations=1)
            except UnsupportedWeights:
                continue
            stepped(step, 32, 192, numbers)
            step.close()
            taken += 1
    for pool in pools:
        pool.close()
    sys.stdout.write(f"{', '.join(variants())}: no fault; {taken} damaged files were taken\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)
