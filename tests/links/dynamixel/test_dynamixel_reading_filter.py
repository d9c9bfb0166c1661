"""Which readings the filter accepts."""

from __future__ import annotations

from links.dynamixel.drive import Measurement
from links.dynamixel.reading_filter import ReadingFilter, reachable

MS = 1_000_000


def reading(at_ms, ticks, took_ms=0.3):
    return Measurement(round(at_ms * MS), round((at_ms + took_ms) * MS), ticks, 0, False)


def test_the_servo_can_move_at_up_to_100_rpm():
    assert reachable(reading(0, 1000), reading(4, 1000 + 23 + 29))  # 6827 ticks a second in 4.3 ms
    assert not reachable(reading(0, 1000), reading(4, 1000 + 23 + 31))
    assert not reachable(reading(0, 1000), reading(4, 1000 - 23 - 31))


def test_a_jump_is_rejected_once_and_accepted_when_the_next_reading_confirms_it():
    reading_filter = ReadingFilter()
    reasons = [
        reading_filter.reject_reason(reading(4 * k, t))
        for k, t in enumerate([1000, 3000, 1001, 3000, 3000, 3001, 1000])
    ]
    assert reasons == [None, "implausible", None, "implausible", None, None, "implausible"]


def test_a_slow_exchange_is_rejected_until_the_median_follows():
    reading_filter = ReadingFilter()
    assert [reading_filter.reject_reason(reading(4 * k, 1000)) for k in range(40)] == [None] * 40
    assert reading_filter.reject_reason(reading(160, 1000, took_ms=1.0)) is None  # 2 * 0.3 + 0.5 = 1.1 ms
    assert reading_filter.reject_reason(reading(164, 1000, took_ms=1.2)) == "slow"
    later = [reading_filter.reject_reason(reading(168 + 4 * k, 1000, took_ms=3.0)) for k in range(30)]
    assert later[0] == "slow"
    assert later[-1] is None
    assert later.count("slow") * 4 < 100  # the sweep bridges 100 ms


def test_a_slow_reading_does_not_change_the_accepted_position():
    reading_filter = ReadingFilter()
    reading_filter.reject_reason(reading(0, 1000))
    assert reading_filter.reject_reason(reading(4, 1040, took_ms=5)) == "slow"
    assert reading_filter.reject_reason(reading(8, 1000)) is None
