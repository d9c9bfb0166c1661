"""A ROS bag as an imported file.

The stamp of a packet in a scan message is taken as its arrival. Points become packets (`links/ros/point_cloud.py`),
which arrive when their last pulse has fired.

Source: ours.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml

from flow.link import LinkError, Record
from links.importing.imported_file import DEFAULT_RIG, LIDAR, ImportedFile, PacketModel
from links.lidar import AnyFormat, ouster_beams
from links.lidar.packet_format import FRAME_BYTES
from links.ros.autopilot import AutopilotReader
from links.ros.bag import Bag, BagMessage
from links.ros.mapping import (
    AUTOPILOT,
    DRONE_CAMERA,
    ODOMETRY,
    OUSTER_PACKETS,
    POINTS,
    SERVO,
    VEHICLE_CAMERA,
    BagMapping,
    TopicUse,
    checked,
    guess,
)
from links.ros.point_cloud import FAR_M, MIN_FAR, CloudEncoder
from links.ros.streams import ServoReader, image_records, odometry_records, stamp_ns, time_ns
from stages.geometry.rig_lidar import RigLidar

HOUR_NS = 3_600_000_000_000
MESSAGES_TO_RECOGNISE = 20
_STRING = "std_msgs/msg/String"


class RosbagFile(ImportedFile):
    """The topics of a bag that `mapping` (None: guessed) names."""

    def __init__(self, source: Path, mapping: BagMapping | None, unit: RigLidar | None) -> None:
        self._source = source
        self._bag = Bag(source)
        try:
            self._by_topic = checked(mapping or guess(self._bag.topics), self._bag.topics, str(source))
            self._types = {topic.name: topic.type for topic in self._bag.topics}
            self._made_unit = self._unit_in_bag() if unit is None else None
            self._unit = unit or self._made_unit
            self._model = PacketModel(str(source), self._unit)
            self._recognise()
        except BaseException:
            self._bag.__exit__(None, None, None)
            raise
        self._clouds: CloudEncoder | None = None
        self._servo = ServoReader()
        self._skipped: Counter[str] = Counter()
        self._not_data: tuple[bytes, str] | None = None  # the first LiDAR packet of another length, and its topic
        self._autopilot = AutopilotReader(self._skipped)
        self._time_ns = self._bag.start_ns

    def __enter__(self) -> RosbagFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._bag.__exit__(kind, error, traceback)

    def default_rig(self) -> str | None:
        """See ImportedFile. LinkError where the LiDAR is on a servo, whose mount cannot be guessed."""
        if self._model.form is None:
            return None
        if SERVO in (stream for stream, _ in self._by_topic.values()):
            raise LinkError(
                f"{self._source}: its LiDAR is on a servo, and a bag does not contain its mount: give its rig with "
                "--rig RIG.yaml"
            )
        rig = DEFAULT_RIG.format(model=self._model.form.profile.model)
        if self._made_unit is None:
            return rig
        values = yaml.safe_load(rig)
        values["lidar"] |= self._made_unit.model_dump(mode="json", include={"model", "beams"})
        return yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=120)

    def records(self) -> Iterator[Record]:
        """See ImportedFile."""
        for message in self._bag.messages(self._by_topic):
            self._time_ns = message.time_ns
            stream, use = self._by_topic[message.topic]
            yield from self._records(stream, use, message)

    def done_bytes(self) -> int:
        """See ImportedFile; from the time in the bag."""
        whole_ns = max(self._bag.end_ns - self._bag.start_ns, 1)
        files = sum(part.stat().st_size for part in self._bag.parts if part.is_file())
        return round(files * (self._time_ns - self._bag.start_ns) / whole_ns)

    def skipped(self) -> dict[str, int]:
        """See ImportedFile."""
        if self._clouds is not None and self._clouds.second_returns:
            self._skipped["second returns of a pulse"] = self._clouds.second_returns
        if self._clouds is not None and self._clouds.clouds_without_order:
            self._skipped["clouds before the order of their rings was known"] = self._clouds.clouds_without_order
        unused = {
            f"messages on {topic.name} ({topic.type}), which no stream takes": topic.messages
            for topic in self._bag.topics
            if topic.messages and topic.name not in self._by_topic
        }
        return dict(self._skipped) | unused

    def warnings(self) -> list[str]:
        """See ImportedFile."""
        return self._bag.warnings

    def channels(self) -> dict[str, dict[str, str]]:
        """See ImportedFile."""
        return {LIDAR: {"model": self._model.form.profile.model}} if self._model.form else {}

    def nothing_found(self) -> str:
        """See ImportedFile."""
        if self._clouds is not None and self._clouds.clouds_without_order:
            return (
                f"{self._source}: no cloud shows the order of its rings (it takes {MIN_FAR} points beyond "
                f"{FAR_M:g} m): import the LiDAR's packets"
            )
        if self._not_data is not None and self._model.form is not None:
            payload, topic = self._not_data
            return self._model.others(self._skipped[_no_data(topic, self._model.form)], payload, f"on {topic}")
        types = ", ".join(f"{topic.name} ({topic.type})" for topic in self._bag.topics if topic.messages)
        return f"{self._source}: nothing that grd can use: {types or 'the bag has no messages'}. `grd info` shows more"

    def _records(self, stream: str, use: TopicUse, message: BagMessage) -> Iterator[Record]:
        if stream == LIDAR:
            return self._points(message, use) if message.type == POINTS else self._packets(message, use)
        if stream == SERVO:
            return self._servo.records(message, use)
        if stream in (VEHICLE_CAMERA, DRONE_CAMERA):
            return image_records(stream, message, use)
        if stream == ODOMETRY:
            return odometry_records(message, use)
        assert stream == AUTOPILOT, stream
        return self._autopilot.records(message, use)

    def _packets(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        """The data packets of one scan or packet message."""
        payloads: list[tuple[Any, bytes]] = []
        for stamp, payload in _payloads(message.value):
            form = self._model.of(payload)
            if not form.is_data(payload) and form.is_data(payload[:-1]):
                payload = payload[:-1]  # ouster-ros before 2023 adds one byte
            if form.is_data(payload):
                self._model.check(payload, f"on {message.topic}")
                payloads.append((stamp, payload))
            else:
                self._skipped[_no_data(message.topic, form)] += 1
                self._not_data = self._not_data or (payload, message.topic)
        if self._model.form is None and payloads:
            raise LinkError(f"{self._source}: {message.topic}: packets of a LiDAR that grd does not know")
        by_recording = use.stamp == "arrival" or all(_is_unset(stamp) for stamp, _ in payloads)
        before = _before_last_ns(self._model.form, payloads) if by_recording and self._model.form else []
        for k, (stamp, payload) in enumerate(payloads):
            arrival_ns = message.time_ns - before[k] if by_recording else stamp_ns(message, use, stamp)
            yield Record(LIDAR, arrival_ns, self._model.of(payload).first_pulse_ns(arrival_ns, payload), payload)

    def _points(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        """The packets of a cloud."""
        if self._unit is None:
            raise LinkError(
                f"{self._source}: {message.topic} has points, which do not name their LiDAR: give its rig with --rig"
            )
        form = self._model.form
        assert form is not None
        if self._clouds is None:
            self._clouds = CloudEncoder(self._unit, use.axes, message.topic)
        for at_ns, payload in self._clouds.packets(message.value, stamp_ns(message, use)):
            end_ns = at_ns + form.duration_ns(payload) + round(8 * form.bit_ns * (len(payload) + FRAME_BYTES))
            yield Record(LIDAR, end_ns, at_ns, payload)

    def _lidar_topics(self) -> list[str]:
        return [topic for topic, (stream, _) in self._by_topic.items() if stream == LIDAR]

    def _recognise(self) -> None:
        """Find the model in the first packets: the recording's rig is written before other sensors' records."""
        if self._model.form is None and any(self._types[topic] != POINTS for topic in self._lidar_topics()):
            for message in itertools.islice(self._bag.messages(self._lidar_topics()), MESSAGES_TO_RECOGNISE):
                for _, payload in _payloads(message.value):
                    self._model.of(payload)

    def _unit_in_bag(self) -> RigLidar | None:
        """An Ouster by its metadata in the bag; None: no Ouster. LinkError when it is missing."""
        topics = self._lidar_topics()
        if not topics or self._types[topics[0]] not in OUSTER_PACKETS:
            return None
        for topic in self._bag.topics:
            if topic.type == _STRING and topic.messages and "metadata" in topic.name:
                text = str(next(self._bag.messages([topic.name])).value.data)
                model, beams = ouster_beams(text, f"{self._source}: {topic.name}")
                return RigLidar(model=model, beams=beams)
        raise LinkError(
            f"{self._source}: {topics[0]} has packets of an Ouster, and the bag no metadata: give the sensor's with "
            "--rig METADATA.json"
        )


def _no_data(topic: str, form: AnyFormat) -> str:
    """Why packets are skipped that have not the model's length."""
    return f"packets on {topic} that are no {form.profile.model} data"


def _payloads(value: Any) -> Iterator[tuple[Any, bytes]]:
    """(stamp or None, UDP payload) of each packet in a message."""
    if hasattr(value, "buf"):
        yield None, bytes(value.buf)
        return
    for packet in value.packets:
        data = bytes(packet.data)
        yield packet.stamp, data[: int(packet.size)] if hasattr(packet, "size") else data


def _is_unset(stamp: Any) -> bool:
    """Whether a packet's own time is zero: hesai_ros_driver sets only that of the frame."""
    return stamp is not None and time_ns(stamp) == 0


def _before_last_ns(form: AnyFormat, payloads: list[tuple[Any, bytes]]) -> list[int]:
    """How long before a scan's last packet each packet was sent, by the sensor's clock."""
    device_ns = [1000 * form.timestamp_us(payload) for _, payload in payloads]
    return [(device_ns[-1] - at_ns) % HOUR_NS for at_ns in device_ns]
