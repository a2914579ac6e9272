"""The network that ships, in the engine that serves it. Its results depend on every bit."""

from vergence_service.inference.engines import load_model
from vergence_service.inference.model import StereoModel
from vergence_service.inference.onnx_model import packaged_weights_dir


def shipped_model() -> StereoModel:
    return load_model(
        packaged_weights_dir(),
        "lite",
        engine="auto",
        providers=["cpu"],
        threads=1,
        allow_spinning=False,
    )
