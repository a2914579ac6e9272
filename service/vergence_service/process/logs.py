"""The log: one line for each event, at a bounded rate."""

import errno
import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime

# Of messages from one place in the code, so many are written in each period.
_MOST = 10
_PERIOD_S = 60.0
_MOST_EVENTS = 600  # opened, closed, refused: an operator wants each of them
_FIELDS = "vergence_fields"
_MARK = "_vergence_logged"
# The operating system has no more of something. A traceback says no more than the error's text.
_SCARCE = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


def start_logging(level: str, *, form: str = "text") -> None:
    """Write the log to stderr, from ``level`` on; ``form`` is text or json."""
    logging.basicConfig(
        level=level.upper(), format="%(asctime)s %(levelname)s %(name)s %(message)s"
    )
    for handler in logging.getLogger().handlers:
        handler.addFilter(BoundedRate())
        if form == "json":
            handler.setFormatter(JsonLines())
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)  # says "started" too early


def log_event(log: logging.Logger, what: str, /, **fields: object) -> None:
    """Write one line of an event: words, then what it is about as ``name=value``."""
    named = {name: value for name, value in fields.items() if value not in (None, "")}
    text = " ".join([what, *(f"{name}={value}" for name, value in named.items())])
    log.info("%s", text, extra={_FIELDS: {"event": what, **named}}, stacklevel=2)


class JsonLines(logging.Formatter):
    """One JSON object a line, with the time in UTC and the fields of an event."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        time_utc = datetime.fromtimestamp(record.created, UTC)
        line: dict[str, object] = {
            "time": time_utc.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, _FIELDS, {}),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class BoundedRate(logging.Filter):
    """Passes at most ten records a minute from each place in the code, and says what it leaves out.

    Clients can cause a message as often as they like, and without descriptors asyncio writes a
    thousand tracebacks a second.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        # Of each place, by file and line: when its period began, and how many came since.
        self._seen: dict[tuple[str, int], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Decide whether the record is written, and shorten it."""
        if _seen_before(record):
            return False
        place = (record.pathname, record.lineno)
        most = _MOST_EVENTS if hasattr(record, _FIELDS) else _MOST
        now_s = self._clock()
        with self._lock:
            began_s, count = self._seen.get(place, (now_s, 0))
            left_out = 0
            if now_s - began_s >= _PERIOD_S:
                left_out = max(count - most, 0)
                began_s, count = now_s, 0
            self._seen[place] = (began_s, count + 1)
        if count >= most:
            return False
        _shorten(record)
        if left_out:
            _append(record, f" ({left_out} more in the last period)")
        if count + 1 == most:
            _append(record, f" (more like this are left out for {_PERIOD_S:.0f} s)")
        return True


def _seen_before(record: logging.LogRecord) -> bool:
    """Return True for an exception that is logged again: uvicorn repeats what the routes log."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return False
    seen = getattr(error, _MARK, False)
    with suppress(AttributeError):  # an exception without a dictionary
        setattr(error, _MARK, True)
    return bool(seen)


def _shorten(record: logging.LogRecord) -> None:
    """Leave the traceback of an operating system's shortage out, and lines after the first."""
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _SCARCE):
        record.exc_info = record.exc_text = None
        _append(record, f": {error or 'out of memory'}")


def _append(record: logging.LogRecord, text: str) -> None:
    [first, *_] = record.getMessage().splitlines() or [""]
    record.msg, record.args = first + text, None
