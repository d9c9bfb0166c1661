"""Which readings are believed."""

from __future__ import annotations

from links.dynamixel.drive import Measured
from links.dynamixel.reading_filter import ReadingFilter, reachable

MS = 1_000_000


def reading(at_ms, ticks, took_ms=0.3):
    return Measured(round(at_ms * MS), round((at_ms + took_ms) * MS), ticks, 0, False)


def test_the_servo_comes_as_far_as_100_rpm_take_it():
    assert reachable(reading(0, 1000), reading(4, 1000 + 23 + 29))  # 6827 ticks a second in 4.3 ms
    assert not reachable(reading(0, 1000), reading(4, 1000 + 23 + 31))
    assert not reachable(reading(0, 1000), reading(4, 1000 - 23 - 31))


def test_a_jump_is_doubted_once_and_believed_when_it_is_told_again():
    belief = ReadingFilter()
    said = [belief.reject_reason(reading(4 * k, t)) for k, t in enumerate([1000, 3000, 1001, 3000, 3000, 3001, 1000])]
    assert said == [None, "implausible", None, "implausible", None, None, "implausible"]


def test_an_exchange_that_takes_long_is_left_out_until_that_is_usual():
    belief = ReadingFilter()
    assert [belief.reject_reason(reading(4 * k, 1000)) for k in range(40)] == [None] * 40
    assert belief.reject_reason(reading(160, 1000, took_ms=1.0)) is None  # 2 * 0.3 + 0.5 = 1.1 ms
    assert belief.reject_reason(reading(164, 1000, took_ms=1.2)) == "slow"
    later = [belief.reject_reason(reading(168 + 4 * k, 1000, took_ms=3.0)) for k in range(30)]
    assert later[0] == "slow"
    assert later[-1] is None
    assert later.count("slow") * 4 < 100  # the sweep bridges 100 ms


def test_a_slow_reading_says_nothing_of_where_the_servo_is():
    belief = ReadingFilter()
    belief.reject_reason(reading(0, 1000))
    assert belief.reject_reason(reading(4, 1040, took_ms=5)) == "slow"
    assert belief.reject_reason(reading(8, 1000)) is None
