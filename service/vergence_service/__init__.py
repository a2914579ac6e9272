"""The server: keeps one recurrent state per stream and answers frames with disparity.

Read in this order: ``transports.stream_call``, ``streams.engine``, ``streams.stream``,
``inference.batcher``, ``inference.model``.
"""
