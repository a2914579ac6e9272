"""Names on the wire that client and server share: gRPC metadata, Zenoh keys and encodings.

The Zenoh keys under a namespace ``NS``, by default ``vergence``::

    NS/v1/@server/SERVER                     liveliness: this server is running
    NS/v1/@PRINCIPAL/@server/SERVER/open     query: OpenStream; reply: StreamOpened
    NS/v1/@PRINCIPAL/@server/SERVER/info     query: GetServerInfoRequest
    NS/v1/@PRINCIPAL/@server/SERVER/stream   query: GetStreamRequest
    NS/v1/@PRINCIPAL/@server/SERVER/reset    query: ResetStreamRequest
    NS/v1/@PRINCIPAL/@server/SERVER/close    query: CloseStreamRequest
    NS/v1/@PLACE/STREAM/@client/ATTACHMENT   liveliness: this client is attached
    NS/v1/@PLACE/STREAM/frames               up: Frame; between frames Ping, Reset; last, End
    NS/v1/@PLACE/STREAM/disparity            down: DisparityMap
    NS/v1/@PLACE/STREAM/status               down: every other StreamDepthResponse; last, End
                                             or the google.rpc.Status that ends the stream

PRINCIPAL is the user that Zenoh authenticates, and access control keeps every user below its own
keys: there, PLACE is the same name. Where no user has a name, PRINCIPAL is ``local``, and PLACE is
the attachment id. Choose that with 128 random bits, because it then protects the stream: no
wildcard matches a chunk that begins with @.

Every payload is a protobuf message, and the schema of its encoding names the message's type. The
reply to a query that fails is an error whose payload is a google.rpc.Status.

Each message carries its connection's id (as Zenoh attachment), so late messages of an earlier
connection can be discarded. A client sends at most as many unanswered frames as its credit. It
numbers its frames without a gap: a missing number was lost by the network and is answered as
dropped.

All messages have real-time priority, so none overtakes another. On a congested link, live frames
and the answers to them are dropped (congestion control DROP); all other messages wait (BLOCK).

"""

from google.protobuf.message import Message

# gRPC metadata of every StreamDepth call. A proxy in front of several servers hashes it, so that
# a stream's frames always reach the server that holds the stream's state.
STREAM_ID_METADATA = "x-stream-id"

DEFAULT_NAMESPACE = "vergence"
ANY = "*"  # matches one chunk of a key
LOCAL_PRINCIPAL = "local"  # of all callers, where nobody has a name

OPEN = "open"
# The last chunk of the key of each unary method of DepthService.
UNARY_KEYS = {
    "GetServerInfo": "info",
    "GetStream": "stream",
    "ResetStream": "reset",
    "CloseStream": "close",
}

_PROTOBUF = "application/protobuf"


class StreamKeys:
    """The Zenoh keys of one attachment to a stream; ``place`` is of :func:`place_of`."""

    def __init__(self, namespace: str, place: str, stream_id: str) -> None:
        self._stream = f"{namespace}/v1/@{place}/{stream_id}"
        self.frames: str = f"{self._stream}/frames"
        self.disparity: str = f"{self._stream}/disparity"
        self.status: str = f"{self._stream}/status"

    def client(self, attachment_id: str) -> str:
        """Return the key of the token that shows that this attachment is alive."""
        return f"{self._stream}/@client/{attachment_id}"


def server_key(namespace: str, server_id: str = ANY) -> str:
    """Return the key of the token that shows that a server is running."""
    return f"{namespace}/v1/@server/{server_id}"


def place_of(principal: str, attachment_id: str) -> str:
    """Return the part of a stream's keys that keeps others away from them."""
    return attachment_id if principal == LOCAL_PRINCIPAL else principal


def query_key(namespace: str, principal: str, server_id: str, what: str) -> str:
    """Return the key of a query; ``what`` is ``open`` or one of ``UNARY_KEYS``."""
    return f"{namespace}/v1/@{principal}/@server/{server_id}/{what}"


def server_of(key: str) -> str:
    """Return the server's id from a key made by :func:`query_key`."""
    return key.split("/")[-2]


def principal_of(key: str) -> str:
    """Return the principal from a key made by :func:`query_key`."""
    return key.split("/")[-4].removeprefix("@")


def encoding_of(message: Message) -> str:
    """Return the Zenoh encoding of a message: protobuf, with the message's type as schema."""
    return f"{_PROTOBUF};{message.DESCRIPTOR.full_name}"
