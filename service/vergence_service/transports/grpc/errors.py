"""Translate DepthError to gRPC: a status, with google.rpc.ErrorInfo for programs."""

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any

import grpc
from grpc_status import rpc_status

from vergence_proto import codec
from vergence_proto.errors import DepthError, ErrorCode
from vergence_service.process.failures import error_of

log = logging.getLogger(__name__)

# Requests and responses have a different type in each call; nothing here reads them.
Context = grpc.aio.ServicerContext[Any, Any]

GRPC_STATUS: Mapping[ErrorCode, grpc.StatusCode] = {
    ErrorCode.BAD_IMAGE: grpc.StatusCode.INVALID_ARGUMENT,
    ErrorCode.BAD_POSE: grpc.StatusCode.INVALID_ARGUMENT,
    ErrorCode.BAD_SHAPE: grpc.StatusCode.INVALID_ARGUMENT,
    ErrorCode.BAD_CALIBRATION: grpc.StatusCode.INVALID_ARGUMENT,
    ErrorCode.STREAM_UNKNOWN: grpc.StatusCode.NOT_FOUND,
    ErrorCode.STREAM_EXPIRED: grpc.StatusCode.NOT_FOUND,
    ErrorCode.STREAM_EXISTS: grpc.StatusCode.ALREADY_EXISTS,
    ErrorCode.SUPERSEDED: grpc.StatusCode.ABORTED,
    ErrorCode.FRAME_OUT_OF_ORDER: grpc.StatusCode.FAILED_PRECONDITION,
    ErrorCode.MODEL_CHANGED: grpc.StatusCode.FAILED_PRECONDITION,
    ErrorCode.STREAM_LIMIT: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.STATE_MEMORY: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.QUOTA: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.FRAME_TOO_LARGE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.FRAME_STALE: grpc.StatusCode.DEADLINE_EXCEEDED,
    ErrorCode.CLIENT_TIMEOUT: grpc.StatusCode.DEADLINE_EXCEEDED,
    ErrorCode.DRAINING: grpc.StatusCode.UNAVAILABLE,
    ErrorCode.NOT_READY: grpc.StatusCode.UNAVAILABLE,
    ErrorCode.MODEL_FAILED: grpc.StatusCode.INTERNAL,
    ErrorCode.NON_FINITE: grpc.StatusCode.INTERNAL,
    ErrorCode.BAD_SEQUENCE: grpc.StatusCode.INVALID_ARGUMENT,
    ErrorCode.UPLOAD_TOO_LARGE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.SEQUENCE_UNKNOWN: grpc.StatusCode.NOT_FOUND,
    ErrorCode.SEQUENCE_NOT_DONE: grpc.StatusCode.FAILED_PRECONDITION,
    ErrorCode.QUEUE_FULL: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.INSUFFICIENT_STORAGE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ErrorCode.UNAUTHENTICATED: grpc.StatusCode.UNAUTHENTICATED,
    ErrorCode.FORBIDDEN: grpc.StatusCode.PERMISSION_DENIED,
    ErrorCode.KEY_REUSED: grpc.StatusCode.INVALID_ARGUMENT,
    ErrorCode.KEY_IN_USE: grpc.StatusCode.ABORTED,
}


async def abort(context: Context, error: DepthError) -> None:
    """End the call with the error. Does not return."""
    code = GRPC_STATUS[error.code]
    status = codec.error_to_status(error, code.value[0])
    trailing_metadata = rpc_status.to_status(status).trailing_metadata
    with suppress(grpc.aio.InternalError):  # the client is gone
        await context.abort(code, str(error), trailing_metadata)
    raise asyncio.CancelledError  # gRPC takes it as the end of the call


@asynccontextmanager
async def errors_as_status(context: Context) -> AsyncIterator[None]:
    """End the call with the DepthError that the block raises; report other errors as INTERNAL."""
    try:
        yield
    except (grpc.aio.AbortError, grpc.aio.UsageError):
        raise
    except Exception as error:
        await abort(context, error_of(error, log, "a call"))
