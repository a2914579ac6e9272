"""Translate DepthError to HTTP: a status, and problem details (RFC 9457) with gRPC's reason."""

import http
import logging
import math
import sqlite3
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from vergence_proto.errors import BadShape, DepthError, ErrorCode, InsufficientStorage
from vergence_service.jobs.storage import disk_trouble
from vergence_service.process.failures import error_of

log = logging.getLogger(__name__)

PROBLEM_TYPE = "application/problem+json"

HTTP_STATUS: Mapping[ErrorCode, int] = {
    ErrorCode.BAD_IMAGE: 400,
    ErrorCode.BAD_POSE: 400,
    ErrorCode.BAD_SHAPE: 400,
    ErrorCode.BAD_CALIBRATION: 400,
    ErrorCode.BAD_SEQUENCE: 400,
    ErrorCode.UNAUTHENTICATED: 401,
    ErrorCode.FORBIDDEN: 403,
    ErrorCode.CLIENT_TIMEOUT: 408,
    ErrorCode.STREAM_UNKNOWN: 404,
    ErrorCode.SEQUENCE_UNKNOWN: 404,
    ErrorCode.STREAM_EXPIRED: 410,
    ErrorCode.STREAM_EXISTS: 409,
    ErrorCode.SUPERSEDED: 409,
    ErrorCode.FRAME_OUT_OF_ORDER: 409,
    ErrorCode.MODEL_CHANGED: 409,
    ErrorCode.SEQUENCE_NOT_DONE: 409,
    ErrorCode.FRAME_TOO_LARGE: 413,
    ErrorCode.UPLOAD_TOO_LARGE: 413,
    ErrorCode.STREAM_LIMIT: 429,
    ErrorCode.STATE_MEMORY: 429,
    ErrorCode.QUOTA: 429,
    ErrorCode.QUEUE_FULL: 429,
    ErrorCode.INSUFFICIENT_STORAGE: 507,
    ErrorCode.KEY_REUSED: 422,
    ErrorCode.KEY_IN_USE: 409,
    ErrorCode.FRAME_STALE: 504,
    ErrorCode.DRAINING: 503,
    ErrorCode.NOT_READY: 503,
    ErrorCode.MODEL_FAILED: 500,
    ErrorCode.NON_FINITE: 500,
}


class Problem(BaseModel):
    """The reason why a request was refused."""

    title: str
    status: int
    detail: str = Field(description="what was expected, what was received, what to do next")
    reason: ErrorCode | None = Field(
        default=None, description="the same as google.rpc.ErrorInfo.reason over gRPC"
    )


# The answer of every operation to an error.
PROBLEM_RESPONSE: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "A problem",
        "content": {
            PROBLEM_TYPE: {
                "schema": {"$ref": "#/components/schemas/Problem"},
                "example": {
                    "title": "Not Found",
                    "status": 404,
                    "detail": "no sequence '5f0c': it never existed, was deleted, or its result "
                    "expired, 24 h after its end",
                    "reason": "SEQUENCE_UNKNOWN",
                },
            }
        },
    }
}


def problem_of(error: DepthError) -> Problem:
    """Translate an error to problem details."""
    status = HTTP_STATUS[error.code]
    return Problem(
        title=http.HTTPStatus(status).phrase, status=status, detail=str(error), reason=error.code
    )


def install_problems(app: FastAPI) -> None:
    """Answer every error in ``app`` with problem details."""

    @app.exception_handler(DepthError)
    async def _refused(request: Request, error: DepthError) -> JSONResponse:
        return refusal_of(error)

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        problems = "; ".join(
            f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()
        )
        return _response(problem_of(BadShape(problems)))

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        title = http.HTTPStatus(error.status_code).phrase
        problem = Problem(title=title, status=error.status_code, detail=error.detail)
        return _response(problem, headers=error.headers)

    @app.exception_handler(OSError)
    @app.exception_handler(sqlite3.Error)
    async def _disk(request: Request, error: Exception) -> JSONResponse:
        trouble = disk_trouble(error)
        if trouble is None:
            return await _unforeseen(request, error)
        log.warning("a request was refused, because %s: %s", trouble, error)
        return _response(problem_of(InsufficientStorage(f"{trouble}; try again later")))

    @app.exception_handler(Exception)
    async def _unforeseen(request: Request, error: Exception) -> JSONResponse:
        known = error_of(error, log, "a request")
        return _response(problem_of(known), retry_after_s=known.retry_after_s)


def refusal_of(error: DepthError) -> JSONResponse:
    """Return the answer to a request that was refused."""
    headers = {"WWW-Authenticate": "Bearer"} if error.code is ErrorCode.UNAUTHENTICATED else {}
    return _response(problem_of(error), retry_after_s=error.retry_after_s, headers=headers)


def _response(
    problem: Problem,
    *,
    retry_after_s: float | None = None,
    headers: Mapping[str, str] | None = None,
) -> JSONResponse:
    all_headers = dict(headers or {})
    if problem.status == http.HTTPStatus.REQUEST_TIMEOUT:
        all_headers["Connection"] = "close"  # the rest of the body is not waited for
    if retry_after_s is not None:
        all_headers["Retry-After"] = str(max(math.ceil(retry_after_s), 1))
    content = problem.model_dump(mode="json", exclude_none=True)
    return JSONResponse(content, problem.status, all_headers, media_type=PROBLEM_TYPE)
