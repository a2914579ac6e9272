"""``vergence top``: a live table of the open streams of a server."""

import asyncio
from typing import Any

import httpx
from rich.console import Console
from rich.live import Live
from rich.table import Table

from vergence.cli.errors import CliError
from vergence.transports.addresses import is_private
from vergence.transports.credentials import Credentials
from vergence.transports.http import http_client

_COLUMNS = (
    "stream", "over", "size", "Hz", "age ms", "model s", "origin", "warm", "stepped", "dropped",
    "failed", "idle s",
)  # fmt: skip


async def top(server: str, console: Console, *, every_s: float, once: bool) -> None:
    """Show the streams until it is stopped. Raises CliError if the server does not answer."""
    address = server if "://" in server else f"http://{server}"
    shown = Credentials.of(None, None, None, None, private=is_private(address))
    async with http_client(
        address, headers=dict(shown.headers), verify=shown.tls(), timeout=10
    ) as http:
        if once:
            console.print(_table(await _streams(http)))
            return
        with Live(_table(await _streams(http)), console=console, auto_refresh=False) as live:
            while True:
                await asyncio.sleep(every_s)
                live.update(_table(await _streams(http)), refresh=True)


async def _streams(http: httpx.AsyncClient) -> list[dict[str, Any]]:
    try:
        answer = await http.get("/v1/admin/streams")
    except httpx.TransportError as error:
        raise CliError(f"no administrator's port answers at {http.base_url}: {error}") from None
    if answer.is_error:
        raise CliError(f"{http.base_url} answers {answer.status_code}: {answer.text[:300]}")
    rows: list[dict[str, Any]] = answer.json()
    return rows


def _table(streams: list[dict[str, Any]]) -> Table:
    table = Table(title=f"open streams: {len(streams)}", title_justify="left")
    for index, name in enumerate(_COLUMNS):
        table.add_column(name, justify="left" if index < 3 else "right")
    for each in streams:
        age_s = each["age_p50_s"]
        table.add_row(
            f"{each['principal']}/{each['stream_id']}",
            " ".join(filter(None, (each["transport"], each["address"]))),
            f"{each['width']}x{each['height']}",
            f"{each['rate_hz']:.1f}",
            "" if age_s is None else f"{1e3 * age_s:.0f}",
            f"{each['model_s']:.1f}",
            each["last_origin"] or "",
            str(each["warm_steps"]),
            str(each["frames_stepped"]),
            str(each["frames_dropped"]),
            str(each["frames_failed"]),
            f"{each['idle_s']:.0f}",
            style="" if each["attached"] else "dim",
        )
    return table
