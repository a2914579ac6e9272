"""Transports to a server: gRPC, HTTP and Zenoh. A transport translates and does nothing else."""

import os

# gRPC's own handlers of fork crash the child while a channel is open. Without them the child can
# still be told what is wrong, and a fork before or after works.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")
