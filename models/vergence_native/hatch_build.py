"""The build hook of the wheel: compile the library if there is a C compiler.

Without a compiler the installation goes on: the wheel is for every platform, onnxruntime serves.
"""

from __future__ import annotations

import importlib.util
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class NativeLibraryHook(BuildHookInterface):
    """Compiles into the package's folder, for a wheel and for an editable installation."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and tag the wheel with this platform and no version of Python."""
        compiling = _load(Path(self.root, "models/vergence_native/compile_library.py"))
        compiling.LIBRARY.unlink(missing_ok=True)
        try:
            compiling.compile_library()
        except compiling.CannotCompile as error:
            self.app.display_warning(f"vergence_native is not built, onnxruntime serves: {error}")
            return
        system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{system}"


def _load(path: Path) -> Any:
    """Import a file of the package alone: its other modules need numpy."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module
