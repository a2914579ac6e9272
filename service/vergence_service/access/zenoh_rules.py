"""Access control of a Zenoh router: every user has its own keys, and only the server answers.

Zenoh forbids what no rule allows. Its rules match keys with wildcards, but no wildcard matches a
part of a key that begins with @.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vergence_proto.zenoh.link_settings import LEASE_MS, WAITS_BEFORE_DROP


def router_config(
    names: Iterable[str],
    *,
    namespace: str,
    endpoint: str,
    users: Path,
    certificate: tuple[Path, Path] | None,
    max_message_bytes: int,
) -> dict[str, Any]:
    """Return the configuration of a server that is the router of these users.

    ``users`` is the file of their passwords; ``certificate`` and its key are for an endpoint with
    TLS. The keys are those of :mod:`vergence_proto.zenoh.keys`.
    """
    link: dict[str, Any] = {
        "tx": {
            "lease": LEASE_MS,
            "queue": {"congestion_control": {"drop": dict(WAITS_BEFORE_DROP)}},
        },
        "rx": {"max_message_size": max_message_bytes},
    }
    if certificate is not None:
        link["tls"] = {
            "listen_certificate": str(certificate[0]),
            "listen_private_key": str(certificate[1]),
        }
    names = sorted(names)
    rules = {name: _rules(namespace, name) for name in names}
    return {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "transport": {
            "link": link,
            "auth": {"usrpwd": {"dictionary_file": str(users)}},
        },
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [rule for name in names for rule in rules[name]],
            "subjects": [{"id": name, "usernames": [name]} for name in names],
            "policies": [
                {"subjects": [name], "rules": [rule["id"] for rule in rules[name]]}
                for name in names
            ],
        },
    }


def client_config(name: str, password: str) -> dict[str, Any]:
    """Return the configuration of a client, for ``zenoh://HOST:PORT?config=FILE``."""
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "transport": {
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "queue": {"congestion_control": {"drop": dict(WAITS_BEFORE_DROP)}},
                }
            },
            "auth": {"usrpwd": {"user": name, "password": password}},
        },
        "connect": {
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2}
        },
    }


def _rules(namespace: str, name: str) -> list[dict[str, Any]]:
    own = f"{namespace}/v1/@{name}"
    both, answers = ["ingress", "egress"], ["reply", "declare_queryable"]
    liveliness = ["liveliness_token", "declare_liveliness_subscriber", "liveliness_query"]
    return [
        _allow(f"{name}-streams", both, ["put", "declare_subscriber"], f"{own}/*/*"),
        _allow(f"{name}-asks", ["ingress"], ["query"], f"{own}/@server/*/*"),
        _allow(f"{name}-is-answered", ["egress"], answers, f"{own}/@server/*/*"),
        _allow(f"{name}-is-alive", ["ingress"], ["liveliness_token"], f"{own}/*/@client/*"),
        _allow(f"{name}-sees-servers", ["ingress"], liveliness[1:], f"{namespace}/v1/@server/*"),
        _allow(f"{name}-hears-of-servers", ["egress"], liveliness, f"{namespace}/v1/@server/*"),
    ]


def _allow(name: str, flows: list[str], messages: list[str], key: str) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": [key],
    }
