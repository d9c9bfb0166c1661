"""Imports a LiDAR's `.pcap` or a MAVLink `.tlog` as a recording; the contents decide the file type.

The time of a packet in the file is used as arrival and as stamp: no better time of the measurement is known.

Source: ours.
"""

from __future__ import annotations

import itertools
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.writer import MCAP0_MAGIC

from flow.link import LinkError, Record
from links.lidar import AnyFormat, packet_format, recognised_model, rig_unit
from links.lidar.ouster import DATA_PORT as OUSTER_PORT
from links.lidar.reject_reason import PacketRejectReason
from links.lidar.velodyne import POSITION_BYTES, POSITION_PORT
from links.recording.format import Progress
from links.recording.pcap import Datagram, PcapReport, is_pcap, read_datagrams
from links.recording.reader import open_file
from links.recording.tlog import TlogReport, looks_like_tlog, read_frames
from links.recording.writer import RecordingWriter
from stages.geometry.rig_lidar import RigLidar

_LIDAR, _POSITION, _AUTOPILOT = "/lidar/packets", "/lidar/position", "/autopilot/rx"
_PROGRESS_EVERY = 1000  # records
_SNIFF_BYTES = 4096

DEFAULT_RIG = """\
# Made by `grd import`: a capture does not say how its lidar was mounted. This assumes a {model} bolted down upright,
# without servo, 1.8 m over the vehicle's origin. The true mount is unknown: positions are relative to this guess.
version: 1
lidar:
  model: {model}
  mount:
    turns: false
    T_vehicle_turntable: {{xyz_m: [0.0, 0.0, 1.8]}}
    T_turntable_lidar: {{xyz_m: [0.0, 0.0, 0.0]}}
drone: {{span_m: 0.5}}
"""


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What an import wrote and skipped."""

    path: Path
    topics: dict[str, int]  # records by topic
    skipped: dict[str, int]  # packets or bytes by reason
    warnings: list[str]


def import_file(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    rig_yaml: str | None = None,
    port: int | None = None,
    sender: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ImportReport:
    """Convert a .pcap or .tlog to a recording next to it (or at `out`).

    `port` (None: the model's own) and `sender` (IPv4 address) choose the lidar in a capture; `rig_yaml` is the text of
    its calibration, by default DEFAULT_RIG for a capture and none for a telemetry log. Without a rig the packets name
    the model; an Ouster's do not. LinkError when the file has no usable record; a
    partial output is removed.
    """
    source = Path(path)
    target = Path(out) if out is not None else source.with_suffix(".mcap")
    with open_file(source) as stream:
        if target.exists() and target.samefile(source):
            raise LinkError(f"{target} is the file to import: give the recording another name")
        imported = _recognise(stream, source, port, sender, rig_yaml)
        records = imported.records()
        first = next(records, None)
        if first is None:
            raise LinkError(imported.nothing_found())
        topics: Counter[str] = Counter()
        total_bytes = source.stat().st_size
        writer = RecordingWriter(
            target,
            rig_yaml=rig_yaml or imported.default_rig(),
            metadata={"imported_from": source.name},
            channels=imported.channels(),
            lossless=True,
            overwrite=overwrite,
        )
        try:
            with writer:
                for number, record in enumerate(itertools.chain([first], records)):
                    writer.write(record)
                    topics[record.topic] += 1
                    if progress and number % _PROGRESS_EVERY == 0:
                        progress(imported.done_bytes(), total_bytes)
        except BaseException:
            with suppress(OSError):
                target.unlink()
            raise
    if progress:
        progress(total_bytes, total_bytes)
    return ImportReport(target, dict(topics), imported.skipped(), imported.warnings())


def _recognise(
    stream: IO[bytes], source: Path, port: int | None, sender: str | None, rig_yaml: str | None
) -> _ImportedFile:
    start = stream.read(_SNIFF_BYTES)
    stream.seek(0)
    if is_pcap(start):
        return _Capture(stream, source, port, sender, None if rig_yaml is None else rig_unit(rig_yaml, "--rig"))
    if start.startswith(MCAP0_MAGIC):
        raise LinkError(f"{source} is an MCAP file already: use it as it is (`grd replay {source}`)")
    if source.suffix == ".tlog" or looks_like_tlog(start):
        return _TelemetryLog(stream, source)
    raise LinkError(f"{source} is neither a pcap capture nor a MAVLink telemetry log (.tlog): these can be imported")


class _ImportedFile(ABC):
    """A file that can be imported."""

    def default_rig(self) -> str | None:
        """Rig where none is given, after the first record."""
        return None

    @abstractmethod
    def records(self) -> Iterator[Record]:
        """Its usable records, in file order."""

    @abstractmethod
    def done_bytes(self) -> int:
        """Number of bytes read."""

    @abstractmethod
    def skipped(self) -> dict[str, int]:
        """What was skipped, by reason."""

    @abstractmethod
    def warnings(self) -> list[str]:
        """Damage in the file, with byte offsets."""

    @abstractmethod
    def nothing_found(self) -> str:
        """The reason why there is no record, and what to try."""

    def channels(self) -> dict[str, dict[str, str]]:
        """Properties of the senders by topic, after the first record."""
        return {}


class _Capture(_ImportedFile):
    """One LiDAR's packets in a pcap capture."""

    def __init__(
        self, stream: IO[bytes], source: Path, port: int | None, sender: str | None, unit: RigLidar | None
    ) -> None:
        self._stream = stream
        self._source = source
        self._given_port = port
        self._sender = sender
        self._form: AnyFormat | None = unit and packet_format(unit.model, unit.beams)
        self._report = PcapReport()
        self._other_ports: Counter[int] = Counter()  # data packets on other ports

    @property
    def _port(self) -> int:
        return self._given_port or (self._form or packet_format("VLP-16")).factory_port

    def default_rig(self) -> str | None:
        return DEFAULT_RIG.format(model=self._form.profile.model) if self._form else None

    def records(self) -> Iterator[Record]:
        skipped = self._report.skipped
        for datagram in read_datagrams(self._stream, self._source, self._report):
            topic = self._topic(datagram)
            if topic is None:
                skipped[f"on UDP port {datagram.port}"] += 1
            elif datagram.sender != (self._sender or datagram.sender):
                skipped[f"from another sender, {datagram.sender}"] += 1
            else:
                stamp_ns = datagram.time_ns  # of a position packet: its arrival
                if topic == _LIDAR:
                    stamp_ns = self._checked(datagram).first_pulse_ns(datagram.time_ns, datagram.payload)
                    self._sender = datagram.sender
                yield Record(topic, datagram.time_ns, stamp_ns, datagram.payload)

    def done_bytes(self) -> int:
        return self._report.done_bytes

    def skipped(self) -> dict[str, int]:
        return dict(self._report.skipped.most_common())

    def warnings(self) -> list[str]:
        return self._report.warnings

    def channels(self) -> dict[str, dict[str, str]]:
        model = self._form.profile.model if self._form else ""
        known = {"model": model, **({"sender": self._sender} if self._sender else {})}
        return {_LIDAR: {**known, "port": str(self._port)}, _POSITION: {**known, "port": str(POSITION_PORT)}}

    def nothing_found(self) -> str:
        what = f"{self._form.profile.model} packet ({self._form.packet_bytes} bytes)" if self._form else "LiDAR packet"
        text = f"{self._source}: no {what} on UDP port {self._port}"
        if self._sender:
            text += f" from {self._sender}"
        if self._other_ports:
            ((port, count),) = self._other_ports.most_common(1)
            return f"{text}; {count} on port {port}: try --port {port}"
        if self._form is None and f"on UDP port {OUSTER_PORT}" in self._report.skipped:
            text += f"; UDP port {OUSTER_PORT} is an Ouster's, which needs its metadata: --rig METADATA.json"
        seen = [f"{count} packets {reason}" for reason, count in self._report.skipped.most_common(3)]
        return "; ".join([text, *seen, *self._report.warnings])

    def _topic(self, datagram: Datagram) -> str | None:
        payload = datagram.payload
        if self._form is None:
            model = recognised_model(payload)
            self._form = None if model is None else packet_format(model)
        form = self._form or packet_format("VLP-16")
        if form.is_data(payload):
            if datagram.port == self._port:
                return _LIDAR
            self._other_ports[datagram.port] += 1
        elif len(payload) == POSITION_BYTES and datagram.port == POSITION_PORT:
            return _POSITION
        return None

    def _checked(self, datagram: Datagram) -> AnyFormat:
        """The format of a data packet. LinkError for another sensor's."""
        form = self._form or packet_format("VLP-16")
        reason = form.reject_reason(datagram.payload)
        if reason in (PacketRejectReason.MODEL, PacketRejectReason.UNIT):
            name = form.other_model(datagram.payload) or "an unknown model"
            wanted = f", not a {form.profile.model}" if self._form else ", which grd does not know"
            raise LinkError(
                f"{self._source}: the packet at byte {datagram.offset} is from {name}{wanted}:"
                " its beams have other elevations, so that every point would be wrong. Give its own rig with --rig"
            )
        return form


class _TelemetryLog(_ImportedFile):
    """The MAVLink frames of a telemetry log."""

    def __init__(self, stream: IO[bytes], source: Path) -> None:
        self._stream = stream
        self._source = source
        self._report = TlogReport()

    def records(self) -> Iterator[Record]:
        for time_ns, frame in read_frames(self._stream, self._source, self._report):
            yield Record(_AUTOPILOT, time_ns, time_ns, frame)

    def done_bytes(self) -> int:
        return self._report.done_bytes

    def skipped(self) -> dict[str, int]:
        return {"bytes that are no MAVLink frame": self._report.bad_bytes} if self._report.bad_bytes else {}

    def warnings(self) -> list[str]:
        return self._report.warnings

    def nothing_found(self) -> str:
        return f"{self._source}: no MAVLink frame in {self._report.done_bytes} bytes: is it a telemetry log (.tlog)?"
