"""DepthError as a ``google.rpc.Status``, with ErrorInfo and, if waiting helps, RetryInfo."""

from google.protobuf.duration_pb2 import Duration
from google.rpc import error_details_pb2, status_pb2

from vergence_proto.errors import ERROR_DOMAIN, DepthError, error_from_wire


def error_to_status(error: DepthError, code: int) -> status_pb2.Status:
    """Encode an error; ``code`` is its gRPC status, a number of ``google.rpc.Code``."""
    status = status_pb2.Status(code=code, message=str(error))
    info = error_details_pb2.ErrorInfo(reason=error.code, domain=ERROR_DOMAIN)
    status.details.add().Pack(info)
    if error.retry_after_s is not None:
        delay = Duration()
        delay.FromNanoseconds(int(error.retry_after_s * 1e9))
        status.details.add().Pack(error_details_pb2.RetryInfo(retry_delay=delay))
    return status


def error_from_status(status: status_pb2.Status) -> DepthError | None:
    """Return the error that was raised, or None for a status that Vergence did not make."""
    retry_after_s, info = None, None
    for detail in status.details:
        if detail.Is(error_details_pb2.RetryInfo.DESCRIPTOR):
            retry = error_details_pb2.RetryInfo.FromString(detail.value)
            retry_after_s = retry.retry_delay.ToTimedelta().total_seconds()
        elif detail.Is(error_details_pb2.ErrorInfo.DESCRIPTOR):
            info = error_details_pb2.ErrorInfo.FromString(detail.value)
    if info is None or info.domain != ERROR_DOMAIN:
        return None
    return error_from_wire(info.reason, status.message, retry_after_s)
