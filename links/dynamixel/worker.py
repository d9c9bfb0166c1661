"""The servo's own process: reads the servo at a fixed rate, sends it goals, brings it back after faults.

Alone in its process nothing holds it up, and when it or its parent dies nothing moves on: the parent's end shows as the
end of the socket, and the servo is stopped where it is; this process's end shows to the servo as silence, and its bus
watchdog stops it. A parent that hangs is one that no longer says that it takes the readings (`wire.Alive`): the servo
stays where it is. A fault ends driving: the servo holds where it is, is read on if it answers (a servo that has let go
still measures its angle), and is set up again, with growing pauses while that fails: short ones, so that a plug put
back is served soon, but after a shutdown long ones, since each reboot lets an overloaded motor push again.

Source: ours.
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
from links.dynamixel.bus import Bus, BusError, Gone, Refused
from links.dynamixel.drive import ARRIVED_TICKS, Drive, DriveSettings, Measured, SetupError, Shutdown
from links.dynamixel.reading_filter import ReadingFilter

MS_NS = 1_000_000
S_NS = 1_000_000_000
HEALTH_NS = 100 * MS_NS  # how often torque, error and watchdog are looked at, and totals are told
SUPPLY_NS = S_NS  # voltage and temperature
LOST_NS = 200 * MS_NS  # a servo silent for so long is set up anew
PAUSE_NS, LONGEST_PAUSE_NS, LONGEST_REBOOT_NS = 100 * MS_NS, S_NS, 10 * S_NS  # between attempts; of reboots the last
STEADY_NS = 10 * S_NS  # driving for so long without a fault: the next fault's pause is the first one again
HUNG_NS = 500 * MS_NS  # a parent silent for so long is not followed any more; a busy one may be late by some tenths
STOP_NS = 700 * MS_NS  # for stopping the servo at the end; then its watchdog has done it


class ParentGone(Exception):
    """Nobody wants the servo any more."""


class Worker:
    """Drives one servo for the process at the other end of `line`."""

    def __init__(self, line: socket.socket, settings: DriveSettings) -> None:
        self._line, self._settings = line, settings
        self._parent = os.getppid()
        self._bus: Bus | None = None
        self._drive: Drive | None = None
        self._driving = self._ever = False
        self._goal: wire.Goal | None = None
        self._goal_ends_ns = 0  # 0: nothing to wait for
        self._heard_ns = time.monotonic_ns()  # when the parent spoke last
        self._halt = False
        self._error = 0
        self._counts: Counter[str] = Counter()
        self._faults: Counter[str] = Counter()
        self._filter = ReadingFilter()
        self._supply = 0, 0
        self._began_ns = self._next_ns = self._healthy_ns = time.monotonic_ns()
        self._failing_ns = 0  # since when nothing succeeded; 0: all is well
        self._retry_ns = self._health_ns = self._told_ns = self._supply_ns = 0
        self._pause_ns = self._reboot_pause_ns = PAUSE_NS

    def run(self) -> None:
        """Until the parent is gone. SetupError when a person has to change something."""
        try:
            while True:
                self._wait()
                try:
                    self._cycle(time.monotonic_ns())
                    self._failing_ns = 0
                except BusError as error:
                    self._failed(error, time.monotonic_ns())
                self._tell()
        except ParentGone:
            return
        finally:
            self._leave()

    def _wait(self) -> None:
        """Until the next cycle is due; goals are taken meanwhile, the newest counts."""
        self._next_ns += round(S_NS / self._settings.rate_hz)
        now_ns = time.monotonic_ns()
        if now_ns > self._next_ns + round(S_NS / self._settings.rate_hz):
            self._counts["late_cycles"] += 1
            self._next_ns = now_ns
        while True:
            left_s = max(self._next_ns - time.monotonic_ns(), 0) / S_NS
            if not select.select([self._line], [], [], left_s)[0]:
                return
            try:
                data = self._line.recv(wire.MAX_BYTES)
            except ConnectionError:
                data = b""
            if not data:
                raise ParentGone
            packet = wire.unpack(data)
            self._heard_ns = time.monotonic_ns()
            if isinstance(packet, wire.Goal):
                self._counts["goals_lost"] += (self._goal is not None) or not self._driving
                self._goal, self._halt = (packet if self._driving else None), False
            elif isinstance(packet, wire.Stop):
                self._goal, self._halt = None, True

    def _cycle(self, now_ns: int) -> None:
        if self._drive is None:
            if now_ns < self._retry_ns:
                return
            self._open()
        assert self._drive is not None
        if not self._driving and now_ns >= self._retry_ns:
            self._restore(now_ns)
        if self._halt and self._driving:
            self._drive.stop()  # tried again in the next cycle where it fails
            self._halt, self._goal_ends_ns = False, 0
        if self._goal is not None and self._driving:
            self._send(self._goal)
        measured = self._drive.measure()
        alarmed = measured.alert and not self._error
        if self._driving and (alarmed or self._failing_ns or now_ns - self._health_ns > HEALTH_NS):
            self._health_ns = now_ns
            self._check(now_ns)
        self._pass_on(measured)
        if self._goal_ends_ns and measured.reply_ns > self._goal_ends_ns:
            self._give_up(measured, "goals_expired")
        elif self._goal_ends_ns and now_ns > self._heard_ns + HUNG_NS:
            self._give_up(measured, "parent_hangs")
        if now_ns - self._supply_ns > SUPPLY_NS:
            self._supply_ns = now_ns
            self._supply = self._drive.supply()

    def _open(self) -> None:
        s = self._settings
        self._bus = Bus.open(s.port, s.baud, s.servo_id, 1e-3 * s.reply_timeout_ms)
        self._drive = Drive(self._bus, s)

    def _restore(self, now_ns: int) -> None:
        """Set up, after a reboot where the servo has shut down."""
        assert self._drive is not None
        assert self._bus is not None
        self._later(now_ns)
        try:
            self._error = self._drive.set_up()
        except Shutdown as shutdown:
            self._error = shutdown.error
            self._retry_ns = now_ns + self._reboot_pause_ns
            self._reboot_pause_ns = min(2 * self._reboot_pause_ns, LONGEST_REBOOT_NS)
            if self._settings.reboot:
                self._bus.reboot()
                self._counts["reboots"] += 1
            return
        self._counts["set_ups"] += 1
        self._driving = self._ever = True
        self._healthy_ns = self._health_ns = time.monotonic_ns()

    def _send(self, goal: wire.Goal) -> None:
        """The goal, and until when it has to be reached."""
        assert self._drive is not None
        try:
            self._drive.go(goal.position_ticks, goal.velocity_units)
        except Refused:
            self._goal = None  # it would be refused again
            self._health_ns = 0  # look why
            raise
        self._goal = None
        self._counts["goals_sent"] += 1
        self._goal_ends_ns = self._end_ns(goal, mx28.STEPS_PER_TURN)  # from anywhere, while it does not answer
        self._goal_ends_ns = self._end_ns(goal, abs(goal.position_ticks - self._drive.measure().position_ticks))

    def _end_ns(self, goal: wire.Goal, travel_ticks: int) -> int:
        """When a travel at the goal's speed that begins now is over."""
        travel_s = travel_ticks * mx28.TICK_RAD / (goal.velocity_units * mx28.VELOCITY_UNIT_RADPS)
        return time.monotonic_ns() + round(travel_s * S_NS) + round(self._settings.goal_slack_ms * MS_NS)

    def _give_up(self, measured: Measured, why: str) -> None:
        """The goal's time is over, or nobody is there: where it has not been reached, the servo stays where it is."""
        assert self._drive is not None
        if self._driving and abs(measured.position_ticks - self._drive.goal_ticks) > ARRIVED_TICKS:
            self._drive.stop()  # tried again in the next cycle where it fails
            self._counts[why] += 1
        self._goal_ends_ns = 0

    def _check(self, now_ns: int) -> None:
        """Whether the servo still is as it was set up."""
        assert self._drive is not None
        condition = self._drive.condition()
        self._error = condition.error
        if condition.torque and not condition.watchdog_tripped:  # with an error that it does not shut down for, too
            if now_ns - self._healthy_ns > STEADY_NS:
                self._pause_ns = self._reboot_pause_ns = PAUSE_NS
            return
        self._counts["torque_losses"] += not condition.torque
        self._counts["watchdog_stops"] += condition.watchdog_tripped
        self._release()
        self._retry_ns = now_ns + (self._reboot_pause_ns if condition.error else 0)

    def _failed(self, error: BusError, now_ns: int) -> None:
        self._faults[error.kind] += 1
        self._failing_ns = self._failing_ns or now_ns
        if isinstance(error, Gone):
            self._close()
            self._release()
            self._later(now_ns)
        elif now_ns - self._failing_ns > LOST_NS and self._driving:
            self._release()
        if not self._ever and now_ns - self._began_ns > 1e9 * self._settings.start_s:
            raise SetupError(self._never_answered(error))

    def _release(self) -> None:
        """Not driving any more: what was wanted before is not wanted after."""
        self._counts["goals_lost"] += self._goal is not None
        self._driving, self._goal, self._goal_ends_ns = False, None, 0

    def _later(self, now_ns: int) -> None:
        self._retry_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)

    def _never_answered(self, error: BusError) -> str:
        s = self._settings
        if isinstance(error, Gone):
            return f"{error}. Is the USB adapter plugged in, `port` right, and this user in the group dialout?"
        return (
            f"{s.port}: the servo with id {s.servo_id} does not answer at {s.baud} baud ({error}). Is it powered "
            "(12 V) and wired, and are `servo_id` and `baud` its own (from the factory 1 and 57600)?"
        )

    def _pass_on(self, measured: Measured) -> None:
        """Tell a reading that may be believed."""
        assert self._drive is not None
        self._counts["reads"] += 1
        doubt = self._filter.reject_reason(measured)
        if doubt is not None:
            self._counts[doubt] += 1
            return
        reading = wire.Reading(
            measured.request_ns,
            measured.reply_ns,
            measured.position_ticks,
            measured.velocity_units,
            self._drive.goal_ticks,
            self._error,
        )
        self._say(reading)

    def _tell(self) -> None:
        """Totals, now and then."""
        now_ns = time.monotonic_ns()
        if now_ns - self._told_ns < HEALTH_NS:
            return
        self._told_ns = now_ns
        if os.getppid() != self._parent:  # somebody else may hold the other end of the socket
            raise ParentGone
        faults, counts = self._faults, self._counts
        health = wire.Health(
            connected=self._driving,
            reads=counts["reads"],
            goals_sent=counts["goals_sent"],
            goals_expired=counts["goals_expired"],
            goals_lost=counts["goals_lost"],
            parent_hangs=counts["parent_hangs"],
            no_reply=faults["no reply"],
            damaged=faults["damaged"],
            wrong=faults["late or foreign"],
            refused=faults["refused by the servo"],
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
        self._say(health)

    def _say(self, packet: wire.Packet) -> None:
        try:
            self._line.send(wire.pack(packet), socket.MSG_DONTWAIT)
        except BlockingIOError:
            self._counts["unsent"] += 1
        except OSError:
            raise ParentGone from None

    def _leave(self) -> None:
        """Stop the servo where it is, as well as that can be done, and let go of the port."""
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
    """`python -m links.dynamixel.worker FD SETTINGS`: FD is this end of the socket, inherited."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent, which ends this
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with socket.socket(fileno=int(sys.argv[1])) as line:
        try:
            Worker(line, DriveSettings.from_text(sys.argv[2])).run()
        except SetupError as error:
            line.send(wire.pack(wire.fatal(str(error))))
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
