"""The command ``vergence zenoh-config``: users and access control of a server's Zenoh router."""

import json
import os
import secrets
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vergence_service.access.tokens import TokenFileError, read_tokens
from vergence_service.access.zenoh_rules import client_config, router_config
from vergence_service.app.token_command import default_file

_MAX_MESSAGE_BYTES = 40 << 20  # 1.25 times the default of limits.max_frame_mib


def zenoh_config(
    out: Annotated[Path, typer.Argument(help="Folder for the files.")],
    tokens: Annotated[
        Path | None, typer.Option(help="The server's file of tokens; default: security.tokens.")
    ] = None,
    endpoint: Annotated[
        str, typer.Option(help="Where the server listens; tls/HOST:PORT with a certificate.")
    ] = "tcp/127.0.0.1:7447",
    tls_cert: Annotated[Path | None, typer.Option(help="PEM file with the certificate.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="PEM file with its key.")] = None,
    namespace: Annotated[str, typer.Option(help="The setting zenoh.namespace.")] = "vergence",
) -> None:
    """Write Zenoh's users and access control for the principals of the tokens.

    OUT/server.json5 is for the setting zenoh.config, OUT/users.txt has the passwords, and
    OUT/NAME.json5 is for the client of a user: zenoh://HOST:PORT?config=NAME.json5. Passwords that
    exist are kept. Zenoh reads the files only when the server starts.
    """
    try:
        if (tls_cert is None) != (tls_key is None) or endpoint.startswith("tls/") != bool(tls_cert):
            raise ValueError("an endpoint tls/HOST:PORT needs --tls-cert and --tls-key")
        names = {each.name for each in read_tokens(tokens or default_file()).values()}
        certificate = None
        if tls_cert is not None and tls_key is not None:
            certificate = (tls_cert.absolute(), tls_key.absolute())
        users = out.absolute() / "users.txt"
        out.mkdir(parents=True, exist_ok=True)
        passwords = _passwords(users)
        passwords = {name: passwords.get(name) or secrets.token_urlsafe(24) for name in names}
        _write(users, "".join(f"{name}:{passwords[name]}\n" for name in sorted(names)))
        config = router_config(
            names,
            namespace=namespace,
            endpoint=endpoint,
            users=users,
            certificate=certificate,
            max_message_bytes=_MAX_MESSAGE_BYTES,
        )
        _write(out / "server.json5", _json(config))
        for name in names:
            _write(out / f"{name}.json5", _json(client_config(name, passwords[name])))
    except (TokenFileError, ValueError, OSError) as error:
        sys.stderr.write(f"vergence zenoh-config: {error}\n")
        raise typer.Exit(2) from None
    typer.echo(f"wrote the rules of {len(names)} users: zenoh.config = {out / 'server.json5'}")


def _passwords(users: Path) -> dict[str, str]:
    if not users.exists():
        return {}
    pairs = (line.partition(":") for line in users.read_text("utf-8").splitlines())
    return {name: password for name, _, password in pairs}


def _write(path: Path, text: str) -> None:
    """Write a file that only its owner can read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        os.chmod(path, 0o600)  # it may have existed
        file.write(text)


def _json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2) + "\n"
