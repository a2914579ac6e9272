"""``manifest.json`` of a result: what a reader needs to use its files, and what made them."""

from collections.abc import Mapping
from typing import Any

from vergence_proto.errors import BadSequence
from vergence_proto.geometry import RectifiedRig
from vergence_proto.job_results.folders.base import About
from vergence_proto.jobs import JobOutput

VERSION = 1


def about_of(manifest: Mapping[str, Any]) -> About:
    """Read a manifest. Raises BadSequence: a field is missing or wrong."""
    try:
        rig = None if manifest["rig"] is None else RectifiedRig(**manifest["rig"])
        outputs = [JobOutput(each) for each in manifest["options"]["output"]]
    except (KeyError, TypeError, ValueError) as error:
        raise BadSequence(f"expected the manifest of a job: {error!r}") from None
    return About(manifest, rig, outputs)
