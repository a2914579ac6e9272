"""The extras of the distribution, and how a message names the one that is missing."""

from importlib import metadata
from pathlib import Path
from typing import Literal

Extra = Literal[
    "bench", "cli", "fleet", "models", "otel", "ray", "record", "server", "train", "zenoh"
]


def how_to_install(extra: Extra | None) -> str:
    """Return the pip command that adds an extra, or the requirements of the base, to Vergence.

    pip takes the requirements of an installed distribution from its own metadata, so the command
    works although the project is on no package index. A source tree that is only on the path is not
    installed; its command names the folder.
    """
    suffix = f"[{extra}]" if extra else ""
    try:
        metadata.distribution("vergence")
    except metadata.PackageNotFoundError:
        return f"pip install -e '{Path(__file__).parents[2]}{suffix}'"
    return f"pip install 'vergence{suffix}'"
