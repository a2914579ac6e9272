"""OpenCV, loaded when it is first used: loading takes longer than that of the whole client.

``from vergence_proto.opencv import cv2`` costs nothing; the first attribute of ``cv2`` loads it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__all__ = ["cv2", "load_opencv"]

if TYPE_CHECKING:
    import cv2
else:

    class _LoadedOnUse:
        def __getattr__(self, name):
            value = getattr(import_module("cv2"), name)
            setattr(self, name, value)  # found without this method from now on
            return value

    cv2 = _LoadedOnUse()


def load_opencv() -> None:
    """Load it now, in a thread that has time for it."""
    import_module("cv2")
