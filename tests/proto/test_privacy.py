"""Nothing of ours reports to anybody what it does."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    "module", ["vergence_service.inference.providers", "vergence_models.foreign.trial"]
)
def test_onnxruntime_does_not_collect_what_it_would_report(module: str, tmp_path: Path) -> None:
    # It keeps an id of the machine, and events that it has not sent, in the cache. Variables of CI
    # would turn it off too.
    kept = {name: os.environ[name] for name in ("PATH", "PYTHONPATH") if name in os.environ}
    code = f"import time, {module}, onnxruntime; onnxruntime.get_device(); time.sleep(0.5)"
    subprocess.run([sys.executable, "-c", code], env={**kept, "HOME": str(tmp_path)}, check=True)
    assert [path for path in tmp_path.rglob("*") if "onnxruntime" in path.name] == []
