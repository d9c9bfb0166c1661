"""The drone's autopilot as a link: MAVLink frames in, one per record, and poses out.

Its frames are decoded to messages on the host's timeline, live and in replay by the same decoder. Only poses that pass
the gate (`gate.py`) are sent, as the messages of the autopilot's profile (`pose_messages.py`); when sending stops, the
reason is reported by STATUSTEXT (`pose_sender.py`). Live frames are authenticated if `signing_key` is set; recorded
frames are not.

Source: https://mavlink.io/en/; requirements of each autopilot: `profiles.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, field_validator, model_validator

from flow.counters import Counters
from flow.link import LinkError, Record, Source, SourceSettings
from links.clock import host_time
from links.clock.device_clock import DeviceClock
from links.clock.host_boot import host_boot
from links.mavlink.autopilot_session import AutopilotSession
from links.mavlink.frame_decoder import FrameDecoder
from links.mavlink.origin import GlobalOrigin, OriginSender, OriginState
from links.mavlink.poses.fusion_monitor import OnRejection
from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.pose_sender import PoseMessage, PoseSender
from links.mavlink.poses.sent_state import SentState
from links.mavlink.profiles import PROFILES, ProfileName, RequiredParameter, YawOutput, required_parameters
from links.mavlink.readers import AutopilotMessage
from links.mavlink.source_switch import FIRST_SET, GPS_STATUS_HZ, SourceSwitch
from links.mavlink.streams.message_intervals import MessageIntervals, MessageRates
from links.mavlink.transport.connection import Connection, Udp, parse_connection
from links.mavlink.transport.signing import Signer
from links.mavlink.transport.stream_connection import open_connection
from stages.messages import EarlierOdomFrame, RelativePose

VISUAL_INERTIAL_ODOMETRY = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY: our component id
RECEIVED_TOPIC = "/autopilot/rx"  # of a second autopilot /autopilot/rx_2, and what is sent to it /autopilot/tx_2
IS_KEY = re.compile(r"(0x)?[0-9a-fA-F]{64}")


class AutopilotSettings(SourceSettings):
    """Settings of `Autopilot`."""

    topic: str = Field(RECEIVED_TOPIC, pattern=r"^/\w+/rx(_\d+)?$")
    system_id: int = Field(1, ge=1, le=255)
    component_id: int = Field(1, ge=1, le=255)
    clock_drift_limit_ppm: float = Field(100.0, ge=0, le=10_000)
    clock_jump_limit_s: float = Field(5.0, gt=0, le=3600)
    connection: str | None = None  # udpin:127.0.0.1:14550, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD
    sender: IPv4Address | None = None  # the autopilot's address, required when udpin listens beyond loopback
    profile: ProfileName = "ardupilot"
    send: tuple[PoseMessage, ...] = ("odometry",)  # messages per pose
    # None: every pose, 50 a second; 20 send every third. ArduPilot needs 4 Hz; PX4 starts with 200 ms between two
    max_pose_hz: float | None = Field(None, ge=10, le=50)
    yaw: YawOutput = "none"  # none: positions in the autopilot's axes; measured: poses with yaw, EK3_SRCn_YAW 6
    source_set: int = Field(2, ge=1, le=3)  # ArduPilot: EK3_SRCn_* that are grd's; set 1 flies without it
    switch_source: bool = False  # ArduPilot: request that set in flight, and set 1 when poses end (`source_switch.py`)
    on_rejection: OnRejection = "stop"  # when the autopilot's EKF rejects the pose: stop, reset or report
    limits: PoseLimits = PoseLimits()
    own_system_id: int | None = Field(None, ge=1, le=255)  # None: the autopilot's, as a component of its vehicle
    own_component_id: int = Field(VISUAL_INERTIAL_ODOMETRY, ge=1, le=255)
    signing_key: Path | None = None  # a file of 32 bytes or 64 hexadecimal digits, mode 0600
    # remembers over restarts that a pose was sent; of topic rx_2 with _2 in its name; None: a start is the first one
    state_file: Path | None = None
    global_origin: GlobalOrigin | None = None  # sent to an autopilot without an origin
    message_rates: MessageRates = MessageRates()  # requested from the autopilot

    @property
    def sent_topic(self) -> str:
        """Topic of the frames that were sent."""
        return self.topic.replace("/rx", "/tx")

    @property
    def own_state_file(self) -> Path | None:
        """`state_file` with the topic's number, autopilot_sent_2.json: two links with one setting have two files."""
        number = self.topic.partition("/rx")[2]
        return self.state_file and self.state_file.with_stem(self.state_file.stem + number)

    @property
    def required_parameters(self) -> tuple[RequiredParameter, ...]:
        """The parameters that the autopilot needs."""
        return required_parameters(self.profile, self.yaw, self.source_set)

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

    @field_validator("signing_key", mode="before")
    @classmethod
    def _is_a_file(cls, value: Any) -> Any:
        if isinstance(value, str) and IS_KEY.fullmatch(value.strip()):
            raise ValueError("must be the path of a key file, not the key: recordings and logs contain settings")
        return value

    @model_validator(mode="after")
    def _fits_together(self) -> AutopilotSettings:
        if len(set(self.send)) != len(self.send):
            raise ValueError("send: each message at most once")
        if {"odometry", "vision_position_estimate"} <= set(self.send):
            raise ValueError("send: odometry or vision_position_estimate, not both: it would be fused twice")
        for kind in self.send:
            reason = PROFILES[self.profile].unsupported.get(kind)
            if reason:
                raise ValueError(f"send: {kind} is not supported by profile {self.profile}: {reason}")
        if self.switch_source and (self.profile != "ardupilot" or self.source_set == FIRST_SET):
            raise ValueError("switch_source: needs profile ardupilot and source_set 2 or 3: set 1 flies without grd")
        if self.own_id == (self.system_id, self.component_id):
            raise ValueError("own_component_id: must differ from the autopilot's component_id")
        if self.connection is not None and self.connection.startswith("udpin:"):
            host = IPv4Address(parse_connection(self.connection).host)
            if self.sender is None and not host.is_loopback:
                raise ValueError(
                    f"sender: set the autopilot's address when listening on {host}, so that other senders are ignored"
                )
        return self


class Autopilot(Source[AutopilotSettings]):
    """One autopilot, selected by system and component id. Without `connection` it is read only from recordings."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"pose"})

    def __init__(self, settings: AutopilotSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        clock = DeviceClock(settings.clock_drift_limit_ppm, round(1e9 * settings.clock_jump_limit_s))
        self._decoder = FrameDecoder((settings.system_id, settings.component_id), settings.own_id, clock)
        self._session: AutopilotSession | None = None
        # used by all sessions: a link that is reopened continues with the same autopilot
        self._signer: Signer | None = None
        self._poses: PoseSender | None = None
        self._switch: SourceSwitch | None = None
        self._sent_state: SentState | None = None
        self._not_connected: int = 0

    def decode(self, record: Record) -> AutopilotMessage | EarlierOdomFrame | None:
        """The message of one frame; None for an unused or rejected frame (see `counters`), and for a sent one."""
        if record.topic == self.settings.sent_topic:
            self._decoder.sent(record)
            return None
        return self._decoder.decode(record)

    @property
    def replay_topics(self) -> tuple[str, ...]:
        """See Source: also what was sent, which decides whether the autopilot's estimate is independent."""
        return self.settings.topic, self.settings.sent_topic

    def on_pose(self, pose: RelativePose) -> None:
        """Send a pose if the gate accepts it. Nothing is sent before the link is open, or in replay."""
        session = self._session
        if session is None or session.closed:
            self._not_connected += 1
        else:
            session.send_pose(pose)

    def upstream_restarted(self, port: str) -> str | None:
        """See Link: a fresh `fuse` learns the autopilot's axes as after a restart of grd."""
        session = self._session
        known = port == "pose" and session is not None and not session.closed and session.report_odom()
        return "it is told the autopilot's axes of the newest pose" if known else None

    def sent(self) -> Iterable[Record]:
        """See Link: all sent frames, including heartbeats."""
        session = self._session
        return () if session is None else session.sent()

    def listen(self) -> AbstractContextManager[Iterator[Record]]:
        """Open the connection: `with autopilot.listen() as records`. Raises LinkError."""
        return self._listen()

    @contextmanager
    def _listen(self) -> Iterator[Iterator[Record]]:
        settings = self.settings
        if settings.connection is None:
            raise LinkError("no connection to the autopilot: set `connection`, as in udpin:127.0.0.1:14550")
        if settings.signing_key is not None and self._signer is None:
            self._signer = Signer(settings.signing_key, host_time.now_ns())
        connection = open_connection(parse_connection(settings.connection), settings.sender)
        session = self.open_session(connection, host_time.now_ns)
        try:
            yield session.records()
        finally:
            session.close()

    def open_session(
        self, connection: Connection, now_ns: Callable[[], int], *, threaded: bool = True
    ) -> AutopilotSession:
        """Open a session on a connection. A simulation in virtual time has its own clock and no thread."""
        settings = self.settings
        target = settings.system_id, settings.component_id
        if self._sent_state is None:
            boot = host_boot(now_ns()) if threaded else None
            self._sent_state = SentState(settings.own_state_file, now_ns(), boot)
        if self._poses is None:
            self._poses = PoseSender(
                settings.send,
                settings.limits,
                reset_counter=now_ns() // 1_000_000_000,
                yaw=settings.yaw,
                profile=settings.profile,
                on_rejection=settings.on_rejection,
                max_pose_hz=settings.max_pose_hz,
            )
        if self._switch is None:
            self._switch = SourceSwitch(
                settings.source_set,
                settings.switch_source,
                settings.required_parameters,
                target,
                settings.own_id,
                self._poses.texts.warn,
                settings.limits.position_sigma_m,
            )
        self._session = AutopilotSession(
            connection,
            target,
            settings.own_id,
            self._poses,
            OriginSender(settings.global_origin, target, settings.own_id),
            MessageIntervals(
                settings.message_rates,
                settings.profile,
                target,
                settings.own_id,
                GPS_STATUS_HZ if settings.switch_source else 0.0,
            ),
            self._switch,
            self._signer,
            now_ns,
            (settings.topic, settings.sent_topic),
            self._decoder.independence,
            self._sent_state,
            threaded=threaded,
        )
        return self._session

    @property
    def origin(self) -> OriginState | None:
        """Progress of the global origin; None before the link was open."""
        return None if self._session is None else self._session.origin.state

    @property
    def port(self) -> int | None:
        """Local UDP port while listening; None otherwise."""
        connection = None if self._session is None else self._session.connection
        return connection.port if isinstance(connection, Udp) else None

    @property
    def status(self) -> str | None:
        """See Link: the connection is lost, the autopilot is silent, or replies are late."""
        return None if self._session is None else self._session.status

    @property
    def counters(self) -> Counters:
        """Totals since the start: decoded, lost, rejected by reason; live: sent, not sent, received, foreign."""
        decoder = self._decoder
        decoded = {
            "decoded": decoder.decoded,
            "unused": decoder.unused,
            "lost": decoder.lost,
            "clock restarts": decoder.clock.restarts,
            "timesync replies": decoder.clock.round_trips,
            **_clock_counters(decoder.clock),
        }
        live = Counters() if self._session is None else self._session.counters
        not_connected = {"poses while not connected": self._not_connected} if self._not_connected else {}
        return Counters(decoded | live.totals | not_connected, decoder.rejected, live.groups)


def _clock_counters(clock: DeviceClock) -> dict[str, int]:
    """State of the estimate of the autopilot's clock, as far as it is known."""
    counters: dict[str, int] = {}
    if clock.uncertainty_ns is not None:
        counters["clock uncertainty [us]"] = clock.uncertainty_ns // 1000
    if clock.drift.ppm is not None:
        drift_ppm, sigma_ppm = clock.drift.ppm
        counters |= {"clock drift [ppb]": round(1e3 * drift_ppm), "clock drift sigma [ppb]": round(1e3 * sigma_ppm)}
    return counters
