"""The model as a pure function from a view and a state to disparity and the next state.

Read ``model`` first, then ``batcher`` and ``arrivals`` (scheduling), then ``onnx_model``,
``graphs`` and ``providers`` (execution in onnxruntime). ``snapshots`` writes states as bytes.
"""
