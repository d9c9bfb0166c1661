"""A live link to one autopilot: hears it, answers it, and sends it what is due, from whichever thread.

    received -> frames -> signature, echo -> records for the graph; TIMESYNC requests are answered at once
    poses    -> gate and speaker -> frames, at once or not at all; none to an autopilot that has fallen silent: what
                stands still, it or a bridge before it, would keep them and take them for new when it goes on; none
                while they would come late (`round_trip.py`)
    a thread of its own: HEARTBEAT once a second, TIMESYNC four times, texts, the origin; also when no pose comes.
                What is due and finds the line full is tried again at each step, before a pose: it is small

An answer to our own TIMESYNC is recorded with the time that it was asked at as its stamp: by that the decoder knows it
from another's, in replay, too.

time_usec and TIMESYNC are the host's timeline, microseconds and nanoseconds since 1970. ArduPilot finds the offset to
its own clock by the promptest message (JitterCorrection), PX4 by the answers to its own TIMESYNC requests.

Source: https://mavlink.io/en/services/timesync.html, /heartbeat.html; ArduPilot libraries/AP_RTC/JitterCorrection.cpp;
PX4 src/modules/mavlink/mavlink_timesync.cpp.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any

from flow.link import LinkError, Record
from links.mavlink.connection import Connection
from links.mavlink.gate import Refusal
from links.mavlink.origin import OriginGiver
from links.mavlink.round_trip import ASK_NS, RoundTrips
from links.mavlink.signing import Signer
from links.mavlink.speaker import PoseSpeaker
from links.mavlink.wire import FrameSplitter, dialect, header, packed
from stages.messages import RelativePose

WAKE_S = 0.05  # how often the housekeeper looks, and a waiting listener whether it was closed
SILENT_S = 3.0  # three heartbeats
SECOND_NS = 1_000_000_000
QUIET_NS = 1_500_000_000  # a heartbeat and a half: it gets no poses
ONBOARD_CONTROLLER, NO_AUTOPILOT = 18, 8  # MAV_TYPE, MAV_AUTOPILOT_INVALID
NOWHERE = -1
STANDBY, ACTIVE = 3, 4  # MAV_STATE
SENT_RECORDS = 4096  # kept for the recording until it asks


class Session:
    """One connection's life. `records` from one thread, `pose` and `sent` from others."""

    def __init__(
        self,
        connection: Connection,
        target: tuple[int, int],
        own: tuple[int, int],
        speaker: PoseSpeaker,
        origin: OriginGiver,
        signer: Signer | None,
        now_ns: Callable[[], int],
        topics: tuple[str, str],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.connection, self.speaker, self.origin = connection, speaker, origin
        self._target, self._own = target, own
        self._signer, self._now_ns = signer, now_ns
        self._received_topic, self._sent_topic = topics
        self._splitter = FrameSplitter()
        self._split_on = 0  # the connection, by `reconnects`
        self._mav = dialect().MAVLink(None, srcSystem=own[0], srcComponent=own[1])
        self._sent: deque[Record] = deque(maxlen=SENT_RECORDS)
        self._lock = threading.Lock()  # over what numbers, signs and sends
        self._closed = threading.Event()
        self._second_ns = self._asked_ns = 0
        self._trips = RoundTrips()
        self._left_late = 0  # frames, of those that the connection counts
        self._target_ns = now_ns()  # when the autopilot was heard last, or the session began
        self._heard_on: int | None = None  # the connection, by `reconnects`; NOWHERE: only with an old signature
        if signer is not None:
            signer.keep()  # it may come from a session before
        self._keeper = threading.Thread(target=self._keep, name="mavlink housekeeping", daemon=True)
        self._keeper.start()

    def records(self) -> Iterator[Record]:
        """Frames as they arrive, until closed. LinkError when the link has failed for good."""
        while not self._closed.is_set():
            try:
                received = self.connection.receive(WAKE_S)
            except LinkError:
                if self._closed.is_set():
                    return
                raise
            if received is None:
                continue
            arrival_ns = self._now_ns()
            data, source = received
            if self._split_on != self.connection.reconnects:
                self._splitter.begin_anew()
                self._split_on = self.connection.reconnects
            frames = self._splitter.datagram(data) if self.connection.datagrams else self._splitter.stream(data)
            for frame, message in frames:
                stamp_ns = self._hear(frame, message, source, arrival_ns)
                if stamp_ns is not None:
                    yield Record(self._received_topic, arrival_ns, stamp_ns, frame)

    def pose(self, pose: RelativePose) -> None:
        """Send a pose, or refuse it; never waits for the line."""
        with self._lock:
            now_ns = self._now_ns()
            self._beat(now_ns)
            messages = self.speaker.speak(pose, now_ns, self._refusal(now_ns))
            if any([self._send(message) for message in messages]):  # all are tried
                self.speaker.went_out(pose, now_ns)
            self._say(now_ns)

    def sent(self) -> list[Record]:
        """What went out since the call before."""
        with self._lock:
            records = list(self._sent)
            self._sent.clear()
        return records

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start: received, sent, not sent, held back by reason."""
        with self._lock:
            held = {f"pose held back: {why.value}": count for why, count in self.speaker.refused.items()}
            counts = dict(self.counts)
            took_ns = self._trips.newest_ns
        return {
            **counts,
            **held,
            "stray bytes": self._splitter.stray_bytes,
            "from other senders": self.connection.foreign,
            "reconnects": self.connection.reconnects,
            "dropped: stood still": self.connection.stalls,
            "left late": self.connection.left_late,
            **({"round trip [ms]": took_ns // 1_000_000} if took_ns is not None else {}),
            **({"signing time not written": self._signer.unwritten} if self._signer is not None else {}),
        }

    @property
    def closed(self) -> bool:
        """Whether nothing goes out any more."""
        return self._closed.is_set()

    @property
    def status(self) -> str | None:
        """What does not work now; None: all does."""
        if self.closed:
            return None
        signing = None if self._signer is None else self._signer.status
        return self.connection.status or self._silence() or self._trips.status or signing

    def _silence(self) -> str | None:
        if self._now_ns() - self._target_ns < SILENT_S * SECOND_NS:
            return None
        return (
            f"no word from the autopilot (system {self._target[0]}, component {self._target[1]}) for "
            f"{SILENT_S:g} s: is it powered, does it speak here, and are system_id and component_id its own?"
        )

    def close(self) -> None:
        """Stop and let go of the line."""
        self._closed.set()
        self._keeper.join()
        with self._lock:
            self.connection.close()
            if self._signer is not None:
                self._signer.close()

    def _hear(self, frame: bytes, message: Any, source: tuple[str, int], arrival_ns: int) -> int | None:
        """The stamp of a frame for the graph, None of another; acts on those that ask something."""
        sender, _ = header(frame)
        if sender == self._own:
            self.counts["our own, come back"] += 1
            return None
        with self._lock:
            if self._signer is not None and not self._signer.verify(frame):
                genuine = self._signer.genuine(frame)
                self.counts["signed with our key, but not new" if genuine else "not signed with our key"] += 1
                if genuine and sender == self._target:
                    self._tell_time(source)
                return None
            self.counts["received"] += 1
            if sender == self._target:
                self.connection.answer_to(source)
                if self._now_ns() - self._target_ns > SILENT_S * SECOND_NS:
                    self.origin.restart()
                if not self._hears(self._now_ns()):
                    self._trips.begin_anew()
                self._trips.heard()
                self._target_ns, self._heard_on = self._now_ns(), self.connection.reconnects
                self.origin.hear(message)
                if message.get_type() == "TIMESYNC":
                    if message.tc1 == 0:
                        self._send(dialect().MAVLink_timesync_message(self._now_ns(), message.ts1))
                    elif self._trips.answered(message.ts1, arrival_ns, self.speaker.sending):
                        return message.ts1
        return arrival_ns

    def _tell_time(self, source: tuple[str, int]) -> None:
        """An autopilot without a clock signs with an old time until it hears ours: heartbeats go to it, poses do not.

        Anybody may send its old frames again, so that one that is heard is not left for them.
        """
        if self._heard_on is None or not self._hears(self._now_ns()):
            self._heard_on = NOWHERE
            self.connection.answer_to(source)

    def _hears(self, now_ns: int) -> bool:
        """Whether the autopilot takes what is sent now, as it seems. By UDP one that never spoke is sent to, too."""
        if self._heard_on is None:
            return self.connection.datagrams
        return self._heard_on == self.connection.reconnects and now_ns - self._target_ns < QUIET_NS

    def _refusal(self, now_ns: int) -> Refusal | None:
        """Why no pose may go out on this line now, however good it is. The lock is held."""
        if not self._hears(now_ns):
            return Refusal.NOT_HEARD
        return Refusal.LINE_LATE if self._trips.late else None

    def _keep(self) -> None:
        while not self._closed.wait(WAKE_S):
            with self._lock:
                self._tick(self._now_ns())
            if self._signer is not None:
                self._signer.keep()  # not under the lock: the disk may be slow

    def _beat(self, now_ns: int) -> None:
        """HEARTBEAT and TIMESYNC, where they are due and the line takes them. The lock is held."""
        if now_ns - self._second_ns >= SECOND_NS:
            state = ACTIVE if self.speaker.sending else STANDBY
            if self._send(dialect().MAVLink_heartbeat_message(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, state, 3)):
                self._second_ns = now_ns
        if now_ns - self._asked_ns >= ASK_NS:
            asked_ns = self._now_ns()
            if self._send(dialect().MAVLink_timesync_message(0, asked_ns)):
                self._asked_ns = now_ns
                if self._trips.asked(asked_ns):
                    self.speaker.warn("answers no TIMESYNC: late is not seen")
        if self.connection.left_late != self._left_late:
            self._left_late = self.connection.left_late
            self._trips.left_late(now_ns)

    def _tick(self, now_ns: int) -> None:
        self._beat(now_ns)
        for message in self.origin.due(now_ns):
            if not self._send(message):
                self.origin.unsent()
        self._say(now_ns)

    def _say(self, now_ns: int) -> None:
        """The text that is due. The lock is held."""
        for message in self.speaker.texts(now_ns):
            if not self._send(message):
                self.speaker.unsaid()

    def _send(self, message: Any) -> bool:
        """Pack, sign and send one message. The lock is held."""
        now_ns = self._now_ns()
        if self._signer is not None:
            self._signer.sign_for(self._mav, now_ns)
        frame = packed(message, self._mav)
        kind = message.get_type()
        if not self.connection.send(frame):
            self.counts[f"not sent: {kind}"] += 1
            return False
        self.counts[f"sent: {kind}"] += 1
        self._sent.append(Record(self._sent_topic, now_ns, now_ns, frame))
        return True
