"""The step of `lite` in C, for the CPUs that people have.

Its answers do not depend on the CPU's instructions or the number of threads. The package imports no
other package of the project; the service and the models may import it.
"""

from vergence_native.library import NativeUnavailable, NotFinite, available, variants
from vergence_native.lite import LiteResult, LiteStep, Threads
from vergence_native.onnx_graph import UnsupportedWeights

__all__ = [
    "LiteResult",
    "LiteStep",
    "NativeUnavailable",
    "NotFinite",
    "Threads",
    "UnsupportedWeights",
    "available",
    "variants",
]
