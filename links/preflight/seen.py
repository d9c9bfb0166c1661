"""What the raw records of one source said: an accumulator for each kind, the same live and from a recording.

Nothing here judges. Source: ours.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Any

from flow.link import LinkError, Record, Source
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
        return AutopilotSeen(source.topic, (source.settings.system_id, source.settings.component_id))
    kinds: dict[type[Source], type[Seen]] = {Lidar: LidarSeen, Servo: ServoSeen, Camera: CameraSeen}
    return next((seen for kind, seen in kinds.items() if isinstance(source, kind)), Seen)(source.topic)
