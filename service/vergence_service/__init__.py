"""The server: it keeps one recurrent state per stream and answers frames with disparity.

Read the packages from the bottom up: ``process`` (threads, memory, metrics) and ``access``
(principals), ``inference`` (the model), ``snapshots``, ``streams`` (states and the engine),
``jobs`` (uploaded sequences), ``transports`` (gRPC, HTTP, Zenoh), ``settings``, ``app``.
"""

import os

# onnxruntime reads it when it is imported. Without it, the Linux wheels from 1.29 on send names and
# hashes of models, and facts about the machine, to Microsoft.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
