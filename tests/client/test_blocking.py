"""The blocking facade, from plain threads against a server in another process."""

import inspect
import threading
from collections.abc import Iterator

import numpy as np
import pytest

import vergence
from tests.support.frames import RIG, make_frame
from tests.support.server_process import recall_server
from vergence import (
    BlockingClient,
    BlockingSession,
    Delivery,
    DepthClient,
    DepthSession,
    Origin,
    StreamExists,
    UnknownStream,
)

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with recall_server() as address:
        yield address


def threads_of_ours() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("vergence")]


def test_one_line_is_enough_for_one_pair(server: str) -> None:
    frame = make_frame(1)
    result = vergence.depth(frame.left, frame.right, RIG, server=server)
    assert result.depth_m.shape == (RIG.height, RIG.width)
    assert result.origin is Origin.COLD_START


def test_it_steps_as_the_asynchronous_session_does(server: str) -> None:
    with (
        BlockingClient(server) as client,
        client.open_session(RIG, delivery=Delivery.EVERY) as session,
    ):
        for frame_id in (1, 2, 3):
            frame = make_frame(frame_id)
            result = session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
            assert (result.frame_id, result.step_count) == (frame_id, frame_id)
        session.reset()
        again = session.step(frame.left, frame.right, frame.pose)
        assert again.origin is Origin.RESET_REQUESTED
        assert client.stream_info(session.stream_id).frames_stepped == 4


def test_live_results_come_by_iteration(server: str) -> None:
    frame = make_frame(1)
    with BlockingClient(server) as client, client.open_session(RIG) as session:
        session.submit(frame.left, frame.right)
        seen = []
        for result in session:
            seen.append(result.frame_id)
            if result.frame_id == 3:
                session.end()
            else:
                session.submit(frame.left, frame.right)
    assert seen == [1, 2, 3]


def test_errors_arrive_as_the_same_class(server: str) -> None:
    with BlockingClient(server) as client:
        with pytest.raises(UnknownStream):
            client.stream_info("nobody")
        with client.open_session(RIG, stream_id="mine"), pytest.raises(StreamExists):
            client.open_session(RIG, stream_id="mine").__enter__()


def test_it_works_from_a_plain_thread_and_leaves_none_behind(server: str) -> None:
    depths: list[np.ndarray] = []

    def work() -> None:
        frame = make_frame(1)
        with BlockingClient(server) as client, client.open_session(RIG) as session:
            assert len(threads_of_ours()) == 1
            depths.append(session.step(frame.left, frame.right).depth_m)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(PATIENCE_S)
    assert len(depths) == 1
    assert threads_of_ours() == []


def test_the_thread_ends_when_the_block_ends_by_an_error(server: str) -> None:
    with pytest.raises(UnknownStream), BlockingClient(server) as client:
        client.stream_info("nobody")
    assert threads_of_ours() == []


@pytest.mark.parametrize(
    ("blocking", "asynchronous"),
    [(BlockingClient, DepthClient), (BlockingSession, DepthSession)],
    ids=["client", "session"],
)
def test_the_facade_lacks_nothing(blocking: type, asynchronous: type) -> None:
    def public(kind: type) -> set[str]:
        return {name for name, _ in inspect.getmembers(kind) if not name.startswith("_")}

    assert public(asynchronous) - {"stream_id"} <= public(blocking)
