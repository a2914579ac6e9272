"""ONNX graphs of a trained network: exported in parts, stitched, cut into stages, made int8."""
