"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from vergence.transports.addresses import connector


def checked_server(server: str | None) -> str | None:
    """Return the address. Raises typer.BadParameter: it is none."""
    if server is not None:
        try:
            connector(server)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
    return server


JsonOption = Annotated[
    Path | None, typer.Option("--json", help="Write the figures of the table to this file.")
]
CalibOption = Annotated[
    Path | None,
    typer.Option(help="Calibration of images or a camera, as vergence calib reads it."),
]
FocalLengthOption = Annotated[
    float | None, typer.Option("--fx", min=0, help="Focal length of rectified images, in pixels.")
]
BaselineOption = Annotated[
    float | None, typer.Option("--baseline", min=0, help="Distance of the two cameras, in metres.")
]
RateOption = Annotated[
    str,
    typer.Option(
        "--rate", help="max: every frame, losslessly. HZ or source: live, newest frames win."
    ),
]
ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        help="HOST:PORT or zenoh://HOST:PORT of a running server; default: start one.",
        callback=checked_server,
    ),
]
