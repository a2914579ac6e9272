"""The caller of the request that is being answered."""

from contextvars import ContextVar

from vergence_service.access.principals import Principal

# Set where a request enters, before any handler runs. It has no default: a request that came past
# the gate must fail.
CALLER: ContextVar[Principal] = ContextVar("caller")
