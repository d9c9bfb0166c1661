"""The drone's autopilot: MAVLink frames in, one a record, and our poses out to it.

What it says becomes messages on the host's timeline; live and in replay alike, by the same decoder. Poses go out only
while they are good (`gate.py`), in the frames and with the NaNs that its kind wants (`pose_frames.py`), and loudly not
at all otherwise (`speaker.py`). Frames are authenticated live, where `signing_key` is set; a recording's are not.

Source: https://mavlink.io/en/; what each kind of autopilot takes: `profiles.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, field_validator, model_validator

from flow.link import LinkError, Record, Source, SourceSettings
from links import host_time
from links.device_clock import DeviceClock
from links.mavlink.connection import Udp, parse_connection
from links.mavlink.gate import Limits
from links.mavlink.lines import open_connection
from links.mavlink.origin import GlobalOrigin, OriginGiver
from links.mavlink.profiles import PROFILES, ProfileName
from links.mavlink.readers import AutopilotMessage
from links.mavlink.session import Session
from links.mavlink.signing import Signer
from links.mavlink.speaker import Kind, PoseSpeaker
from links.mavlink.stream import FrameStream
from stages.messages import RelativePose

VISUAL_INERTIAL_ODOMETRY = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY: who we are
SENT_TOPIC = "/autopilot/tx"


class AutopilotSettings(SourceSettings):
    """Settings of `Autopilot`."""

    topic: str = "/autopilot/rx"
    system_id: int = Field(1, ge=1, le=255)
    component_id: int = Field(1, ge=1, le=255)
    clock_drift_limit_ppm: float = Field(100.0, ge=0, le=10_000)
    clock_jump_limit_s: float = Field(5.0, gt=0, le=3600)
    connection: str | None = None  # udpin:127.0.0.1:14550, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD
    sender: IPv4Address | None = None  # the autopilot's address, where udpin listens beyond loopback
    profile: ProfileName = "ardupilot"
    send: tuple[Kind, ...] = ("odometry",)  # of each good pose
    limits: Limits = Limits()
    own_system_id: int | None = Field(None, ge=1, le=255)  # None: the autopilot's, as part of its vehicle
    own_component_id: int = Field(VISUAL_INERTIAL_ODOMETRY, ge=1, le=255)
    signing_key: Path | None = None  # a file of 32 bytes or 64 hexadecimal digits, mode 0600
    global_origin: GlobalOrigin | None = None  # given to an autopilot that has none

    @property
    def own_id(self) -> tuple[int, int]:
        """Our system id and component id."""
        return self.own_system_id or self.system_id, self.own_component_id

    @field_validator("connection")
    @classmethod
    def _is_connection(cls, value: str | None) -> str | None:
        if value is not None:
            parse_connection(value)
        return value

    @model_validator(mode="after")
    def _fits_together(self) -> AutopilotSettings:
        if len(set(self.send)) != len(self.send):
            raise ValueError("send: each message once")
        if {"odometry", "vision_position_estimate"} <= set(self.send):
            raise ValueError("send: odometry or vision_position_estimate, not both: it would be fused twice")
        for kind in self.send:
            reason = PROFILES[self.profile].refuses.get(kind)
            if reason:
                raise ValueError(f"send: {kind} is not for profile {self.profile}: {reason}")
        if self.own_id == (self.system_id, self.component_id):
            raise ValueError("own_component_id: we cannot be the autopilot itself")
        if self.connection is not None and self.connection.startswith("udpin:"):
            host = IPv4Address(parse_connection(self.connection).host)
            if self.sender is None and not host.is_loopback:
                raise ValueError(
                    f"sender: give the autopilot's address when listening on {host}, so that others are not heard"
                )
        return self


class Autopilot(Source[AutopilotSettings]):
    """One autopilot, chosen by system and component id. Without `connection` it is read from recordings alone."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"pose"})

    def __init__(self, settings: AutopilotSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        clock = DeviceClock(settings.clock_drift_limit_ppm, round(1e9 * settings.clock_jump_limit_s))
        self._stream = FrameStream((settings.system_id, settings.component_id), settings.own_id, clock)
        self._session: Session | None = None
        self._signer: Signer | None = None  # of all sessions
        self._missed: int = 0

    def decode(self, record: Record) -> AutopilotMessage | None:
        """The message of one frame; None when it says nothing of use here or is refused (see `counters`)."""
        return self._stream.decode(record)

    def on_pose(self, pose: RelativePose) -> None:
        """Send a pose if it is good. Before the link is open, and in replay, nothing is sent."""
        session = self._session
        if session is None or session.closed:
            self._missed += 1
        else:
            session.pose(pose)

    def sent(self) -> Iterable[Record]:
        """See Link: what went out, heartbeats and all."""
        session = self._session
        return () if session is None else session.sent()

    def listen(self) -> AbstractContextManager[Iterator[Record]]:
        """Open the connection: `with autopilot.listen() as records`. LinkError says what to check."""
        return self._listen()

    @contextmanager
    def _listen(self) -> Iterator[Iterator[Record]]:
        settings = self.settings
        if settings.connection is None:
            raise LinkError("no connection to the autopilot: set `connection`, as in udpin:127.0.0.1:14550")
        target = settings.system_id, settings.component_id
        if settings.signing_key is not None and self._signer is None:
            self._signer = Signer(settings.signing_key, host_time.now_ns())
        connection = open_connection(parse_connection(settings.connection), settings.sender)
        session = Session(
            connection,
            target,
            settings.own_id,
            PoseSpeaker(settings.send, settings.limits, reset_counter=host_time.now_ns() // 1_000_000_000),
            OriginGiver(settings.global_origin, target),
            self._signer,
            host_time.now_ns,
            (settings.topic, SENT_TOPIC),
        )
        self._session = session
        try:
            yield session.records()
        finally:
            session.close()

    @property
    def port(self) -> int | None:
        """Our own UDP port while listening; None otherwise."""
        connection = None if self._session is None else self._session.connection
        return connection.port if isinstance(connection, Udp) else None

    @property
    def status(self) -> str | None:
        """See Link: the line is gone, or nothing is heard on it."""
        return None if self._session is None else self._session.status

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start: decoded, lost, refused by reason; live: sent, not sent, received, foreign."""
        stream = self._stream
        refused = {f"refused: {reason}": count for reason, count in dict(stream.refused).items()}
        decoded = {
            "decoded": stream.decoded,
            "of no use here": stream.unused,
            "lost": stream.lost,
            "clock restarts": stream.clock.restarts,
            "timesync replies": stream.clock.round_trips,
            **_known_of(stream.clock),
            **refused,
        }
        live = {} if self._session is None else self._session.counters
        missed = {"poses while not connected": self._missed} if self._missed else {}
        return decoded | live | missed


def _known_of(clock: DeviceClock) -> dict[str, int]:
    """What is known of the autopilot's clock, once it is."""
    told: dict[str, int] = {}
    if clock.uncertainty_ns is not None:
        told["clock uncertainty [us]"] = clock.uncertainty_ns // 1000
    if clock.drift.ppm is not None:
        drift_ppm, sigma_ppm = clock.drift.ppm
        told |= {"clock drift [ppb]": round(1e3 * drift_ppm), "clock drift's sigma [ppb]": round(1e3 * sigma_ppm)}
    return told
