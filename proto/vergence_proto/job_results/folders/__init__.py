"""The layouts of result folders and archives: each makes files of the frames of a job.

``base`` states the contract. Every layout ends with ``manifest.json``, ``frames.jsonl`` and
``rig.json``.
"""

from collections.abc import Callable, Mapping

from vergence_proto.job_results.folders.base import About, File, Layout
from vergence_proto.job_results.folders.benchmarks import eth3d_layout, middlebury_layout
from vergence_proto.job_results.folders.colmap import ColmapLayout
from vergence_proto.job_results.folders.kitti import KittiLayout
from vergence_proto.job_results.folders.maps import MapLayout
from vergence_proto.job_results.folders.nerfstudio import NerfstudioLayout
from vergence_proto.job_results.folders.tum import TumLayout
from vergence_proto.jobs import ResultFormat

__all__ = ["RESULT_LAYOUTS", "About", "File", "Layout"]

RESULT_LAYOUTS: Mapping[ResultFormat, Callable[[About], Layout]] = {
    **{
        form: MapLayout.of(form)
        for form in (
            ResultFormat.PNG16,
            ResultFormat.PNG16MM,
            ResultFormat.PFM,
            ResultFormat.NPZ,
        )
    },
    ResultFormat.NERFSTUDIO: NerfstudioLayout,
    ResultFormat.COLMAP: ColmapLayout,
    ResultFormat.TUM: TumLayout,
    ResultFormat.KITTI: KittiLayout,
    ResultFormat.MIDDLEBURY: middlebury_layout,
    ResultFormat.ETH3D: eth3d_layout,
}
"""All layouts; a film has none."""
