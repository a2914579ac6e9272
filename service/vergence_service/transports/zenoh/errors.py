"""Errors to google.rpc.Status, the payload of whatever fails over Zenoh."""

import logging

from google.rpc import status_pb2

from vergence_proto import codec
from vergence_proto.errors import DepthError, ModelFailed
from vergence_service.transports.grpc.errors import GRPC_STATUS

log = logging.getLogger(__name__)


def status_of(error: Exception) -> status_pb2.Status:
    """The status of a DepthError; anything else is logged, and told as INTERNAL."""
    if not isinstance(error, DepthError):
        log.error("a call failed in a way that nobody foresaw", exc_info=error)
        error = ModelFailed("the server failed; its log says why")
    return codec.error_to_status(error, GRPC_STATUS[error.code].value[0])
