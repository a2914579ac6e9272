"""The machine-readable details of a failed gRPC call."""

import grpc
from google.protobuf.message import Message
from google.rpc import error_details_pb2
from grpc_status import rpc_status

from vergence_proto.errors import ERROR_DOMAIN


def unpack_detail(error: grpc.aio.AioRpcError, detail: Message) -> None:
    """Fill ``detail`` from the one of its kind in the error's rich status."""
    status = rpc_status.from_call(error)  # type: ignore[arg-type] # its stubs know only sync calls
    assert status is not None
    assert status.message == error.details()
    [packed] = [one for one in status.details if one.Is(detail.DESCRIPTOR)]
    packed.Unpack(detail)


def reason_of(error: grpc.aio.AioRpcError) -> str:
    """The ErrorInfo reason of a failed call."""
    info = error_details_pb2.ErrorInfo()
    unpack_detail(error, info)
    assert info.domain == ERROR_DOMAIN
    return str(info.reason)
