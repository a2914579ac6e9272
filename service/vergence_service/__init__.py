"""The server: keeps one recurrent state per stream and answers frames with disparity.

Read in this order: ``transports.depth_call``, ``engine``, ``streams``, ``batcher``, ``model``.
"""
