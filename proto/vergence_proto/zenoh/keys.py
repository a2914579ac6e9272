"""Names that both sides spell the same way: gRPC metadata, Zenoh keys and encodings.

Over Zenoh, under a namespace (``vergence`` unless told otherwise)::

    NS/v1/@server/SERVER                liveliness: this server serves
    NS/v1/@server/SERVER/open           query: OpenStream, answered StreamOpened
    NS/v1/@server/SERVER/info           query: GetServerInfoRequest
    NS/v1/@server/SERVER/stream         query: GetStreamRequest
    NS/v1/@server/SERVER/reset          query: ResetStreamRequest
    NS/v1/@server/SERVER/close          query: CloseStreamRequest
    NS/v1/STREAM/@client/ATTACHMENT     liveliness: this client has the stream
    NS/v1/STREAM/frames                 up: Frame; between frames Ping, Reset and, last, End
    NS/v1/STREAM/disparity              down: DisparityMap
    NS/v1/STREAM/status                 down: StreamDepthResponse of every other kind; last, End
                                        or the google.rpc.Status that the stream ends with

Every payload is a protobuf message whose type is the schema of its encoding. A query that fails
is answered by an error whose payload is a google.rpc.Status. What belongs to one attachment of a
client to a stream, from its open on, carries the attachment's id as Zenoh attachment, so that what
an earlier one left on the way is told apart. A client is bound by its credit, and numbers the
frames it sends without a gap: what is missing was lost on the way, and is answered as dropped.

All go with real-time priority, so that none overtakes another; live frames, and the answers to
them, are dropped where the way is full (congestion DROP), everything else waits (BLOCK).

A chunk that begins with @ is matched by no wildcard, and no stream id has one.
"""

from google.protobuf.message import Message

# gRPC metadata of every StreamDepth call: a proxy in front of several servers hashes it, so that
# a stream's frames always reach the server that holds its state.
STREAM_ID_METADATA = "x-stream-id"

DEFAULT_NAMESPACE = "vergence"
ANY = "*"  # in place of one chunk

OPEN = "open"
# The unary methods of DepthService, by the last chunk of their key.
UNARY_KEYS = {
    "GetServerInfo": "info",
    "GetStream": "stream",
    "ResetStream": "reset",
    "CloseStream": "close",
}

_PROTOBUF = "application/protobuf"


class StreamKeys:
    """The keys of one stream."""

    def __init__(self, namespace: str, stream_id: str) -> None:
        self._stream = f"{namespace}/v1/{stream_id}"
        self.frames = f"{self._stream}/frames"
        self.disparity = f"{self._stream}/disparity"
        self.status = f"{self._stream}/status"

    def client(self, attachment_id: str) -> str:
        return f"{self._stream}/@client/{attachment_id}"


def server_key(namespace: str, server_id: str = ANY) -> str:
    return f"{namespace}/v1/@server/{server_id}"


def ask_key(namespace: str, server_id: str, what: str) -> str:
    return f"{server_key(namespace, server_id)}/{what}"


def server_of(key: str) -> str:
    """The server's id, from a key of :func:`ask_key`."""
    return key.split("/")[-2]


def encoding_of(message: Message) -> str:
    """The Zenoh encoding of a message: protobuf, with its type as the schema."""
    return f"{_PROTOBUF};{message.DESCRIPTOR.full_name}"
