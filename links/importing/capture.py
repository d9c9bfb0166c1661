"""One LiDAR's packets in a pcap capture.

The time of a packet in the file is used as arrival and, less its firing and transmission, as stamp.

Source: ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from flow.link import Record
from links.importing.imported_file import DEFAULT_RIG, LIDAR, POSITION, ImportedFile, PacketModel
from links.importing.pcap import Datagram, PcapReport, read_datagrams
from links.lidar import packet_format
from links.lidar.ouster import DATA_PORT as OUSTER_PORT
from links.lidar.velodyne import POSITION_BYTES, POSITION_PORT
from stages.geometry.rig_lidar import RigLidar


class Capture(ImportedFile):
    """One LiDAR's packets in a pcap capture: those on `port` (None: the model's own) from `sender` (None: any)."""

    def __init__(
        self, stream: IO[bytes], source: Path, port: int | None, sender: str | None, unit: RigLidar | None
    ) -> None:
        self._stream = stream
        self._source = source
        self._given_port = port
        self._sender = sender
        self._model = PacketModel(str(source), unit)
        self._report = PcapReport()
        self._other_ports: Counter[int] = Counter()  # data packets on other ports
        self._not_data = 0  # packets on the LiDAR's port of another length,
        self._first_of_them = b""  # and the first of them

    @property
    def _port(self) -> int:
        return self._given_port or (self._model.form or packet_format("VLP-16")).factory_port

    def default_rig(self) -> str | None:
        """See ImportedFile."""
        return DEFAULT_RIG.format(model=self._model.form.profile.model) if self._model.form else None

    def records(self) -> Iterator[Record]:
        """See ImportedFile."""
        skipped = self._report.skipped
        for datagram in read_datagrams(self._stream, self._source, self._report):
            topic = self._topic(datagram)
            if topic is None:
                skipped[f"on UDP port {datagram.port}"] += 1
            elif datagram.sender != (self._sender or datagram.sender):
                skipped[f"from another sender, {datagram.sender}"] += 1
            else:
                stamp_ns = datagram.time_ns  # of a position packet: its arrival
                if topic == LIDAR:
                    self._model.check(datagram.payload, f"at byte {datagram.offset}")
                    stamp_ns = self._model.of(datagram.payload).first_pulse_ns(datagram.time_ns, datagram.payload)
                    self._sender = datagram.sender
                yield Record(topic, datagram.time_ns, stamp_ns, datagram.payload)

    def done_bytes(self) -> int:
        """See ImportedFile."""
        return self._report.done_bytes

    def skipped(self) -> dict[str, int]:
        """See ImportedFile."""
        return dict(self._report.skipped.most_common())

    def warnings(self) -> list[str]:
        """See ImportedFile."""
        return self._report.warnings

    def channels(self) -> dict[str, dict[str, str]]:
        """See ImportedFile."""
        model = self._model.form.profile.model if self._model.form else ""
        known = {"model": model, **({"sender": self._sender} if self._sender else {})}
        return {LIDAR: {**known, "port": str(self._port)}, POSITION: {**known, "port": str(POSITION_PORT)}}

    def nothing_found(self) -> str:
        """See ImportedFile."""
        form = self._model.form
        what = f"{form.profile.model} packet ({form.packet_bytes} bytes)" if form else "LiDAR packet"
        text = f"{self._source}: no {what} on UDP port {self._port}"
        if self._sender:
            text += f" from {self._sender}"
        if self._other_ports:
            ((port, count),) = self._other_ports.most_common(1)
            return f"{text}; {count} on port {port}: try --port {port}"
        if form is not None and self._not_data:
            return self._model.others(self._not_data, self._first_of_them, f"on UDP port {self._port}")
        if form is None and f"on UDP port {OUSTER_PORT}" in self._report.skipped:
            text += f"; UDP port {OUSTER_PORT} is an Ouster's, which needs its metadata: --rig METADATA.json"
        seen = [f"{count} packets {reason}" for reason, count in self._report.skipped.most_common(3)]
        return "; ".join([text, *seen, *self._report.warnings])

    def _topic(self, datagram: Datagram) -> str | None:
        payload = datagram.payload
        if self._model.of(payload).is_data(payload):
            if datagram.port == self._port:
                return LIDAR
            self._other_ports[datagram.port] += 1
        elif datagram.port == self._port:
            self._not_data += 1
            self._first_of_them = self._first_of_them or payload
        elif len(payload) == POSITION_BYTES and datagram.port == POSITION_PORT:
            return POSITION
        return None
