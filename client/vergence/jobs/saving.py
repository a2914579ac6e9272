"""Write the frames of a job to a folder, in any layout, as they are made."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vergence_proto.errors import BadShape
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.jobs import ResultFormat

if TYPE_CHECKING:
    from vergence_proto.job_results.folders import File

MANIFEST = "manifest.json"
_RIG = "rig.json"
_OWN_FOLDERS = {
    *("disparity", "depth", "confidence", "sigma", "left", "points"),
    *("images", "depths", "rgb", "stereo", "sparse", "disp_0", "image_2", "low_res_two_view"),
}
_OWN_SUFFIXES = {".png", ".pfm", ".npz", ".ply", ".jpg", ".webp", ".ppm", ".bin", ".txt", ".json"}
_OWN_SUFFIXES |= {".jsonl"}


def checked_format(form: str) -> ResultFormat:
    """Return the format. Raises BadShape: there is no such format of folders."""
    # Here, because the layouts take as long to load as the rest of the client.
    from vergence_proto.job_results.folders import RESULT_LAYOUTS

    known = [each.value for each in RESULT_LAYOUTS]
    if form not in known:
        raise BadShape(f"expected a format of {', '.join(known)}, got {form!r}")
    return ResultFormat(form)


def read_manifest(folder: Path) -> Mapping[str, Any] | None:
    """Return the manifest of a result in a folder, if there is one."""
    try:
        manifest: Mapping[str, Any] = json.loads((folder / MANIFEST).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) else None


def is_finished(
    folder: Path, form: str, options: Mapping[str, Any], digest: Callable[[], str]
) -> bool:
    """Return whether a folder has the whole result of an upload with these options.

    ``digest`` returns the SHA-256 of the upload; it is called only if all else fits.
    """
    manifest = read_manifest(folder)
    if manifest is None or manifest.get("format") != form or manifest.get("state") != "done":
        return False
    made_with = manifest.get("options", {})
    same = all(made_with.get(name, value) == value for name, value in options.items())
    return same and manifest.get("upload_sha256") == digest()


def make_room(folder: Path) -> None:
    """Make a folder without results of an earlier job.

    Raises FileExistsError: it holds files, and none says that they are results.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if read_manifest(folder) is None and not (folder / _RIG).is_file():
        if any(folder.iterdir()):
            raise FileExistsError(
                f"{folder} holds files that are no results of a job; name another folder"
            )
        return
    # The manifest goes last: should this be interrupted, the rest is still known as results.
    for path in sorted(_own_files(folder), key=lambda path: path.name == MANIFEST):
        path.unlink()


def _own_files(folder: Path) -> Iterator[Path]:
    for path in list(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        ours = len(parts) == 1 or parts[0] in _OWN_FOLDERS or parts[-1].endswith("Vergence.pfm")
        if ours and path.suffix in _OWN_SUFFIXES and path.is_file():
            yield path


class Saving:
    """Writes frames in a layout.

    The manifest is there from the beginning, so that the folder is known as a result.

    Raises BadShape: the job did not keep what the layout needs.
    """

    def __init__(self, folder: Path, form: str, manifest: Mapping[str, Any]) -> None:
        from vergence_proto.job_results.folders import RESULT_LAYOUTS
        from vergence_proto.job_results.manifest import about_of

        self._about_of = about_of
        self._folder = folder
        self._form = checked_format(form)
        stated = {**manifest, "format": self._form.value, "state": "incomplete"}
        self._layout = RESULT_LAYOUTS[self._form](about_of(stated))
        (folder / MANIFEST).write_text(json.dumps(stated), "utf-8")

    def write(self, frame: JobFrame) -> None:
        """Write the files of the next frame."""
        self._write(self._layout.frame(frame))

    def end(self, manifest: Mapping[str, Any]) -> None:
        """Write the last files; ``manifest`` is that of the ended job."""
        self._layout.about = self._about_of({**manifest, "format": self._form.value})
        self._write(self._layout.end())

    def _write(self, files: "Iterator[File]") -> None:
        for file in files:
            path = self._folder / file.name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(file.content)
