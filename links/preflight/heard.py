"""What was heard while a preflight listened: a tap that counts records and keeps the few messages that checks compare.

Each kind of source has an accumulator for its raw records, the same live and from a recording; nothing here judges.

Source: ours.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from pydantic import PrivateAttr

from flow.link import Link, LinkError, Record, Source, Tap
from flow.message import Message
from links.camera import Camera
from links.camera.camera import jpeg_size
from links.dynamixel import Servo
from links.dynamixel.servo import parse_state
from links.mavlink import Autopilot
from links.mavlink.wire import header, parse_frame
from links.preflight.arrivals import Arrivals
from links.recording import decode_compressed_image
from links.velodyne import Lidar, vlp16
from links.velodyne.lidar import POSITION_TOPIC
from links.velodyne.position import PpsWatch
from stages.messages import (
    AutopilotEstimator,
    AutopilotStatus,
    DroneAttitude,
    DroneFix,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
    VehicleMotion,
)

KEPT: tuple[type[Message], ...] = (
    AutopilotEstimator,
    AutopilotStatus,
    DroneAttitude,
    DroneFix,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
    VehicleMotion,
)
MOST_MESSAGES = 20_000  # of a type, the newest

M = TypeVar("M", bound=Message)


class Seen:
    """Records of one source, by topic."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.topics: defaultdict[str, Arrivals] = defaultdict(Arrivals)

    @property
    def arrivals(self) -> Arrivals:
        """Of the source's own topic."""
        return self.topics[self.topic]

    def take(self, record: Record) -> None:
        """One record more."""
        self.topics[record.topic].take(record)


class LidarSeen(Seen):
    """Return modes, and the sensor's clock against the host's."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.return_modes: Counter[int] = Counter()
        self.pps = PpsWatch()
        self.device_ns: list[tuple[int, int]] = []
        """(host's stamp, microseconds of the hour in ns) of each packet of the first minute."""

    def take(self, record: Record) -> None:
        """See Seen."""
        super().take(record)
        if record.topic == POSITION_TOPIC:
            self.pps.see(record.data)
        elif record.topic == self.topic and len(record.data) == vlp16.PACKET_BYTES:
            self.return_modes[record.data[vlp16.RETURN_MODE_AT]] += 1
            if len(self.device_ns) < 100_000:
                at = vlp16.TIMESTAMP_AT
                self.device_ns.append((record.stamp_ns, 1_000 * int.from_bytes(record.data[at : at + 4], "little")))


class ServoSeen(Seen):
    """Where the servo stood, and its error bits."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.least_rad, self.most_rad = float("inf"), float("-inf")
        self.errors: Counter[int] = Counter()

    def take(self, record: Record) -> None:
        """See Seen; what is no state is counted by the link."""
        super().take(record)
        try:
            state = parse_state(record.stamp_ns, record.data)
        except ValueError:
            return
        self.least_rad = min(self.least_rad, state.position_rad)
        self.most_rad = max(self.most_rad, state.position_rad)
        self.errors[state.error] += 1


class CameraSeen(Seen):
    """Sizes of the pictures."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.sizes_px: Counter[tuple[int, int]] = Counter()

    def take(self, record: Record) -> None:
        """See Seen; what is no picture is counted by the link."""
        super().take(record)
        try:
            self.sizes_px[jpeg_size(decode_compressed_image(record.data).data)] += 1
        except (ValueError, LinkError):
            return


class AutopilotSeen(Seen):
    """Each kind of message of the one autopilot, and what kind of autopilot it says it is."""

    def __init__(self, topic: str, sender: tuple[int, int]) -> None:
        super().__init__(topic)
        self._sender = sender
        self.kinds: defaultdict[str, Arrivals] = defaultdict(Arrivals)
        self.others: Counter[tuple[int, int]] = Counter()  # (system, component) of others that speak here
        self.autopilot: int | None = None  # MAV_AUTOPILOT

    def take(self, record: Record) -> None:
        """See Seen; what is damaged is counted by the link."""
        super().take(record)
        if record.topic != self.topic:
            return
        try:
            frame: Any = parse_frame(record.data)
        except ValueError:
            return
        sender, _ = header(record.data)
        if sender != self._sender:
            self.others[sender] += 1
            return
        self.kinds[frame.get_type()].take(record)
        if frame.get_type() == "HEARTBEAT":
            self.autopilot = int(frame.autopilot)


def seen_for(source: Source) -> Seen:
    """The accumulator for a source's records."""
    if isinstance(source, Autopilot):
        return AutopilotSeen(source.topic, (source.system_id, source.component_id))
    kinds: dict[type[Source], type[Seen]] = {Lidar: LidarSeen, Servo: ServoSeen, Camera: CameraSeen}
    return next((seen for kind, seen in kinds.items() if isinstance(source, kind)), Seen)(source.topic)


class Ear(Tap):
    """Hears every record and the messages of interest; from many threads, each topic from one."""

    _by_topic: dict[str, Seen] = PrivateAttr(default_factory=dict[str, Seen])
    _topics: dict[str, str] = PrivateAttr(default_factory=dict[str, str])  # of the sources, by name
    _messages: defaultdict[type[Message], deque[Message]] = PrivateAttr(
        default_factory=lambda: defaultdict(lambda: deque(maxlen=MOST_MESSAGES))
    )

    def attach(self, sources: Mapping[str, Source]) -> None:
        """Say whose records will come."""
        self._by_topic = {source.topic: seen_for(source) for source in sources.values()}
        self._topics = {name: source.topic for name, source in sources.items()}

    def wants(self, message: type[Message]) -> bool:
        """See Tap."""
        return message in KEPT

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """See Tap."""
        if type(message) in KEPT:
            self._messages[type(message)].append(message)

    def record(self, record: Record) -> None:
        """See Tap. A side topic, as /lidar/position, is with the source whose topic has the same first word."""
        seen = self._by_topic.get(record.topic)
        if seen is None:
            room = record.topic.rpartition("/")[0] + "/"
            seen = next((s for topic, s in self._by_topic.items() if topic.startswith(room) and room != "/"), None)
        if seen is not None:
            seen.take(record)

    def seen(self, name: str) -> Seen:
        """What came from the source of that name."""
        return self._by_topic[self._topics[name]]

    def messages(self, kind: type[M]) -> list[M]:
        """The newest messages of a type, oldest first."""
        return cast("list[M]", list(self._messages[kind]))


@dataclass(frozen=True, slots=True)
class Heard:
    """One source's part of what was heard."""

    name: str
    link: Link
    seen: Seen
    counters: Mapping[str, int]
    trouble: str | None  # what the link itself says is wrong
    end_ns: int  # until when was listened
    live: bool

    @property
    def silence(self) -> str:
        """Why nothing came, in words."""
        if self.trouble is not None:
            return self.trouble
        return "nothing came" if self.live else f"the recording holds nothing on {self.seen.topic}"


@dataclass(frozen=True, slots=True)
class AllHeard:
    """What was heard of every source, and the messages."""

    sources: tuple[Heard, ...]
    messages: Mapping[type[Message], list[Any]]
    live: bool

    def of(self, kind: type[Link]) -> list[Heard]:
        """The sources of one class."""
        return [heard for heard in self.sources if isinstance(heard.link, kind)]

    def all(self, kind: type[M]) -> list[M]:
        """The messages of one type."""
        return self.messages.get(kind, [])
