"""Answers to our TIMESYNC: whose they are, when they are late, and for how long nothing goes out then."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import pytest

from links.mavlink.round_trip import (
    ASK_NS,
    FIRST_WAIT_NS,
    GIVEN_UP,
    LATE_NS,
    LEFT_LATE_NS,
    LONGEST_WAIT_NS,
    PROVEN,
    UNANSWERED,
    WAITING,
    RoundTrips,
)

MS = 1_000_000
LATE_MS = LATE_NS // MS + 1
WAIT = FIRST_WAIT_NS // ASK_NS  # requests


class Asking:
    """Requests in turn; the autopilot is heard in between unless it is said otherwise."""

    def __init__(self) -> None:
        self.trips = RoundTrips()
        self.now_ns = 10**12

    def late_after(self, took_ms: Iterable[int | None], heard: bool = True, sending: bool = True) -> list[bool]:
        """Whether it is late after each request, whose answer takes so long; None: it is lost."""
        told: list[bool] = []
        for took in took_ms:
            self.now_ns += ASK_NS
            self.trips.asked(self.now_ns)
            if heard:
                self.trips.heard()
            if took is not None:
                assert self.trips.answered(self.now_ns, self.now_ns + took * MS, sending)
            told.append(self.trips.late)
        return told

    def prompt_until_good(self) -> int:
        """Prompt answers until it is late no more."""
        for count in itertools.count():
            if not self.trips.late:
                return count
            self.late_after([20])
        raise AssertionError


def test_who_never_answers_is_never_late():
    asking = Asking()
    assert not any(asking.late_after([None] * 1000))
    assert (asking.trips.newest_ns, asking.trips.status) == (None, None)


def test_two_of_three_late_answers_are_late_and_one_or_a_lost_one_is_not():
    assert not any(Asking().late_after([20, LATE_MS, 20, None, None, None, 20, LATE_MS, 300, 299]))
    assert Asking().late_after([20, LATE_MS, 20, LATE_MS]) == [False, False, False, True]
    assert Asking().late_after([1000, None, None, 1000]) == [False, False, False, True]


def test_it_stays_late_until_it_was_prompt_for_three_seconds():
    asking = Asking()
    assert asking.late_after([1000, 1000])[-1]
    assert "no poses are sent" in (asking.trips.status or "")
    assert all(asking.late_after([None] * 5 + [20] * 10 + [1000, 1000]))
    assert WAIT <= asking.prompt_until_good() <= WAIT + 6  # what came late lies up to 1 s after its request
    assert asking.trips.status is None


def test_lateness_that_comes_back_doubles_the_wait_up_to_a_minute():
    asking, waits = Asking(), list[int]()
    for _ in range(7):
        asking.late_after([LATE_MS, LATE_MS])
        waits.append(asking.prompt_until_good())
        asking.late_after([20] * (PROVEN - 2))
    assert waits == pytest.approx([k * WAIT for k in (1, 2, 4, 8, 16, 20, 20)], abs=3)
    assert LONGEST_WAIT_NS == 20 * FIRST_WAIT_NS


def test_the_wait_is_short_again_after_a_minute_of_prompt_answers_while_poses_went_out_and_not_without():
    asking, waits = Asking(), list[int]()
    for sending in (True, False, True):
        asking.late_after([LATE_MS, LATE_MS])
        waits.append(asking.prompt_until_good())
        asking.late_after([20] * (PROVEN + 1), sending=sending)
    assert waits == pytest.approx([WAIT, WAIT, 2 * WAIT], abs=3)


def test_who_has_answered_and_is_heard_and_answers_eight_in_a_row_no_more_is_late_from_then_on():
    asking = Asking()
    told = asking.late_after([20] + [None] * (UNANSWERED + 1))
    assert told == [False] * (UNANSWERED + 1) + [True]  # the eighth has had its quarter of a second
    assert not any(Asking().late_after(([20] + [None] * (UNANSWERED - 1)) * 10))  # a radio loses seven in a row


def test_what_is_not_heard_at_all_is_no_bridge_that_hangs():
    asking = Asking()
    asking.late_after([20])
    assert not any(asking.late_after([None] * 100, heard=False))


def test_who_is_heard_and_answers_no_more_gets_poses_again_after_half_a_minute_and_that_is_told_once():
    asking = Asking()
    asking.late_after([20])
    begun_ns, told = asking.now_ns, 0
    while asking.now_ns - begun_ns < 60_000 * MS:
        asking.now_ns += ASK_NS
        told += asking.trips.asked(asking.now_ns)
        asking.trips.heard()
        waited_ns = asking.now_ns - begun_ns
        assert asking.trips.late == ((UNANSWERED + 1) * ASK_NS <= waited_ns < GIVEN_UP * ASK_NS + FIRST_WAIT_NS)
    assert told == 1
    assert "whether they come late is not seen" in (asking.trips.status or "")
    asking.late_after([20])
    assert asking.trips.status is None
    assert asking.late_after([None] * (UNANSWERED + 1))[-1]  # it has answered again


def test_after_a_silence_it_need_not_answer_and_a_wait_goes_on_to_its_end():
    asking = Asking()
    assert asking.late_after([1000, 1000])[-1]
    asking.trips.begin_anew()
    told = asking.late_after([None] * (WAIT + 4))
    assert told[: WAIT - 1] == [True] * (WAIT - 1)
    assert not told[-1]
    assert not any(asking.late_after([None] * 1000))


def test_two_frames_within_a_second_that_left_late_are_late_though_nobody_answers():
    trips = RoundTrips()
    trips.left_late(0)
    trips.left_late(LEFT_LATE_NS + 1)
    assert not trips.late
    trips.left_late(2 * LEFT_LATE_NS)
    assert trips.late
    for asked_ns in range(2 * LEFT_LATE_NS, 2 * LEFT_LATE_NS + FIRST_WAIT_NS, ASK_NS):
        trips.asked(asked_ns)
        assert trips.late
    trips.asked(2 * LEFT_LATE_NS + FIRST_WAIT_NS)
    assert not trips.late


def test_only_the_first_answer_to_a_request_of_ours_counts():
    trips = RoundTrips()
    trips.asked(5)
    assert not trips.answered(4, 10, sending=True)
    assert trips.answered(5, 10, sending=True)
    assert not trips.answered(5, 11, sending=True)
    for number in range(WAITING + 1):
        trips.asked(100 + number)
    assert not trips.answered(100, 1000, sending=True)  # long ago
    assert trips.newest_ns == 5
