"""Translate errors to google.rpc.Status, the payload of every error over Zenoh."""

import logging

from google.rpc import status_pb2

from vergence_proto import codec
from vergence_service.process.failures import error_of
from vergence_service.transports.grpc.errors import GRPC_STATUS

log = logging.getLogger(__name__)


def status_of(error: Exception) -> status_pb2.Status:
    """Return the status of a DepthError; log an unexpected error and report it as INTERNAL."""
    known = error_of(error, log, "a call")
    return codec.error_to_status(known, GRPC_STATUS[known.code].value[0])
