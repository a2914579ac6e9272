"""A Zenoh session closes at once, whatever has become of its link."""

import socket
import struct

import zenoh

from tests.support.zenoh_net import free_endpoint
from vergence_proto.zenoh.closing import close_without_lingering, connections_of
from vergence_proto.zenoh.session import make_config


def lingers(connection: socket.socket) -> bool:
    size = struct.calcsize("ii")
    stored = connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, size)
    return bool(struct.unpack("ii", stored)[0])


def test_the_close_of_a_session_does_not_wait_for_its_peer() -> None:
    endpoint = free_endpoint()
    listens = make_config(max_message_bytes=1 << 20, mode="router", listen__endpoints=[endpoint])
    connects = make_config(max_message_bytes=1 << 20, mode="client", connect__endpoints=[endpoint])
    with zenoh.open(listens):
        client = zenoh.open(connects)
        [connection] = connections_of(client)
        with connection:
            assert lingers(connection)
            close_without_lingering(client)
            assert not lingers(connection)
        assert client.is_closed()
        close_without_lingering(client)
