"""The blocking facade, from plain threads against a server in another process."""

import inspect
import multiprocessing
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

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


# In a process of its own: the servers of other tests live in this one.
FORKS = """
import multiprocessing, sys
import vergence
from tests.support.frames import RIG, make_frame

server, frame = sys.argv[1], make_frame(1)

def in_child(work):
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child():
        try:
            sender.send(str(work()))
        except Exception as error:
            sender.send(f"{type(error).__name__}: {error}")

    process = context.Process(target=child)
    process.start()
    sender.close()
    print(receiver.recv() if receiver.poll(20) else "hangs")
    process.kill()
    process.join()

def depth():
    return vergence.depth(frame.left, frame.right, RIG, server=server).frame_id

in_child(depth)
with vergence.BlockingClient(server) as client, client.open_session(RIG) as session:
    in_child(depth)
    in_child(lambda: session.submit(frame.left, frame.right))
    session.submit(frame.left, frame.right)
    print(next(iter(session)).frame_id)
in_child(depth)
print(depth())
"""


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
def test_a_process_forked_after_a_client_was_opened_gets_an_error(server: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKS, server],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=Path(__file__).parents[2],
        check=True,
    )
    before, new, old, session, after, parent = done.stdout.splitlines()
    assert (before, session, parent) == ("1", "1", "1"), done.stdout
    assert new.startswith("ConnectionLost: this process was forked")
    assert old.startswith("NotOpen: this process was forked")
    assert after == new
    assert "'spawn'" in new


def test_twins_say_the_same() -> None:
    """What is written twice, for editors, is the same text."""
    twins: list[tuple[type, type, str]] = [
        *((BlockingClient, DepthClient, name) for name in ("server_info", "stream_info")),
        (BlockingClient, DepthClient, "close_stream"),
        *((BlockingSession, DepthSession, name) for name in ("submit", "step", "reset", "end")),
    ]
    for blocking, asynchronous, name in twins:
        text = inspect.getdoc(getattr(asynchronous, name))
        assert text, name
        assert inspect.getdoc(getattr(blocking, name)) == text, name
