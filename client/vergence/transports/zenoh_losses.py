"""Detection of frames that were lost on a Zenoh network."""

from collections.abc import Iterable

from vergence_proto.v1 import depth_pb2 as pb


class Unanswered:
    """The frames of a call without an answer; it separates lost frames from late ones.

    A live frame or its answer may be lost. Maps arrive in order, so each map proves that earlier
    frames without an answer were lost. Each pong lists the frames before its ping that the server
    will still answer, which finds losses among the last frames.
    """

    def __init__(self) -> None:
        self._frames: dict[int, None] = {}  # ids, in order
        self._last_before: dict[int, int] = {}  # ping time: the last frame id sent before it

    def sent(self, frame_id: int) -> None:
        """Record a frame that is sent now."""
        self._frames[frame_id] = None

    def pinged(self, client_ns: int) -> None:
        """Record a ping that is sent now."""
        self._last_before[client_ns] = max(self._frames, default=0)

    def answered(self, response: pb.StreamDepthResponse) -> list[int]:
        """Record a response; return the ids of the frames that it proves lost, in order."""
        lost: list[int] = []
        match response.WhichOneof("message"):
            case "disparity":
                map_id = response.disparity.frame_id
                self._frames.pop(map_id, None)
                lost = [frame_id for frame_id in self._frames if frame_id < map_id]
            case "frame_error":
                self._frames.pop(response.frame_error.frame_id, None)
            case "frames_dropped":
                self._forget(response.frames_dropped.frame_ids)
            case "pong":
                lost = self._lost_before(response.pong)
        self._forget(lost)
        return lost

    def _lost_before(self, pong: pb.Pong) -> list[int]:
        last = self._last_before.get(pong.client_ns, 0)
        # Earlier pings, or their pongs, were lost.
        for client_ns in [each for each in self._last_before if each <= pong.client_ns]:
            del self._last_before[client_ns]
        waiting = set(pong.unanswered_frame_ids)
        return [each for each in self._frames if each <= last and each not in waiting]

    def _forget(self, frame_ids: Iterable[int]) -> None:
        for frame_id in frame_ids:
            self._frames.pop(frame_id, None)
