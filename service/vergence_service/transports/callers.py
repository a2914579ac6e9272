"""The caller of the request that is being answered, and the span of a trace that it belongs to."""

import re
from contextvars import ContextVar

from vergence_service.access.principals import Principal
from vergence_service.streams.stream import TraceParent

# Set where a request enters, before any handler runs. It has no default: a request that came past
# the gate must fail.
CALLER: ContextVar[Principal] = ContextVar("caller")
# Of the header ``traceparent`` (W3C Trace Context).
TRACE_PARENT: ContextVar[TraceParent | None] = ContextVar("trace_parent", default=None)
_TRACEPARENT = re.compile(
    r"[0-9a-f]{2}-(?!0{32})([0-9a-f]{32})-(?!0{16})([0-9a-f]{16})-([0-9a-f]{2})(-.*)?"
)


def trace_parent_of(traceparent: str | None) -> TraceParent | None:
    """Return the span that a header names; None if there is none, or no valid one."""
    found = _TRACEPARENT.fullmatch((traceparent or "")[:200])
    return TraceParent(found[1], found[2], found[3]) if found else None
