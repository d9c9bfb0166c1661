"""How often the servo's process tries to bring back one that is gone: by a clock of its own, with buses that fail."""

from __future__ import annotations

import socket
from types import SimpleNamespace

import numpy as np
import pytest

from links.dynamixel import Servo, worker
from links.dynamixel.bus import Gone, NoReply
from links.dynamixel.drive import Condition, Measured, Shutdown

MS, S = 1_000_000, 1_000_000_000


class Line:
    """A servo's process at 250 Hz for `seconds`, whose tries are kept; what it meets is told by the two methods."""

    def __init__(self, monkeypatch, seconds):
        self.now_ns, self.tries_ns, self.reboots, self.goal_ticks = S, [], 0, 1000
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic_ns=lambda: self.now_ns))
        monkeypatch.setattr(worker.Bus, "open", lambda *_: self.opened())
        monkeypatch.setattr(worker, "Drive", lambda *_: self)
        with ours, theirs:
            process = worker.Worker(theirs, Servo(start_timeout_s=60)._drive_settings())
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
        self.tries_ns.append(self.now_ns)
        return 0

    def measure(self):
        return Measured(self.now_ns, self.now_ns + MS // 2, 1000, 0, False)

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
        return np.diff(self.tries_ns) / S


class Unplugged(Line):
    def opened(self):
        self.tries_ns.append(self.now_ns)
        raise Gone("there is no /dev/ttyUSB0")


class Dumb(Line):
    def set_up(self):
        super().set_up()
        raise NoReply("no reply")

    def measure(self):
        raise NoReply("no reply")


class Overloaded(Line):
    def set_up(self):
        super().set_up()
        raise Shutdown(0x20)


@pytest.mark.parametrize("kind", [Unplugged, Dumb])
def test_one_that_is_gone_for_long_is_tried_each_second(monkeypatch, kind):
    """So a plug put back is served within a second and what setting up takes; more often would flood the bus."""
    line = kind(monkeypatch, seconds=59)
    assert line.pauses_s[:4].round(2).tolist() == [0.1, 0.2, 0.4, 0.8]
    assert line.pauses_s[4:].round(2).tolist() == [1.0] * len(line.pauses_s[4:])
    assert len(line.pauses_s) > 50


def test_one_that_has_shut_down_is_rebooted_with_pauses_that_grow_to_ten_seconds(monkeypatch):
    line = Overloaded(monkeypatch, seconds=60)
    assert line.pauses_s.round(1).tolist() == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0, 10.0, 10.0]
    assert line.reboots == line.counts["reboots"] == 12


def test_a_plug_pulled_for_long_leaves_no_long_pause_for_a_shutdown_after_it(monkeypatch):
    class PulledThenOverloaded(Overloaded):
        def opened(self):
            if self.now_ns < 31 * S:
                raise Gone("there is no /dev/ttyUSB0")
            return super().opened()

    line = PulledThenOverloaded(monkeypatch, seconds=33)
    assert line.faults["unplugged"] > 25
    assert line.tries_ns[0] < 32.1 * S
    assert line.pauses_s[:2].round(1).tolist() == [0.1, 0.2]
