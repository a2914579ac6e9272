"""The choice of the engine that computes a model.

An engine is imported when it is chosen: classical methods are served without onnxruntime.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from vergence_proto.extras import how_to_install
from vergence_proto.model_io import CLASSICAL_MODELS
from vergence_service.inference.installed import ProviderUnavailable
from vergence_service.inference.opencv_model import OpenCvModel
from vergence_service.inference.patchmatch_model import PATCHMATCH_MODEL, PatchMatchModel
from vergence_service.inference.sgbm_model import SgbmModel

if TYPE_CHECKING:
    from vergence_service.inference.native_model import NativeStereoModel
    from vergence_service.inference.onnx_model import OnnxStereoModel

log = logging.getLogger(__name__)

ServedModel: TypeAlias = "OnnxStereoModel | NativeStereoModel | OpenCvModel"

NATIVE_MODEL = "lite"  # the model that the native engine has kernels for


def load_model(
    weights_dir: Path,
    name: str,
    *,
    engine: str,
    providers: Sequence[str],
    threads: int,
    allow_spinning: bool,
) -> ServedModel:
    """Load a model into ``engine``: "auto", "native" or "onnxruntime".

    "auto" is native for `lite` on a CPU, if the library is there and knows the weights. `sgbm`,
    `sgbm-half` and `patchmatch` have no weights: OpenCV computes them, if the engine is "auto".

    Raises ManifestError if the manifest cannot be used, and ProviderUnavailable if the engine or
    its execution provider cannot be used.
    """
    if name in CLASSICAL_MODELS:
        if engine != "auto":
            raise ProviderUnavailable(
                f"OpenCV computes {name}; set model.engine to auto, not {engine!r}"
            )
        if name == PATCHMATCH_MODEL:
            return PatchMatchModel(threads=threads)
        return SgbmModel(name, threads=threads)
    try:
        from vergence_service.inference.native_model import NativeStereoModel
        from vergence_service.inference.onnx_model import OnnxStereoModel
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "onnxruntime":
            raise
        raise ProviderUnavailable(
            f"{name} needs onnxruntime, which is not installed; install it: "
            f"{how_to_install('server')}; or serve the classical baseline: --model sgbm"
        ) from None
    if engine == "native" and providers[0] != "cpu":
        raise ProviderUnavailable(
            f"the native engine runs on the CPU; set model.providers to cpu, not {providers[0]!r}, "
            "or model.engine to onnxruntime"
        )
    if engine == "native" or (engine == "auto" and name == NATIVE_MODEL and providers[0] == "cpu"):
        try:
            return NativeStereoModel(
                weights_dir, name, threads=threads, allow_spinning=allow_spinning
            )
        except ProviderUnavailable as error:
            if engine == "native":
                raise
            log.info("onnxruntime computes %s: %s", name, error)
    return OnnxStereoModel(
        weights_dir, name, providers=providers, threads=threads, allow_spinning=allow_spinning
    )
