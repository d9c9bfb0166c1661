"""Clock of another device: bounds, drift, replies, reboots."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from links.clock.device_clock import BACKLOG_NS, DISAGREEMENTS, DeviceClock

MS, S = 1_000_000, 1_000_000_000
HOST0 = 1_748_773_230 * S
BOOT = 300 * S


def _device(host_ns: int, ppm: float = 0.0) -> int:
    since = host_ns - HOST0
    return BOOT + since + round(since * ppm * 1e-6)


def test_the_fastest_message_gives_the_offset_and_no_stamp_is_after_arrival():
    clock = DeviceClock(drift_limit_ppm=0.0)
    stamps = [clock.read(_device(HOST0 + i * S), HOST0 + i * S + late * MS) for i, late in enumerate([30, 10, 20, 50])]
    assert [s - HOST0 - i * S for i, s in enumerate(stamps) if s is not None] == [30 * MS, 10 * MS, 10 * MS, 10 * MS]
    assert clock.uncertainty_ns is None  # one-way messages do not bound the smallest delay
    assert clock.offset_ns == HOST0 - BOOT + 10 * MS


def test_an_old_bound_loosens_with_the_drift_limit():
    clock = DeviceClock(drift_limit_ppm=100.0)
    clock.read(_device(HOST0), HOST0 + 5 * MS)
    stamp = clock.read(_device(HOST0 + 20 * S), HOST0 + 20 * S + 50 * MS)
    assert stamp is not None
    assert stamp - HOST0 - 20 * S == pytest.approx(5 * MS + 2 * MS, abs=10_000)  # 20 s at 100 ppm


@pytest.mark.parametrize("ppm", [-80.0, 0.0, 80.0])
@pytest.mark.parametrize("timesync", [False, True])
def test_the_offset_is_known_within_the_latency_while_the_clocks_drift(ppm: float, timesync: bool):
    rng = np.random.default_rng(3)
    clock, errors, uncertain, last = DeviceClock(100.0), [], [], HOST0
    for i in range(6000):
        host = HOST0 + i * 20 * MS
        last = max(last, host + 6 * MS + round(rng.exponential(4 * MS)))
        stamp = clock.read(_device(host, ppm), last)
        if timesync and i % 50 == 0:
            requested, replied = last, last + 6 * MS + round(rng.exponential(4 * MS))
            last = replied + 6 * MS + round(rng.exponential(4 * MS))
            assert clock.round_trip(requested, _device(replied, ppm), last)
        if i > 500 and stamp is not None:
            errors.append(stamp - host)
            uncertain.append(clock.uncertainty_ns)
    if timesync:
        assert np.abs(errors).max() < 2.5 * MS
        assert (np.abs(errors) <= uncertain).all()
    else:
        assert min(errors) >= 6 * MS - 1  # never earlier than the smallest latency allows
        assert max(errors) < 8.5 * MS


def test_replies_reveal_a_delay_that_one_way_messages_cannot():
    one_way, both = DeviceClock(), DeviceClock()
    for i in range(20):
        host = HOST0 + i * S
        for clock in (one_way, both):
            clock.read(_device(host), host + 200 * MS)
        both.round_trip(host, _device(host + 200 * MS), host + 400 * MS)
    assert one_way.offset_ns == HOST0 - BOOT + 200 * MS
    assert both.offset_ns == HOST0 - BOOT
    assert both.uncertainty_ns == 200 * MS


def test_foreign_and_late_replies_are_rejected():
    clock = DeviceClock()
    assert not clock.round_trip(HOST0, _device(HOST0), HOST0 + MS)  # before any message
    clock.read(_device(HOST0), HOST0 + 5 * MS)
    assert not clock.round_trip(HOST0 + 9 * MS, _device(HOST0), HOST0 + 8 * MS)  # request after the reply
    assert not clock.round_trip(HOST0 - 3 * S, _device(HOST0), HOST0 + 8 * MS)  # too slow
    assert not clock.round_trip(12345, _device(HOST0), HOST0 + 8 * MS)  # the clock of another device
    assert clock.round_trips == 0


def test_one_outlier_is_rejected_and_a_reboot_resets_the_estimate():
    clock = DeviceClock()
    clock.read(_device(HOST0), HOST0 + 5 * MS)
    assert clock.read(2**63, HOST0 + S) is None
    assert clock.read(_device(HOST0 + S), HOST0 + S + 5 * MS) is not None
    stamps = [clock.read(i * 100 * MS, HOST0 + 2 * S + i * 100 * MS + 5 * MS) for i in range(8)]
    assert [s is None for s in stamps] == [True] * (DISAGREEMENTS - 1) + [False] * (8 - DISAGREEMENTS + 1)
    assert stamps[-1] == HOST0 + 2 * S + 705 * MS
    assert clock.restarts == 1


def test_a_message_buffered_for_longer_than_the_jump_limit_is_never_stamped_as_new():
    clock = DeviceClock()
    for i in range(10):
        clock.read(_device(HOST0 + i * 100 * MS), HOST0 + i * 100 * MS + 5 * MS)
    end = HOST0 + 9 * S  # the link was blocked for 8 s; the buffered messages arrive at once
    for i in range(80):
        sent = HOST0 + S + i * 100 * MS
        stamp = clock.read(_device(sent), end + i * MS)
        assert stamp is None or abs(stamp - sent) < 10 * MS
    assert clock.read(_device(end + S), end + S + 5 * MS) == pytest.approx(end + S + 5 * MS, abs=2 * MS)
    assert clock.restarts == 0


def test_a_device_that_was_off_for_longer_than_on_is_reset_after_the_backlog_time():
    clock = DeviceClock()
    clock.read(3 * S, HOST0)
    stamps = [clock.read(4 * S + i * 100 * MS, HOST0 + 60 * S + i * 100 * MS) for i in range(150)]
    waited = BACKLOG_NS // (100 * MS)
    assert [s is None for s in stamps] == [True] * waited + [False] * (150 - waited)
    assert stamps[-1] == HOST0 + 60 * S + 149 * 100 * MS
    assert clock.restarts == 1


@given(st.lists(st.tuples(st.integers(0, 2**64), st.integers(0, 2**62), st.integers(-(2**63), 2**63)), max_size=30))
def test_no_input_raises(times: list[tuple[int, int, int]]):
    clock = DeviceClock()
    for device, arrival, ts1 in times:
        stamp = clock.read(device, arrival)
        assert stamp is None or stamp <= arrival
        clock.round_trip(ts1, device, arrival)
        assert clock.uncertainty_ns is None or clock.uncertainty_ns >= 0


@pytest.mark.parametrize(("device_s", "reboots"), [(2, 1), (2000, 0)])
def test_only_a_clock_that_runs_backwards_has_booted(device_s: int, reboots: int):
    clock = DeviceClock()
    clock.read(BOOT, HOST0)
    for i in range(DISAGREEMENTS + 1):
        clock.read(device_s * S + i * MS, HOST0 + S + i * MS)
    assert (clock.restarts, clock.reboots) == (1, reboots)
