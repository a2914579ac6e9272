"""Web proxies that the environment names, and the servers that are reached without one."""

import os
from urllib.parse import urlsplit
from urllib.request import proxy_bypass

# In the order in which gRPC looks; it reads no other name and no capitals.
_GRPC_VARIABLES = ("grpc_proxy", "https_proxy", "http_proxy")


def through_proxy(server: str) -> str:
    """Return words for an error about ``server``: the proxy that leads to it, or nothing.

    ``server`` is ``grpc://HOST:PORT``, ``http://...`` or ``https://...``.
    """
    parts = urlsplit(server)
    lower = (f"{parts.scheme}_proxy", "all_proxy")
    either = tuple(name for each in lower for name in (each, each.upper()))
    names = _GRPC_VARIABLES if parts.scheme == "grpc" else either
    name = next((each for each in names if os.environ.get(each)), None)
    host = parts.hostname or ""
    if name is None or proxy_bypass(host):
        return ""
    return (
        f" (through the proxy of {name}={os.environ[name]}; to go without it, set no_proxy={host})"
    )
