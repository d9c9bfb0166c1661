"""The servo process: reads the servo at a fixed rate, sends goals, and restores operation after faults.

A separate process is not delayed by other threads, and the servo stops when it or its parent dies. When the parent
ends, the socket closes and this process stops the servo. When this process ends, the servo receives no requests and its
bus watchdog stops it. When the parent does not respond, it sends no more `wire.Alive` packets and the servo is stopped.

After a fault no goals are sent. The servo is still read if it replies (it measures its angle without torque), and it is
set up again, with increasing pauses while that fails. The pauses are short, so that a replugged cable is used soon;
after a shutdown they are long, because each reboot enables an overloaded motor again.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from collections import Counter

from links.dynamixel import mx28, wire
from links.dynamixel.bus import Bus, BusError, Gone, RequestRejected
from links.dynamixel.drive import ARRIVED_TICKS, Drive, DriveSettings, Measurement, SetupError, Shutdown
from links.dynamixel.reading_filter import ReadingFilter

MS_NS = 1_000_000
S_NS = 1_000_000_000
HEALTH_NS = 100 * MS_NS  # period of reading torque, error and watchdog, and of Health packets
SUPPLY_NS = S_NS  # period of reading voltage and temperature
LOST_NS = 200 * MS_NS  # a servo that is silent for longer is set up again
PAUSE_NS, MAX_PAUSE_NS, MAX_REBOOT_PAUSE_NS = 100 * MS_NS, S_NS, 10 * S_NS  # between two attempts
STEADY_NS = 10 * S_NS  # after operation without a fault for this long, pauses start at PAUSE_NS again
PARENT_TIMEOUT_NS = 500 * MS_NS  # a busy parent may be late by some tenths of a second
STOP_NS = 700 * MS_NS  # limit of stopping the servo at the end; its watchdog has stopped it by then


class ParentGone(Exception):
    """The parent has ended, or closed the socket."""


class ServoWorker:
    """Drives one servo for the process at the other end of `parent_socket`."""

    def __init__(self, parent_socket: socket.socket, settings: DriveSettings) -> None:
        self._socket, self._settings = parent_socket, settings
        self._parent_pid = os.getppid()
        self._bus: Bus | None = None
        self._drive: Drive | None = None
        self._driving = self._was_driving = False
        self._goal: wire.Goal | None = None
        self._goal_ends_ns = 0  # 0: no goal to wait for
        self._parent_ns = time.monotonic_ns()  # arrival of the parent's newest packet
        self._stop_requested = False
        self._error = 0
        self._counts: Counter[str] = Counter()
        self._faults: Counter[str] = Counter()
        self._filter = ReadingFilter()
        self._supply = 0, 0
        self._start_ns = self._next_ns = self._healthy_ns = time.monotonic_ns()
        self._failing_ns = 0  # time of the first failure since the last success; 0: none
        self._retry_ns = self._health_ns = self._reported_ns = self._supply_ns = 0
        self._pause_ns = self._reboot_pause_ns = PAUSE_NS

    def run(self) -> None:
        """Run until the parent is gone. Raises SetupError when an operator has to change something."""
        try:
            while True:
                self._wait()
                try:
                    self._cycle(time.monotonic_ns())
                    self._failing_ns = 0
                except BusError as error:
                    self._on_failure(error, time.monotonic_ns())
                self._report_health()
        except ParentGone:
            return
        finally:
            self._shut_down()

    def _wait(self) -> None:
        """Wait until the next cycle is due; receive goals meanwhile and keep the newest."""
        self._next_ns += round(S_NS / self._settings.rate_hz)
        now_ns = time.monotonic_ns()
        if now_ns > self._next_ns + round(S_NS / self._settings.rate_hz):
            self._counts["late_cycles"] += 1
            self._next_ns = now_ns
        while True:
            left_s = max(self._next_ns - time.monotonic_ns(), 0) / S_NS
            if not select.select([self._socket], [], [], left_s)[0]:
                return
            try:
                data = self._socket.recv(wire.MAX_BYTES)
            except ConnectionError:
                data = b""
            if not data:
                raise ParentGone
            packet = wire.unpack(data)
            self._parent_ns = time.monotonic_ns()
            if isinstance(packet, wire.Goal):
                self._counts["goals_lost"] += (self._goal is not None) or not self._driving
                self._goal, self._stop_requested = (packet if self._driving else None), False
            elif isinstance(packet, wire.Stop):
                self._goal, self._stop_requested = None, True

    def _cycle(self, now_ns: int) -> None:
        if self._drive is None:
            if now_ns < self._retry_ns:
                return
            self._open()
        assert self._drive is not None
        if not self._driving and now_ns >= self._retry_ns:
            self._set_up(now_ns)
        if self._stop_requested and self._driving:
            self._drive.stop()  # a failure is repeated in the next cycle
            self._stop_requested, self._goal_ends_ns = False, 0
        if self._goal is not None and self._driving:
            self._send_goal(self._goal)
        measured = self._drive.measure()
        new_alert = measured.alert and not self._error
        if self._driving and (new_alert or self._failing_ns or now_ns - self._health_ns > HEALTH_NS):
            self._health_ns = now_ns
            self._check_condition(now_ns)
        self._publish(measured)
        if self._goal_ends_ns and measured.reply_ns > self._goal_ends_ns:
            self._abandon_goal(measured, "goals_expired")
        elif self._goal_ends_ns and now_ns > self._parent_ns + PARENT_TIMEOUT_NS:
            self._abandon_goal(measured, "parent_silent")
        if now_ns - self._supply_ns > SUPPLY_NS:
            self._supply_ns = now_ns
            self._supply = self._drive.supply()

    def _open(self) -> None:
        s = self._settings
        self._bus = Bus.open(s.port, s.baud, s.servo_id, 1e-3 * s.reply_timeout_ms)
        self._drive = Drive(self._bus, s)

    def _set_up(self, now_ns: int) -> None:
        """Set the servo up; reboot it first if it has shut down."""
        assert self._drive is not None
        assert self._bus is not None
        self._schedule_retry(now_ns)
        try:
            self._error = self._drive.set_up()
        except Shutdown as shutdown:
            self._error = shutdown.error
            self._retry_ns = now_ns + self._reboot_pause_ns
            self._reboot_pause_ns = min(2 * self._reboot_pause_ns, MAX_REBOOT_PAUSE_NS)
            if self._settings.reboot:
                self._bus.reboot()
                self._counts["reboots"] += 1
            return
        self._counts["set_ups"] += 1
        self._driving = self._was_driving = True
        self._healthy_ns = self._health_ns = time.monotonic_ns()

    def _send_goal(self, goal: wire.Goal) -> None:
        """Send a goal and compute the time by which it must be reached."""
        assert self._drive is not None
        try:
            self._drive.go(goal.position_ticks, goal.velocity_units)
        except RequestRejected:
            self._goal = None  # it would be rejected again
            self._health_ns = 0  # read the condition in the next cycle
            raise
        self._goal = None
        self._counts["goals_sent"] += 1
        self._goal_ends_ns = self._end_ns(goal, mx28.STEPS_PER_TURN)  # worst case, in case the next read fails
        self._goal_ends_ns = self._end_ns(goal, abs(goal.position_ticks - self._drive.measure().position_ticks))

    def _end_ns(self, goal: wire.Goal, travel_ticks: int) -> int:
        """Time at which a travel that starts now must be complete."""
        travel_s = travel_ticks * mx28.TICK_RAD / (goal.velocity_units * mx28.VELOCITY_UNIT_RADPS)
        return time.monotonic_ns() + round(travel_s * S_NS) + round(self._settings.goal_slack_ms * MS_NS)

    def _abandon_goal(self, measured: Measurement, why: str) -> None:
        """Stop the servo if the goal is not reached: its time is over, or the parent is silent. `why`: the counter."""
        assert self._drive is not None
        if self._driving and abs(measured.position_ticks - self._drive.goal_ticks) > ARRIVED_TICKS:
            self._drive.stop()  # a failure is repeated in the next cycle
            self._counts[why] += 1
        self._goal_ends_ns = 0

    def _check_condition(self, now_ns: int) -> None:
        """Check that the servo still has torque and its watchdog has not tripped; otherwise stop driving."""
        assert self._drive is not None
        condition = self._drive.condition()
        self._error = condition.error
        if condition.torque and not condition.watchdog_tripped:  # an error that causes no shutdown is accepted
            if now_ns - self._healthy_ns > STEADY_NS:
                self._pause_ns = self._reboot_pause_ns = PAUSE_NS
            return
        self._counts["torque_losses"] += not condition.torque
        self._counts["watchdog_stops"] += condition.watchdog_tripped
        self._stop_driving()
        self._retry_ns = now_ns + (self._reboot_pause_ns if condition.error else 0)

    def _on_failure(self, error: BusError, now_ns: int) -> None:
        self._faults[error.kind] += 1
        self._failing_ns = self._failing_ns or now_ns
        if isinstance(error, Gone):
            self._close()
            self._stop_driving()
            self._schedule_retry(now_ns)
        elif now_ns - self._failing_ns > LOST_NS and self._driving:
            self._stop_driving()
        if not self._was_driving and now_ns - self._start_ns > 1e9 * self._settings.start_s:
            raise SetupError(self._start_error(error))

    def _stop_driving(self) -> None:
        """Stop driving and drop the goal."""
        self._counts["goals_lost"] += self._goal is not None
        self._driving, self._goal, self._goal_ends_ns = False, None, 0

    def _schedule_retry(self, now_ns: int) -> None:
        self._retry_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, MAX_PAUSE_NS)

    def _start_error(self, error: BusError) -> str:
        s = self._settings
        if isinstance(error, Gone):
            return f"{error}. Is the USB adapter plugged in, `port` right, and this user in the group dialout?"
        return (
            f"{s.port}: the servo with id {s.servo_id} does not reply at {s.baud} baud ({error}). Is it powered "
            "(12 V) and wired, and are `servo_id` and `baud` those of the servo (from the factory 1 and 57600)?"
        )

    def _publish(self, measured: Measurement) -> None:
        """Send a reading to the parent unless the filter rejects it."""
        assert self._drive is not None
        self._counts["reads"] += 1
        reason = self._filter.reject_reason(measured)
        if reason is not None:
            self._counts[reason] += 1
            return
        reading = wire.Reading(
            measured.request_ns,
            measured.reply_ns,
            measured.position_ticks,
            measured.velocity_units,
            self._drive.goal_ticks,
            self._error,
        )
        self._send_packet(reading)

    def _report_health(self) -> None:
        """Send a Health packet when one is due."""
        now_ns = time.monotonic_ns()
        if now_ns - self._reported_ns < HEALTH_NS:
            return
        self._reported_ns = now_ns
        if os.getppid() != self._parent_pid:  # another process may hold the other end of the socket
            raise ParentGone
        faults, counts = self._faults, self._counts
        health = wire.Health(
            connected=self._driving,
            reads=counts["reads"],
            goals_sent=counts["goals_sent"],
            goals_expired=counts["goals_expired"],
            goals_lost=counts["goals_lost"],
            parent_silent=counts["parent_silent"],
            no_reply=faults["no reply"],
            damaged=faults["damaged"],
            wrong=faults["late or foreign"],
            rejected=faults["rejected by the servo"],
            unplugged=faults["unplugged"],
            set_ups=counts["set_ups"],
            reboots=counts["reboots"],
            torque_losses=counts["torque_losses"],
            watchdog_stops=counts["watchdog_stops"],
            late_cycles=counts["late_cycles"],
            unsent=counts["unsent"],
            slow=counts["slow"],
            implausible=counts["implausible"],
            low_latency=self._bus is not None and self._bus.low_latency,
            voltage_mv=self._supply[0],
            temperature_c=self._supply[1],
        )
        self._send_packet(health)

    def _send_packet(self, packet: wire.Packet) -> None:
        try:
            self._socket.send(wire.pack(packet), socket.MSG_DONTWAIT)
        except BlockingIOError:
            self._counts["unsent"] += 1
        except OSError:
            raise ParentGone from None

    def _shut_down(self) -> None:
        """Stop the servo if possible, and close the port."""
        deadline_ns = time.monotonic_ns() + STOP_NS
        while self._drive is not None and time.monotonic_ns() < deadline_ns:
            try:
                self._drive.stop()
                break
            except Gone:
                break
            except BusError:
                continue
        self._close()

    def _close(self) -> None:
        if self._bus is not None:
            self._bus.close()
        self._bus = self._drive = None


def main() -> int:
    """`python -m links.dynamixel.worker FD SETTINGS`. FD: this end of the socket, inherited. Returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with socket.socket(fileno=int(sys.argv[1])) as parent_socket:
        try:
            ServoWorker(parent_socket, DriveSettings.from_text(sys.argv[2])).run()
        except SetupError as error:
            parent_socket.send(wire.pack(wire.fatal(str(error))))
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
