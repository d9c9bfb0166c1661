"""Retry pauses of the servo process, with a simulated clock and failing buses."""

from __future__ import annotations

import socket
from types import SimpleNamespace

import numpy as np
import pytest

from links.dynamixel import Servo, worker
from links.dynamixel.bus import Gone, NoReply
from links.dynamixel.drive import Condition, Measurement, Shutdown

MS, S = 1_000_000, 1_000_000_000


class SimulatedWorker:
    """A worker at 250 Hz for `seconds`; records its attempts. Subclasses override the methods that fail."""

    def __init__(self, monkeypatch, seconds):
        self.now_ns, self.attempts_ns, self.reboots, self.goal_ticks = S, [], 0, 1000
        own, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic_ns=lambda: self.now_ns))
        monkeypatch.setattr(worker.Bus, "open", lambda *_: self.opened())
        monkeypatch.setattr(worker, "Drive", lambda *_: self)
        with own, peer:
            process = worker.ServoWorker(peer, Servo(start_timeout_s=60)._drive_settings())
            end_ns = self.now_ns + seconds * S

            def wait():
                self.now_ns += 4 * MS
                if self.now_ns > end_ns:
                    raise worker.ParentGone

            monkeypatch.setattr(process, "_wait", wait)
            process.run()
        self.counts, self.faults = process._counts, process._faults

    def opened(self):
        return SimpleNamespace(close=lambda: None, reboot=self.reboot, low_latency=True)

    def set_up(self):
        self.attempts_ns.append(self.now_ns)
        return 0

    def measure(self):
        return Measurement(self.now_ns, self.now_ns + MS // 2, 1000, 0, False)

    def condition(self):
        return Condition(torque=True, error=0, watchdog_tripped=False)

    def supply(self):
        return 12_000, 40

    def stop(self):
        pass

    def reboot(self):
        self.reboots += 1

    @property
    def pauses_s(self):
        return np.diff(self.attempts_ns) / S


class Unplugged(SimulatedWorker):
    def opened(self):
        self.attempts_ns.append(self.now_ns)
        raise Gone("there is no /dev/ttyUSB0")


class Silent(SimulatedWorker):
    def set_up(self):
        super().set_up()
        raise NoReply("no reply")

    def measure(self):
        raise NoReply("no reply")


class Overloaded(SimulatedWorker):
    def set_up(self):
        super().set_up()
        raise Shutdown(0x20)


@pytest.mark.parametrize("kind", [Unplugged, Silent])
def test_a_missing_servo_is_tried_once_per_second(monkeypatch, kind):
    """A replugged servo is used within a second plus the setup time; more attempts would flood the bus."""
    simulated = kind(monkeypatch, seconds=59)
    assert simulated.pauses_s[:4].round(2).tolist() == [0.1, 0.2, 0.4, 0.8]
    assert simulated.pauses_s[4:].round(2).tolist() == [1.0] * len(simulated.pauses_s[4:])
    assert len(simulated.pauses_s) > 50


def test_a_servo_that_shuts_down_is_rebooted_with_pauses_that_increase_to_ten_seconds(monkeypatch):
    simulated = Overloaded(monkeypatch, seconds=60)
    assert simulated.pauses_s.round(1).tolist() == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0, 10.0, 10.0]
    assert simulated.reboots == simulated.counts["reboots"] == 12


def test_a_long_unplugged_time_does_not_increase_the_reboot_pauses_after_it(monkeypatch):
    class PulledThenOverloaded(Overloaded):
        def opened(self):
            if self.now_ns < 31 * S:
                raise Gone("there is no /dev/ttyUSB0")
            return super().opened()

    simulated = PulledThenOverloaded(monkeypatch, seconds=33)
    assert simulated.faults["unplugged"] > 25
    assert simulated.attempts_ns[0] < 32.1 * S
    assert simulated.pauses_s[:2].round(1).tolist() == [0.1, 0.2]
