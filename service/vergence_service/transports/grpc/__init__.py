"""``vergence.v1.DepthService`` over gRPC. Read ``server``, then ``errors``."""
