"""Networks of others: any stereo graph in ONNX, wrapped into the contract of a served model."""
