"""The server: it keeps one recurrent state per stream and answers frames with disparity.

Read the packages from the bottom up: ``inference`` (the model), ``streams`` (states and the
engine), ``jobs`` (uploaded sequences), ``transports`` (gRPC, HTTP, Zenoh), ``app`` (composition).
"""
