"""Translate errors to google.rpc.Status, the payload of every error over Zenoh."""

import logging

from google.rpc import status_pb2

from vergence_proto import codec
from vergence_proto.errors import DepthError, ModelFailed
from vergence_service.transports.grpc.errors import GRPC_STATUS

log = logging.getLogger(__name__)


def status_of(error: Exception) -> status_pb2.Status:
    """Return the status of a DepthError; log any other error and report it as INTERNAL."""
    if not isinstance(error, DepthError):
        log.error("a call failed with an unexpected error", exc_info=error)
        error = ModelFailed("the server failed; its log has the reason")
    return codec.error_to_status(error, GRPC_STATUS[error.code].value[0])
