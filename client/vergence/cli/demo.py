"""``vergence demo``: stream the bundled sequence through a server and draw a picture."""

import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import aclosing
from functools import partial
from importlib import resources
from pathlib import Path

from rich.console import Console

from vergence.cli.captions import WITH_SIGMA, row_of, shown_in_sheet, title_of, write_sheet
from vergence.cli.json_file import write_json
from vergence.cli.local_server import server_for
from vergence.cli.pictures import Row, Video
from vergence.cli.progress import progress_bar
from vergence.cli.report import Report
from vergence.cli.sources import source_at
from vergence.cli.streaming import AnsweredFrame, every_frame
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence_proto.datasets import SourceFrame
from vergence_proto.film import CannotFilm
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Delivery

_FPS_UNKNOWN = 30.0


def bundled_sample() -> str:
    """Return the bundled sequence as ``KIND:PATH``."""
    return f"vergence:{resources.files('vergence') / 'sample' / 'room'}"


async def demo(
    source_text: str,
    *,
    server: str | None,
    frames: int | None,
    out: Path,
    json: Path | None,
    console: Console,
) -> None:
    """Stream a source losslessly; show and save the results. ``server``: None: start one."""
    source = source_at(source_text)
    # Read before the clock starts: a camera does not decode files.
    filmed = list(source)[:frames]
    report = Report()
    pixels = source.rig.left.width * source.rig.left.height
    async with (
        server_for(server, console, pixels=pixels) as address,
        DepthClient(address) as client,
    ):
        if server is not None:
            await client.server_info()  # a session would wait for a server that is not there
        async with client.open_session(
            source.rig, delivery=Delivery.EVERY, output=WITH_SIGMA
        ) as session:
            rig = session.rig if source.metric else None
            title = title_of(source.name, source.rig, session.model.name)
            started_s = time.monotonic()
            answers = await _stream(session, filmed, console)
            report.seconds = time.monotonic() - started_s
    for answered in answers:
        report.add(answered.latency_s, answered.result.timings.model_s, answered.accuracy())
    video = partial(Video, title=title, fps=source.fps or _FPS_UNKNOWN, rig=rig)
    _draw(title, [row_of(answered) for answered in answers], rig, video, out, console)
    console.print(report.as_table(title))
    if json is not None:
        write_json(json, report.as_json())


async def _stream(
    session: DepthSession, frames: Sequence[SourceFrame], console: Console
) -> list[AnsweredFrame]:
    answers: list[AnsweredFrame] = []
    with progress_bar(console) as progress:
        bar = progress.add_task("streaming", total=len(frames), note="")
        async with aclosing(every_frame(session, _as_read(frames), in_flight=1)) as stream:
            async for answered in stream:
                answers.append(answered)
                progress.update(bar, advance=1, note=f"{1e3 * answered.latency_s:.0f} ms")
    return answers


async def _as_read(frames: Sequence[SourceFrame]) -> AsyncIterator[tuple[int, SourceFrame]]:
    for index, frame in enumerate(frames):
        yield index, frame


def _draw(
    title: str,
    rows: Sequence[Row],
    rig: RectifiedRig | None,
    make_video: Callable[[Path, Row], Video],
    out: Path,
    console: Console,
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    write_sheet(out / "demo.png", title, [rows[index] for index in shown_in_sheet(len(rows))], rig)
    console.print(f"picture  {out / 'demo.png'}")
    try:
        with make_video(out / "demo.mp4", rows[0]) as video:
            for row in rows:
                video.add(row)
    except CannotFilm as error:
        console.print(f"[yellow]no video: {error}[/]")
    else:
        console.print(f"video    {out / 'demo.mp4'}")
