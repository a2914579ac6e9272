"""The public names of `import vergence`, and its cost."""

import subprocess
import sys

import vergence
from vergence_proto import errors

# What a headset or a robot must not have to load, or even install.
HEAVY = {"fastapi", "onnxruntime", "pydantic", "rich", "torch", "typer", "uvicorn"}


def test_the_public_list_is_sorted_and_complete() -> None:
    defined = {
        name
        for name, value in vars(vergence).items()
        if not name.startswith("_") and getattr(value, "__module__", None)
    }
    constants = {name for name in vars(vergence) if name.isupper()}
    assert set(vergence.__all__) == defined | constants
    groups = [
        [name for name in vergence.__all__ if name.isupper()],
        [name for name in vergence.__all__ if name[0].isupper() and not name.isupper()],
        [name for name in vergence.__all__ if name.islower()],
    ]
    assert vergence.__all__ == [name for group in groups for name in sorted(group)]


def test_every_error_that_a_server_raises_is_public() -> None:
    raised = {error.__name__ for error in errors.ERROR_CLASSES.values()}
    assert raised <= set(vergence.__all__)


def test_the_import_is_light() -> None:
    command = "import sys, vergence; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run(
        [sys.executable, "-c", command], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "vergence" in loaded
    assert not HEAVY & set(loaded)
    assert not {"vergence_service", "vergence_models"} & set(loaded)
