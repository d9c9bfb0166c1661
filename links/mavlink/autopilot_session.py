"""Live session with one autopilot: receives its frames, replies to it, and sends poses and periodic messages.

    received frames: signature check, TIMESYNC replies, then records for the graph. TIMESYNC requests are answered
        immediately.
    poses: gate and PoseSender, then frames, sent immediately or not at all. None are sent to a silent autopilot,
        because a blocked autopilot or bridge would buffer them and use them as current later; none while they would
        arrive late (`timesync_monitor.py`).
    a thread: HEARTBEAT once per second, TIMESYNC four times per second, texts, the origin and requests for messages
        (`streams/message_intervals.py`), also without poses. A message that finds the send buffer full is repeated at
        each step, before a pose; it is small.

A reply to our own TIMESYNC is recorded with the time of its request as stamp. By that stamp the decoder distinguishes
it from foreign replies, also in replay.

time_usec and TIMESYNC use host time in microseconds and nanoseconds since 1970. ArduPilot estimates the offset to its
own clock from the fastest message (JitterCorrection), PX4 from the replies to its own TIMESYNC requests.

Source: https://mavlink.io/en/services/timesync.html, /heartbeat.html; ArduPilot libraries/AP_RTC/JitterCorrection.cpp;
PX4 src/modules/mavlink/mavlink_timesync.cpp.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from flow.counters import Counters
from flow.link import LinkError, Record
from links.mavlink.frame_sender import NOT_SENT, POSE_REJECTED, SENT, FrameSender
from links.mavlink.origin import OriginSender
from links.mavlink.poses.autopilot_estimate import EstimateEvent
from links.mavlink.poses.gate import RejectReason
from links.mavlink.poses.independence import POSES, Independence
from links.mavlink.poses.odom_frame import odom_frame
from links.mavlink.poses.pose_sender import PoseSender
from links.mavlink.poses.sent_state import SentState
from links.mavlink.source_switch import SourceSwitch
from links.mavlink.streams.message_intervals import MessageIntervals
from links.mavlink.timesync_monitor import REQUEST_PERIOD_NS, TimesyncMonitor
from links.mavlink.transport.connection import Connection
from links.mavlink.transport.framing import FrameSplitter, dialect, header
from links.mavlink.transport.signing import Signer
from stages.messages import RelativePose

WAKE_S = 0.05  # period of the thread, and of the check whether a waiting reader was closed
SAVED_S = 2.0  # closing waits this long for a write to the disk
SILENCE_REPORTED_S = 3.0  # three heartbeats
SECOND_NS = 1_000_000_000
MAX_SILENCE_NS = 1_500_000_000  # one and a half heartbeats: no poses are sent
ONBOARD_CONTROLLER, NO_AUTOPILOT = 18, 8  # MAV_TYPE, MAV_AUTOPILOT_INVALID
NO_CONNECTION = -1
STANDBY, ACTIVE = 3, 4  # MAV_STATE
REJECTED = (
    "the autopilot's EKF rejects the pose: no poses are sent. Is its compass, its GPS or the servo's mount wrong?"
)
RESTART_REPORTED_NS = 600_000_000_000  # an earlier pose is probably of the same flight, which lasts 10 minutes


class AutopilotSession:
    """One open connection. `records` is called by one thread, `send_pose` and `sent` by others."""

    def __init__(
        self,
        connection: Connection,
        target: tuple[int, int],
        own: tuple[int, int],
        poses: PoseSender,
        origin: OriginSender,
        intervals: MessageIntervals,
        switch: SourceSwitch,
        signer: Signer | None,
        now_ns: Callable[[], int],
        topics: tuple[str, str],
        independence: Independence,
        sent_state: SentState | None = None,
        *,
        threaded: bool = True,
    ) -> None:
        """`threaded` False: nothing runs by itself; the caller gives received bytes to `receive` and calls `tick`."""
        self.counts: Counter[str] = Counter()
        self.connection, self.poses, self.origin, self.intervals = connection, poses, origin, intervals
        self.switch = switch
        self._target, self._own = target, own
        self._signer, self._now_ns = signer, now_ns
        self._received_topic, sent_topic = topics
        self._sent_state = SentState(None, now_ns()) if sent_state is None else sent_state
        self._sender = FrameSender(connection, own, signer, now_ns, sent_topic, independence, self._sent_state)
        self._splitter = FrameSplitter()
        self._split_connection = 0  # `reconnects` of the splitter's bytes
        earlier = self._sender.report_earlier()
        self._earlier_odom: tuple[int, bytes] | None = None  # of an earlier run, until it is a record
        if earlier is not None:
            earlier_ns, odom = earlier
            self._earlier_odom = None if odom is None else (earlier_ns, odom)
            if now_ns() - earlier_ns < RESTART_REPORTED_NS:
                poses.texts.warn(f"restarted {(now_ns() - earlier_ns) * 1e-9:.0f} s after its last pose")
        self._lock = threading.Lock()  # for numbering, signing and sending
        self._closed = threading.Event()
        self._heartbeat_ns = self._request_ns = 0
        self._timesync = TimesyncMonitor()
        self._late_frames = 0  # late frames of the connection that were handled
        self._target_ns = now_ns()  # when the autopilot's newest frame arrived, or the session started
        self._target_connection: int | None = None  # `reconnects` at its newest frame; NO_CONNECTION: not authenticated
        if signer is not None:
            signer.write_timestamp()  # the signer may come from an earlier session
        self._threads = [
            threading.Thread(target=self._run, name="mavlink housekeeping", daemon=True),
            threading.Thread(target=self._save, name="mavlink state", daemon=True),
        ]
        for thread in self._threads if threaded else ():
            thread.start()

    def records(self) -> Iterator[Record]:
        """Frames as they arrive, until closed. Raises LinkError when the connection cannot recover."""
        while not self._closed.is_set():
            try:
                received = self.connection.receive(WAKE_S)
            except LinkError:
                if self._closed.is_set():
                    return
                raise
            if received is None:
                continue
            yield from self.receive(*received, self._now_ns())

    def receive(self, data: bytes, source: tuple[str, int], arrival_ns: int) -> Iterator[Record]:
        """Records of received bytes, after the state of an earlier run; answers to them are sent at once."""
        if self._earlier_odom is not None:
            (earlier_ns, odom), self._earlier_odom = self._earlier_odom, None
            yield Record(self._received_topic, arrival_ns, earlier_ns, odom)
        if self._split_connection != self.connection.reconnects:
            self._splitter.reset()
            self._split_connection = self.connection.reconnects
        frames = self._splitter.datagram(data) if self.connection.datagrams else self._splitter.stream(data)
        for frame, message in frames:
            stamp_ns = self._on_frame(frame, message, source, arrival_ns)
            if stamp_ns is not None:
                yield Record(self._received_topic, arrival_ns, stamp_ns, frame)

    def send_pose(self, pose: RelativePose) -> None:
        """Send a pose, or reject it. Never blocks."""
        with self._lock:
            now_ns = self._now_ns()
            self._send_periodic(now_ns)
            messages = self.poses.messages(pose, now_ns, self._link_reason(now_ns))
            sent = [message for message in messages if self._send(message, pose)]
            if sent:
                self.poses.on_sent(pose, now_ns, sent)
                frame = self.poses.frame
                if frame is not None and any(message.get_type() in POSES for message in sent):
                    self.switch.on_sent(pose, frame, self.poses.turn_rad(pose), self.poses.autopilot, now_ns)
            self._send_texts(now_ns)

    def report_odom(self) -> bool:
        """Report the autopilot's frame in `map` at the newest pose once more; False: none was sent."""
        with self._lock:
            self._earlier_odom = self._sent_state.odom or self._earlier_odom
            return self._earlier_odom is not None

    def sent(self) -> list[Record]:
        """Records of the frames sent since the previous call."""
        with self._lock:
            return self._sender.records()

    @property
    def counters(self) -> Counters:
        """Totals since the start; in groups what was sent and not sent by message, and rejected poses by reason."""
        with self._lock:
            groups = {
                SENT: dict(self._sender.sent),
                NOT_SENT: dict(self._sender.not_sent),
                POSE_REJECTED: {reason.value: count for reason, count in self.poses.rejected.items()},
            }
            counts = dict(self.counts)
            if self.poses.fusion.rejections:
                counts["pose rejected by the autopilot"] = self.poses.fusion.rejections
            if self.origin.sent_times:
                counts["origin sent"] = self.origin.sent_times
            if self.switch.requests:
                counts["source sets requested"] = self.switch.requests
            if self.switch.agreement.disagreements:
                counts["pose and autopilot differ"] = self.switch.agreement.disagreements
            if self.poses.frame is not None:
                counts["yaw in map of the sent axes [deg]"] = round(math.degrees(self.poses.frame.yaw_rad))
                counts |= {
                    f"map's origin in the sent axes, {axis} [cm]": round(100.0 * metres)
                    for axis, metres in zip("xyz", self.poses.frame.offset_m.tolist(), strict=True)
                }
            round_trip_ns = self._timesync.newest_ns
            intervals = self.intervals.counters
        totals = {
            **counts,
            **intervals,
            "stray bytes": self._splitter.stray_bytes,
            "from other senders": self.connection.foreign,
            "reconnects": self.connection.reconnects,
            "closed: blocked": self.connection.stalls,
            "sent late": self.connection.late_frames,
            **({"round trip [ms]": round_trip_ns // 1_000_000} if round_trip_ns is not None else {}),
            **({"signing time not written": self._signer.unwritten} if self._signer is not None else {}),
        }
        return Counters(totals, groups=groups)

    @property
    def closed(self) -> bool:
        """Whether the session was closed."""
        return self._closed.is_set()

    @property
    def status(self) -> str | None:
        """See Link: error text of the connection, the autopilot's silence, latency, or signing."""
        if self.closed:
            return None
        signing = None if self._signer is None else self._signer.status
        own = self.origin.status or (REJECTED if self.poses.fusion.stopped else None)
        return (
            self.connection.status
            or self._silence()
            or self._timesync.status
            or own
            or signing
            or self._sent_state.status
            or self.intervals.status
            or self.switch.status
        )

    def _silence(self) -> str | None:
        if self._now_ns() - self._target_ns < SILENCE_REPORTED_S * SECOND_NS:
            return None
        return (
            f"no frame from the autopilot (system {self._target[0]}, component {self._target[1]}) for "
            f"{SILENCE_REPORTED_S:g} s: is it powered, is this its connection, and are system_id and component_id "
            "correct?"
        )

    def close(self) -> None:
        """Stop the thread and close the connection."""
        self._closed.set()
        housekeeping, saving = self._threads
        if housekeeping.is_alive():
            housekeeping.join()
        if saving.is_alive():
            saving.join(SAVED_S)
        with self._lock:
            self.connection.close()
            if self._signer is not None:
                self._signer.close()

    def _on_frame(self, frame: bytes, message: Any, source: tuple[str, int], arrival_ns: int) -> int | None:
        """Handle a frame. Returns its stamp as a record; None: not for the graph."""
        sender, _ = header(frame)
        if sender == self._own:
            self.counts["echo of our own"] += 1
            return None
        with self._lock:
            if self._signer is not None and not self._signer.verify(frame):
                genuine = self._signer.genuine(frame)
                self.counts["signed with our key, but not new" if genuine else "not signed with our key"] += 1
                if genuine and sender == self._target:
                    self._accept_for_heartbeats(source)
                return None
            self.counts["received"] += 1
            if sender == self._target:
                self.connection.reply_to(source)
                if self._now_ns() - self._target_ns > SILENCE_REPORTED_S * SECOND_NS:
                    self.origin.restart()
                    self.intervals.restart()
                    self.switch.on_silence()
                if not self._is_reachable(self._now_ns()):
                    self._timesync.reset()
                self._timesync.on_frame()
                self._target_ns, self._target_connection = self._now_ns(), self.connection.reconnects
                self.origin.on_message(message)
                self.poses.on_estimator_status(message, arrival_ns, self.switch.uses_grd)
                self._on_estimate(self.poses.autopilot.add(message, arrival_ns))
                self.intervals.on_message(message, arrival_ns)
                self.switch.on_message(message, arrival_ns)
                if message.get_type() == "TIMESYNC":
                    if message.tc1 == 0:
                        self._send(dialect().MAVLink_timesync_message(self._now_ns(), message.ts1))
                    elif self._timesync.on_reply(message.ts1, arrival_ns, self.poses.sending):
                        self._on_estimate(self.poses.autopilot.on_timesync(message.tc1 // 1_000_000))
                        return message.ts1
        return arrival_ns

    def _on_estimate(self, event: EstimateEvent | None) -> None:
        """What the autopilot's own estimate shows. The lock is held."""
        if event is EstimateEvent.BOOTED:
            self.poses.on_boot()
            self.origin.restart()
            self.intervals.restart()
            self.switch.on_boot()
        elif event is EstimateEvent.YAW_RESET:
            self.poses.on_yaw_reset()

    def _accept_for_heartbeats(self, source: tuple[str, int]) -> None:
        """Send heartbeats, but no poses, to an autopilot that signs with an old time until it receives our time.

        Old frames can be replayed by anybody, so they never replace an authenticated source.
        """
        if self._target_connection is None or not self._is_reachable(self._now_ns()):
            self._target_connection = NO_CONNECTION
            self.connection.reply_to(source)

    def _is_reachable(self, now_ns: int) -> bool:
        """Whether the autopilot presumably receives frames now. Over UDP this includes one that never sent any."""
        if self._target_connection is None:
            return self.connection.datagrams
        return self._target_connection == self.connection.reconnects and now_ns - self._target_ns < MAX_SILENCE_NS

    def _link_reason(self, now_ns: int) -> RejectReason | None:
        """Why no pose may be sent over the link now. The lock is held."""
        if not self._is_reachable(now_ns):
            return RejectReason.AUTOPILOT_SILENT
        return RejectReason.LINK_LATE if self._timesync.late else None

    def _run(self) -> None:
        while not self._closed.wait(WAKE_S):
            self.tick()

    def _save(self) -> None:
        """Write to the disk, in a thread of its own: on one that stalls only this waits."""
        while not self._closed.wait(WAKE_S):
            self.write_state()
            if self._signer is not None:
                self._signer.write_timestamp()

    def _send_periodic(self, now_ns: int) -> None:
        """Send HEARTBEAT and TIMESYNC if they are due. The lock is held."""
        if now_ns - self._heartbeat_ns >= SECOND_NS:
            state = ACTIVE if self.poses.sending else STANDBY
            if self._send(dialect().MAVLink_heartbeat_message(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, state, 3)):
                self._heartbeat_ns = now_ns
        if now_ns - self._request_ns >= REQUEST_PERIOD_NS:
            request_ns = self._now_ns()
            if self._send(dialect().MAVLink_timesync_message(0, request_ns)):
                self._request_ns = now_ns
                if self._timesync.on_request(request_ns):
                    self.poses.texts.warn("no TIMESYNC replies: latency unknown")
        if self.connection.late_frames != self._late_frames:
            self._late_frames = self.connection.late_frames
            self._timesync.on_late_frame(now_ns)

    def tick(self) -> None:
        """Send the periodic messages that are due; to be called every WAKE_S."""
        with self._lock:
            now_ns = self._now_ns()
            self._send_periodic(now_ns)
            for message in self.origin.due(now_ns):
                if not self._send(message):
                    self.origin.on_not_sent()
            if self._target_connection is not None and self._is_reachable(now_ns):
                request = self.intervals.due(now_ns)
                if request is not None and not self._send(request):
                    self.intervals.on_not_sent()
                request = self.switch.due(now_ns)
                if request is not None and not self._send(request):
                    self.switch.on_not_sent()
            self._send_texts(now_ns)

    def write_state(self) -> None:
        """Write the newest sent pose if it is due; to be called every WAKE_S, by one thread. It may block."""
        self._sent_state.write()

    def _send_texts(self, now_ns: int) -> None:
        """Send the text that is due. The lock is held."""
        for message in self.poses.due_texts(now_ns):
            if not self._send(message):
                self.poses.texts.on_not_sent()

    def _send(self, message: Any, pose: RelativePose | None = None) -> bool:
        """Send one message, of a pose if it is one. The lock is held."""
        if pose is not None:
            pose = self.poses.with_axes(pose)
        if pose is not None and self.poses.sends_yaw:  # a restart needs the yaw that its ATTITUDE has, right or wrong
            pose = dataclasses.replace(pose, odom_yaw_rad=None, odom_yaw_sigma_rad=None)
        return self._sender.send(
            message, None if pose is None else lambda: odom_frame(pose, self.poses.autopilot, self._own)
        )
