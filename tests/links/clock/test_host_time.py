"""Host time is continuous although the wall clock is set."""

from __future__ import annotations

import pytest

from links.clock.host_time import MAX_AGE_NS, HostTime, from_wall_ns, now_ns

START_NS = 1_750_000_000_000_000_000
MS = 1_000_000


class Clocks:
    """A wall clock that can be set, and the monotonic clock under it."""

    def __init__(self):
        self.monotonic_ns, self.offset_ns = 5_000 * MS, START_NS

    def wall(self):
        return self.monotonic_ns + self.offset_ns

    def monotonic(self):
        return self.monotonic_ns


@pytest.fixture
def clocks():
    return Clocks()


@pytest.fixture
def host(clocks):
    return HostTime(clocks.wall, clocks.monotonic)


def test_host_time_starts_at_the_wall_clock_and_follows_the_monotonic_clock(clocks, host):
    start = host.now_ns()
    assert start == START_NS + 5_000 * MS
    clocks.monotonic_ns += 7 * MS
    assert host.now_ns() == start + 7 * MS


@pytest.mark.parametrize("step_ns", [3_600_000 * MS, -3_600_000 * MS, 300 * MS, -40 * MS])
def test_setting_the_wall_clock_does_not_change_host_time(clocks, host, step_ns):
    before = host.now_ns()
    clocks.offset_ns += step_ns
    assert host.now_ns() == before


def test_a_kernel_stamp_keeps_its_age(clocks, host):
    clocks.monotonic_ns += 50 * MS
    stamp = clocks.wall() - 3 * MS
    assert host.from_wall_ns(stamp) == host.now_ns() - 3 * MS


def test_datagrams_buffered_during_a_standstill_keep_their_age(clocks, host):
    """20 poses/s fill a socket's buffer in 13 s; with the current time as stamp they would be wrong positions."""
    host.from_wall_ns(clocks.wall())
    stamps = []
    for _ in range(256):
        clocks.monotonic_ns += 50 * MS
        stamps.append((clocks.wall(), host.now_ns()))
    assert [host.from_wall_ns(wall_ns) for wall_ns, _ in stamps] == [host_ns for _, host_ns in stamps]


@pytest.mark.parametrize("step_ns", [3_600_000 * MS, -3_600_000 * MS, 300 * MS, -40 * MS, 2 * MS])
def test_a_stamp_from_before_a_step_is_replaced_by_now_and_later_stamps_are_correct(clocks, host, step_ns):
    clocks.monotonic_ns += 20 * MS
    host.from_wall_ns(clocks.wall())
    clocks.monotonic_ns += 20 * MS
    old = [clocks.wall() - 2 * MS, clocks.wall() - MS]  # in the socket's buffer when the clock is set
    clocks.offset_ns += step_ns
    for stamp in old:
        clocks.monotonic_ns += 100_000
        assert host.from_wall_ns(stamp) == host.now_ns()
    assert host.steps == 1
    clocks.monotonic_ns += 10 * MS
    assert host.from_wall_ns(clocks.wall() - MS) == host.now_ns() - MS


def test_a_slewed_wall_clock_is_followed(clocks, host):
    for _ in range(100):
        clocks.monotonic_ns += 1_000 * MS
        clocks.offset_ns += MS // 2  # 500 ppm
        assert host.from_wall_ns(clocks.wall() - 2 * MS) == host.now_ns() - 2 * MS
    assert host.steps == 0


def test_a_slow_reading_of_the_clocks_is_not_a_step(clocks):
    """Another process interrupts every reading, the last one longest."""
    slow_ns = iter([9 * MS, 4 * MS, 3 * MS, 5 * MS, 40 * MS] * 2)

    def wall():
        clocks.monotonic_ns += next(slow_ns, 0)
        return clocks.wall()

    clocks.monotonic_ns += 20 * MS
    host = HostTime(clocks.wall, clocks.monotonic)
    host.from_wall_ns(clocks.wall())
    host._wall_ns = wall
    for _ in range(3):
        clocks.monotonic_ns += 50 * MS
        stamp, stamped_ns = clocks.wall() - 2 * MS, host.now_ns() - 2 * MS
        assert stamped_ns <= host.from_wall_ns(stamp) <= stamped_ns + 3 * MS
    assert host.steps == 0


def test_a_stamp_from_the_future_or_far_past_is_replaced_by_now(clocks, host):
    clocks.monotonic_ns += 10 * MAX_AGE_NS
    assert host.from_wall_ns(clocks.wall() + MS) == host.now_ns()
    assert host.from_wall_ns(clocks.wall() - MAX_AGE_NS - 1) == host.now_ns()


def test_all_functions_share_one_timeline():
    before = now_ns()
    between = from_wall_ns(0)
    assert before <= between <= now_ns()
