"""Answers to our TIMESYNC: whose they are, and when they are late."""

from __future__ import annotations

from collections.abc import Iterable

from links.mavlink.round_trip import ASK_NS, LATE_NS, PROMPT_AGAIN, WAITING, RoundTrips

MS = 1_000_000
LATE_MS = LATE_NS // MS + 1


def late_after(trips: RoundTrips, took_ms: Iterable[int | None], begin_ns: int = 0) -> list[bool]:
    """Whether it is late after each request, whose answer takes so long; None: it is lost."""
    told: list[bool] = []
    for number, took in enumerate(took_ms):
        asked_ns = begin_ns + number * ASK_NS
        trips.asked(asked_ns)
        if took is not None:
            assert trips.answered(asked_ns, asked_ns + took * MS)
        told.append(trips.late)
    return told


def test_who_never_answers_is_never_late():
    trips = RoundTrips()
    assert not any(late_after(trips, [None] * 1000))
    assert (trips.newest_ns, trips.trouble) == (None, None)


def test_two_of_three_late_answers_are_late_and_one_or_a_lost_one_is_not():
    assert not any(late_after(RoundTrips(), [20, LATE_MS, 20, None, None, None, 20, LATE_MS, 300, 299]))
    assert late_after(RoundTrips(), [20, LATE_MS, 20, LATE_MS]) == [False, False, False, True]
    assert late_after(RoundTrips(), [1000, None, None, 1000]) == [False, False, False, True]


def test_it_stays_late_until_all_answers_were_prompt_for_three_seconds():
    trips = RoundTrips()
    assert late_after(trips, [1000, 1000])[-1]
    assert "no poses are sent" in (trips.trouble or "")
    assert all(late_after(trips, [None] * 100 + [20] * (PROMPT_AGAIN - 1) + [LATE_MS], 10**10))
    assert late_after(trips, [20] * PROMPT_AGAIN, 10**12) == [True] * (PROMPT_AGAIN - 1) + [False]
    assert trips.trouble is None


def test_only_the_first_answer_to_a_request_of_ours_counts():
    trips = RoundTrips()
    trips.asked(5)
    assert not trips.answered(4, 10)
    assert trips.answered(5, 10)
    assert not trips.answered(5, 11)
    for number in range(WAITING + 1):
        trips.asked(100 + number)
    assert not trips.answered(100, 1000)  # long ago
    assert trips.newest_ns == 5
