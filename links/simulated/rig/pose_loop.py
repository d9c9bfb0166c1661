"""The Autopilot link of a graph in virtual time: the session, gate and sender of a live run on a simulated connection.

Nothing runs by itself. Received frames go to the session, which answers and stamps them as it does live; poses of the
graph go to the link; housekeeping runs every 50 ms of virtual time. All that the host does because of a record leaves
it `compute_s` after the record's arrival.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path as FilePath

from flow.graph import Graph
from flow.link import Record, Tap
from flow.message import Message
from flow.replay import Replay
from links.mavlink import Autopilot
from links.mavlink.autopilot_session import WAKE_S
from links.mavlink.poses.sent_frame import SentFrame
from stages.messages import RelativePose

TICK_NS = round(1e9 * WAKE_S)
PEER = ("simulated autopilot", 0)


class VirtualConnection:
    """A connection that takes all frames; the session's records of them are what is sent."""

    datagrams = True
    status: str | None = None

    def __init__(self) -> None:
        self.reconnects = self.foreign = self.stalls = self.late_frames = 0
        self._open = False

    def receive(self, timeout_s: float) -> tuple[bytes, tuple[str, int]] | None:
        """Nothing: frames are given to the session."""
        return None

    def reply_to(self, source: tuple[str, int]) -> None:
        """The autopilot has sent a frame, so it can be reached."""
        self._open = True

    def send(self, frame: bytes) -> bool:
        """Take a frame."""
        return self._open

    def close(self) -> None:
        """Close it."""
        self._open = False


class PoseTap(Tap):
    """Passes each pose that is wired to the autopilot on to it, as a live run does."""

    def __init__(self) -> None:
        super().__init__()
        self.first_ns: dict[bool, int] = {}
        """Arrival of the first pose without and with a rotation."""
        self._output: str | None = None
        self._link: Autopilot | None = None

    def watch(self, output: str, link: Autopilot) -> None:
        """Set the output with the poses, and the link."""
        self._output, self._link = output, link

    def wants(self, message: type[Message]) -> bool:
        """Poses."""
        return issubclass(message, RelativePose)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Pass on a pose."""
        if self._link is not None and output == self._output and isinstance(message, RelativePose):
            if message.estimate is not None:
                self.first_ns.setdefault(message.R_vehicle_drone is not None, arrival_ns)
            self._link.on_pose(message)


class PoseLoop:
    """The session of a graph's Autopilot link in virtual time."""

    def __init__(
        self, replay: Replay, graph: Graph, tap: PoseTap, compute_ns: int, state_file: FilePath | None = None
    ) -> None:
        """`state_file`: where runs that follow each other keep what was sent, unless the link has such a file."""
        self._now_ns = 0
        self._compute_ns = compute_ns
        self._next_tick_ns: int | None = None
        name, output = pose_edge(graph)
        link = replay.nodes[name]
        assert isinstance(link, Autopilot)
        self._link, self._topic = link, link.topic
        if state_file is not None and link.settings.state_file is None:
            link.settings = link.settings.model_copy(update={"state_file": state_file})
        if output is not None:
            tap.watch(output, link)

    def before(self, record: Record) -> Record | None:
        """Advance to the arrival of a record; a frame of the autopilot is stamped, None: it is not for the graph."""
        if self._next_tick_ns is None:
            self._now_ns = record.arrival_ns + self._compute_ns
            self._session = self._link.open_session(VirtualConnection(), lambda: self._now_ns, threaded=False)
            self._next_tick_ns = record.arrival_ns + TICK_NS
        while self._next_tick_ns <= record.arrival_ns:
            self._now_ns = max(self._now_ns, self._next_tick_ns + self._compute_ns)
            self._session.tick()
            self._session.write_state()
            self._next_tick_ns += TICK_NS
        self._now_ns = max(self._now_ns, record.arrival_ns + self._compute_ns)
        if record.topic != self._topic:
            return record
        return next(self._session.receive(record.data, PEER, record.arrival_ns), None)

    @property
    def sent_frame(self) -> SentFrame | None:
        """Frame that poses are sent in; None: none was sent."""
        return self._session.poses.frame if self._next_tick_ns is not None else None

    def sent(self) -> list[Record]:
        """Records of what was sent since the last call."""
        return list(self._session.sent()) if self._next_tick_ns is not None else []


def has_autopilot(graph: Graph) -> bool:
    """Whether the graph has an Autopilot link."""
    return any(issubclass(spec.cls, Autopilot) for spec in graph.nodes.values())


def pose_edge(graph: Graph) -> tuple[str, str | None]:
    """Name of the graph's Autopilot link and the output wired to its pose; None: no poses are sent."""
    name = next(name for name, spec in graph.nodes.items() if issubclass(spec.cls, Autopilot))
    wired = [f"{e.producer}.{e.output}" for e in graph.edges if e.consumer == name and e.port == "pose"]
    return name, wired[0] if wired else None
