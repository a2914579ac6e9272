"""The public names of `import vergence`, and its cost."""

import subprocess
import sys
from importlib import metadata

import pytest

import vergence
from vergence import public
from vergence_proto import errors

# What a headset or a robot must not have to load, or even install.
HEAVY = {"fastapi", "onnxruntime", "pydantic", "rich", "torch", "typer", "uvicorn"}


def test_the_public_list_is_sorted_and_complete() -> None:
    defined = {
        name
        for name, value in vars(public).items()
        if not name.startswith("_") and getattr(value, "__module__", None)
    }
    constants = {name for name in vars(public) if name.isupper()}
    assert set(vergence.__all__) == defined | constants
    groups = [
        [name for name in vergence.__all__ if name.isupper()],
        [name for name in vergence.__all__ if name[0].isupper() and not name.isupper()],
        [name for name in vergence.__all__ if name.islower()],
    ]
    assert vergence.__all__ == [name for group in groups for name in sorted(group)]


def test_a_public_name_is_that_of_its_module_and_another_is_an_error() -> None:
    assert vergence.DepthClient is public.DepthClient
    assert set(vergence.__all__) <= set(dir(vergence))
    assert vergence.__version__ == metadata.version("vergence")
    with pytest.raises(AttributeError, match="no attribute 'DephtClient'"):
        vergence.DephtClient  # type: ignore[attr-defined]  # noqa: B018


def test_every_error_that_a_server_raises_is_public() -> None:
    raised = {error.__name__ for error in errors.ERROR_CLASSES.values()}
    assert raised <= set(vergence.__all__)


def test_the_import_is_light() -> None:
    command = "import sys, vergence; vergence.depth; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", command], capture_output=True, text=True, check=True
    ).stdout.split()
    packages = {name.partition(".")[0] for name in loaded}
    assert "vergence" in packages
    assert not HEAVY & packages
    assert "cv2" not in packages  # it is loaded with the first image that is encoded
    assert "vergence_proto.datasets" not in loaded
    assert not {"vergence_service", "vergence_models"} & packages
