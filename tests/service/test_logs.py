"""One line for each event at a bounded rate; decoders are counted and write nothing."""

import errno
import json
import logging
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.support.server import ManualClock
from vergence_proto.errors import BadShape, ModelFailed, NotReady, StateMemory
from vergence_service.process.failures import error_of
from vergence_service.process.logs import BoundedRate, JsonLines
from vergence_service.process.native_output import decoder_of


class Lines(logging.Handler):
    """A handler that keeps what it would write."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.addFilter(BoundedRate(clock=clock))

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def lines(clock: ManualClock) -> Iterator[Lines]:
    handler, log = Lines(clock), logging.getLogger("test.bounded")
    log.addHandler(handler)
    log.propagate = False
    yield handler
    log.removeHandler(handler)


def test_a_message_is_written_ten_times_a_minute_and_the_rest_is_counted(
    lines: Lines, clock: ManualClock
) -> None:
    log = logging.getLogger("test.bounded")
    for _ in range(5):  # minutes
        for index in range(1000):
            log.warning("refused %d", index)
        log.warning("another message")
        clock.advance(60)
    assert len(lines.lines) == 5 * 11
    assert lines.lines[0] == "refused 0"
    assert lines.lines[9] == "refused 9 (more like this are left out for 60 s)"
    assert lines.lines[10] == "another message"
    assert lines.lines[11] == "refused 0 (990 more in the last period)"


@pytest.mark.parametrize("error", [OSError(errno.EMFILE, "Too many open files"), MemoryError()])
def test_a_shortage_is_one_line_without_a_traceback(lines: Lines, error: Exception) -> None:
    log = logging.getLogger("test.bounded")
    log.error("socket.accept() out of system resource\nsocket: <socket>", exc_info=error)
    log.error("a call failed", exc_info=ValueError("a bug"))
    assert len(lines.lines[0].splitlines()) == 1
    assert lines.lines[0].startswith("socket.accept() out of system resource: ")
    assert "ValueError: a bug" in lines.lines[1]


def test_an_exception_is_logged_once(lines: Lines) -> None:
    log = logging.getLogger("test.bounded")
    error = ValueError("a bug")
    log.error("a request failed", exc_info=error)
    log.error("Exception in ASGI application", exc_info=error)
    assert [line.splitlines()[0] for line in lines.lines] == ["a request failed"]


@pytest.mark.parametrize(
    ("error", "known", "logged"),
    [
        (BadShape("a"), BadShape, False),
        (MemoryError(), StateMemory, False),
        (ExceptionGroup("tasks", [ValueError(), MemoryError()]), StateMemory, False),
        (OSError(errno.EMFILE, "Too many open files"), NotReady, False),
        (OSError(errno.ENOENT, "No such file"), ModelFailed, True),
        (ValueError("secret"), ModelFailed, True),
    ],
    ids=repr,
)
def test_a_shortage_is_reported_as_one_and_a_bug_without_its_text(
    error: Exception, known: type[Exception], logged: bool, caplog: pytest.LogCaptureFixture
) -> None:
    found = error_of(error, logging.getLogger("test"), "a call")
    assert type(found) is known
    assert "secret" not in str(found)
    assert bool(caplog.records) == logged


def test_lines_of_decoders_are_known() -> None:
    assert decoder_of("libpng error: IDAT: CRC error\n") == "png"
    assert decoder_of("Corrupt JPEG data: premature end of data segment\n") == "jpeg"
    assert decoder_of("E1126 listener.cc:164] File descriptor limit reached\n") is None


_DECODES = """
import ctypes, json, logging, os, random, sys
from collections import Counter
from tests.support.mutants import damaged, image_files
from vergence_proto.codec.images import decode_image
from vergence_proto.errors import BadImage
from vergence_service.process.native_output import native_output

logging.basicConfig(stream=sys.stdout, format="log: %(message)s")
chance, files = random.Random(3), list(image_files().values())
counts = Counter()
with native_output(lambda decoder: counts.update([decoder])):
    for _ in range(400):
        try:
            decode_image(damaged(chance.choice(files), chance))
        except BadImage:
            pass
    libc = ctypes.CDLL(None)
    libc.perror(b"another library")
os.write(2, b"after\\n")
print(json.dumps(counts))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc's stderr can be replaced")
def test_decoders_are_counted_and_write_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _DECODES], capture_output=True, text=True, check=True
    )
    assert done.stderr == "after\n"
    other, counts = done.stdout.splitlines()
    assert other.startswith("log: another library")
    assert json.loads(counts)["png"] > 0
    assert json.loads(counts)["jpeg"] > 0


def test_an_event_is_one_json_object_with_its_fields() -> None:
    record = logging.LogRecord(
        "a", logging.INFO, "a.py", 1, "%s", ("stream closed stream=x",), None
    )
    record.vergence_fields = {"event": "stream closed", "stream": "x", "principal": "ana"}
    line = json.loads(JsonLines().format(record))
    assert (line["event"], line["stream"], line["principal"]) == ("stream closed", "x", "ana")
    assert line["time"].endswith("Z")
    assert line["level"] == "info"
