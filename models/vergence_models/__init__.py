"""The research part: networks, synthetic data, training, evaluation, export and studies."""

import os

# onnxruntime reads it when it is imported. Without it, the Linux wheels from 1.29 on send names and
# hashes of models, and facts about the machine, to Microsoft.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
