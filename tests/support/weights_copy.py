"""The test weights in a folder where a test may spoil them."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vergence_proto.model_io import MANIFEST_NAME

WEIGHTS = Path(__file__).parent / "weights"

Entry = dict[str, Any]  # of a model in the manifest: JSON


def copied_weights(folder: Path, *, edit: Callable[[Entry], object] | None = None) -> Path:
    """A copy in ``folder``; ``edit`` is given the entry of ``staged``."""
    weights = Path(shutil.copytree(WEIGHTS, folder / "weights"))
    if edit is not None:
        manifest = json.loads((weights / MANIFEST_NAME).read_text("utf-8"))
        edit(manifest["models"]["staged"])
        (weights / MANIFEST_NAME).write_text(json.dumps(manifest), "utf-8")
    return weights
