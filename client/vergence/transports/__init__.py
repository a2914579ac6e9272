"""Transports to a server: gRPC, HTTP and Zenoh. A transport translates and does nothing else."""

import os

# gRPC's own handlers of fork crash the child while a channel is open. Without them it lives on and
# gets a clear error.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")

# Otherwise gRPC prints a line for every idle connection that a server closes.
os.environ.setdefault("GRPC_VERBOSITY", "ERROR")
