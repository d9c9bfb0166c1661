"""What every file that can be imported answers, and the LiDAR model of its packets.

Source: ours.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

from flow.link import LinkError, Record
from links.lidar import AnyFormat, packet_format, recognised_model
from links.lidar.reject_reason import PacketRejectReason
from stages.geometry.rig_lidar import RigLidar

LIDAR, POSITION, AUTOPILOT = "/lidar/packets", "/lidar/position", "/autopilot/rx"

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


class ImportedFile(ABC):
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
        """Damage in the file, with its place."""

    @abstractmethod
    def nothing_found(self) -> str:
        """The reason why there is no record, and what to try."""

    def channels(self) -> dict[str, dict[str, str]]:
        """Properties of the senders by topic, after the first record."""
        return {}


class PacketModel:
    """The model that sent a file's LiDAR packets: the rig's, or (None) the one that the first packet names."""

    def __init__(self, source: str, unit: RigLidar | None) -> None:
        self._source = source
        self.form: AnyFormat | None = unit and packet_format(unit.model, unit.beams)
        """None: not known yet."""

    def of(self, payload: bytes) -> AnyFormat:
        """The format, recognised by this payload if it is not known; a VLP-16's while none is."""
        if self.form is None:
            model = recognised_model(payload)
            self.form = None if model is None else packet_format(model)
        return self.form or packet_format("VLP-16")

    def others(self, count: int, payload: bytes, where: str) -> str:
        """That `count` packets like `payload` are of another length than the known model's, and what to try."""
        assert self.form is not None
        profile = self.form.profile
        model = recognised_model(payload)
        are = f"are from a {model}" if model else f"have {len(payload)} bytes"
        whose = f"the {profile.model} of the rig's metadata" if profile.model.startswith("OS") else f"a {profile.model}"
        return (
            f"{self._source}: {count} packets {where} {are}; those of {whose} have {self.form.packet_bytes} bytes: "
            "give the LiDAR's own rig with --rig"
        )

    def check(self, payload: bytes, where: str) -> None:
        """LinkError for a packet of another sensor; `where`: its place in the file."""
        form = self.form or packet_format("VLP-16")
        reason = form.reject_reason(payload)
        if reason not in (PacketRejectReason.MODEL, PacketRejectReason.UNIT):
            return
        text = f"{self._source}: the packet {where} is from {form.other_model(payload) or 'an unknown model'}"
        if reason is PacketRejectReason.UNIT:
            raise LinkError(f"{text}: every point would be wrong. Give this unit's metadata with --rig METADATA.json")
        wanted = f", not a {form.profile.model}" if self.form else ", which grd does not know"
        raise LinkError(
            f"{text}{wanted}: its beams have other elevations, so that every point would be wrong. Give its own rig "
            "with --rig"
        )
