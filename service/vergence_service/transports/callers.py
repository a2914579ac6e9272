"""The caller of the request that is being answered, and the trace that it belongs to."""

import re
from contextvars import ContextVar

from vergence_service.access.principals import Principal

# Set where a request enters, before any handler runs. It has no default: a request that came past
# the gate must fail.
CALLER: ContextVar[Principal] = ContextVar("caller")
# Of the header ``traceparent`` (W3C Trace Context), so that the log can be found from a trace.
TRACE_ID: ContextVar[str] = ContextVar("trace_id", default="")
_TRACEPARENT = re.compile(r"[0-9a-f]{2}-(?!0{32})([0-9a-f]{32})-[0-9a-f]{16}-[0-9a-f]{2}(-.*)?")


def trace_id_of(traceparent: str | None) -> str:
    """Return the id of a trace, 32 hexadecimal digits; empty if there is none, or no valid one."""
    found = _TRACEPARENT.fullmatch((traceparent or "")[:200])
    return found[1] if found else ""
