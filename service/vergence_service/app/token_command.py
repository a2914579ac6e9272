"""The command ``vergence token``: add, list and remove the tokens of a server's users."""

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from vergence_service.access.principals import Principal, Role, checked_name
from vergence_service.access.tokens import (
    TokenFileError,
    digest_of,
    new_token,
    read_tokens,
    write_tokens,
)


class Action(StrEnum):
    """What to do with the tokens."""

    ADD = "add"
    LIST = "list"
    REMOVE = "remove"


def default_file() -> Path:
    """Return the file of tokens if none is named."""
    if file := os.environ.get("VERGENCE_SECURITY__TOKENS"):
        return Path(file)
    folder = os.environ.get("XDG_CONFIG_HOME")
    return (Path(folder) if folder else Path.home() / ".config") / "vergence" / "tokens.toml"


def token(
    action: Annotated[Action, typer.Argument(help="What to do.")],
    name: Annotated[str | None, typer.Argument(help="The principal: a user or device.")] = None,
    file: Annotated[
        Path | None, typer.Option(help="The server's file; default: security.tokens.")
    ] = None,
    role: Annotated[
        Role, typer.Option(help="An admin sees and ends what others have.")
    ] = Role.USER,
    streams: Annotated[
        int | None, typer.Option(min=1, help="Most open streams; default: the server's limit.")
    ] = None,
    weight: Annotated[
        float, typer.Option(min=0.01, help="Share of the machine, relative to others.")
    ] = 1.0,
) -> None:
    """Manage the tokens of a server. A running server reads the file when it changes.

    `add` prints a new token, once: the file has only its hash. `remove` ends the streams that were
    opened with the tokens of this name.
    """
    path = file or default_file()
    try:
        tokens = read_tokens(path) if path.exists() or action is not Action.ADD else {}
        if action is Action.LIST:
            for digest, each in tokens.items():
                typer.echo(f"{each.name}\t{each.role}\t{digest[:19]}")
            return
        if name is None:
            raise ValueError(f"vergence token {action} needs a name")
        if action is Action.REMOVE:
            left = {digest: each for digest, each in tokens.items() if each.name != name}
            if left == tokens:
                raise ValueError(f"{path} has no token of {name}")
            write_tokens(path, left)
            return
        made = new_token()
        tokens[digest_of(made)] = Principal(
            checked_name(name), role, streams=streams, weight=weight
        )
        write_tokens(path, tokens)
    except (TokenFileError, ValueError, OSError) as error:
        sys.stderr.write(f"vergence token: {error}\n")
        raise typer.Exit(2) from None
    typer.echo(made)
    typer.echo(f"kept as a hash in {path}: vergence serve --tokens {path}", err=True)
