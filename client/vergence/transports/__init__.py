"""Transports to a server: gRPC, HTTP and Zenoh. A transport translates and does nothing else."""
