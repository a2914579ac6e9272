"""The gate in front of every gRPC call."""

import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import ExitStack, asynccontextmanager
from typing import Any

import grpc

from vergence_service.access.gate import Gate
from vergence_service.streams.stream import TraceParent
from vergence_service.transports.callers import CALLER, TRACE_PARENT, trace_parent_of
from vergence_service.transports.grpc.errors import Context, errors_as_status

# A load balancer asks for the health without a credential.
_OPEN = "/grpc.health.v1.Health/"
_ADMINISTRATIVE = "/grpc.reflection."


class Identity(grpc.aio.ServerInterceptor):  # type: ignore[type-arg] # of its stubs only
    """Refuses a call without a valid credential, and names the caller of every other one."""

    def __init__(self, gate: Gate) -> None:
        self._gate = gate

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """Return the handler of a call, behind the gate."""
        handler = await continuation(handler_call_details)
        if handler is None or handler_call_details.method.startswith(_OPEN):
            return handler
        metadata = dict(handler_call_details.invocation_metadata or ())
        authorization = _text(metadata.get("authorization"))
        parent = trace_parent_of(_text(metadata.get("traceparent")))
        changed = {
            kind: self._behind(
                behaviour,
                authorization,
                parent,
                handler_call_details.method.startswith(_ADMINISTRATIVE),
            )
            for kind in ("unary_unary", "unary_stream", "stream_unary", "stream_stream")
            if (behaviour := getattr(handler, kind)) is not None
        }
        return handler._replace(**changed)

    def _behind(
        self,
        behaviour: Callable[..., Any],
        authorization: str | None,
        parent: TraceParent | None,
        administrative: bool,
    ) -> Any:
        async def answer(request: Any, context: Context) -> Any:
            TRACE_PARENT.set(parent)
            async with self._admitted(context, authorization, administrative):
                return await behaviour(request, context)

        async def answers(request: Any, context: Context) -> AsyncIterator[Any]:
            TRACE_PARENT.set(parent)
            async with self._admitted(context, authorization, administrative):
                async for each in behaviour(request, context):
                    yield each

        return answers if inspect.isasyncgenfunction(behaviour) else answer

    @asynccontextmanager
    async def _admitted(
        self, context: Context, authorization: str | None, administrative: bool
    ) -> AsyncIterator[None]:
        with ExitStack() as stack:
            async with errors_as_status(context):
                caller = self._gate.caller(authorization, _certificate_names(context))
                if administrative and not self._gate.open:
                    caller.check_admin()
                stack.enter_context(self._gate.requests.of(caller))
                CALLER.set(caller)
            yield


def _text(value: str | bytes | None) -> str | None:
    return value.decode("latin-1") if isinstance(value, bytes) else value


def _certificate_names(context: Context) -> Sequence[str]:
    """Return the names in the client's certificate: alternative names, then the common name."""
    properties = context.auth_context()
    names = [
        *properties.get("x509_subject_alternative_name", ()),
        *properties.get("x509_common_name", ()),
    ]
    return [name.decode("utf-8", "replace") for name in names]
