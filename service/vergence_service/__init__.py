"""The server: keeps one recurrent state per stream and answers frames with disparity.

Read in this order: ``transports.grpc_stream``, ``engine``, ``streams``, ``batcher``, ``model``.
"""
