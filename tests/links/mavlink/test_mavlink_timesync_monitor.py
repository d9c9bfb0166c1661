"""TIMESYNC replies: which are ours, when they are late, and for how long no poses are sent then."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import pytest

from links.mavlink.timesync_monitor import (
    FIRST_WAIT_NS,
    GIVEN_UP,
    LATE_FRAMES_WITHIN_NS,
    MAX_LATENCY_NS,
    MAX_PENDING,
    MAX_WAIT_NS,
    PROVEN,
    REQUEST_PERIOD_NS,
    UNANSWERED,
    TimesyncMonitor,
)

MS = 1_000_000
LATE_MS = MAX_LATENCY_NS // MS + 1
WAIT = FIRST_WAIT_NS // REQUEST_PERIOD_NS  # requests


class Requests:
    """Requests in order, with a frame of the autopilot in between by default."""

    def __init__(self) -> None:
        self.monitor = TimesyncMonitor()
        self.now_ns = 10**12

    def late_after(self, took_ms: Iterable[int | None], active: bool = True, sending: bool = True) -> list[bool]:
        """Whether the link is late after each request with these round monitor; None: the reply is lost."""
        states: list[bool] = []
        for took in took_ms:
            self.now_ns += REQUEST_PERIOD_NS
            self.monitor.on_request(self.now_ns)
            if active:
                self.monitor.on_frame()
            if took is not None:
                assert self.monitor.on_reply(self.now_ns, self.now_ns + took * MS, sending)
            states.append(self.monitor.late)
        return states

    def prompt_until_good(self) -> int:
        """Number of prompt replies until the link is not late."""
        for count in itertools.count():
            if not self.monitor.late:
                return count
            self.late_after([20])
        raise AssertionError


def test_an_autopilot_that_never_replies_is_never_late():
    requests = Requests()
    assert not any(requests.late_after([None] * 1000))
    assert (requests.monitor.newest_ns, requests.monitor.status) == (None, None)


def test_two_of_three_late_replies_are_late_and_one_or_a_lost_one_is_not():
    assert not any(Requests().late_after([20, LATE_MS, 20, None, None, None, 20, LATE_MS, 300, 299]))
    assert Requests().late_after([20, LATE_MS, 20, LATE_MS]) == [False, False, False, True]
    assert Requests().late_after([1000, None, None, 1000]) == [False, False, False, True]


def test_the_link_stays_late_until_it_was_prompt_for_three_seconds():
    requests = Requests()
    assert requests.late_after([1000, 1000])[-1]
    assert "no poses are sent" in (requests.monitor.status or "")
    assert all(requests.late_after([None] * 5 + [20] * 10 + [1000, 1000]))
    assert WAIT <= requests.prompt_until_good() <= WAIT + 6  # a late reply arrives up to 1 s after its request
    assert requests.monitor.status is None


def test_repeated_lateness_doubles_the_wait_up_to_a_minute():
    requests, waits = Requests(), list[int]()
    for _ in range(7):
        requests.late_after([LATE_MS, LATE_MS])
        waits.append(requests.prompt_until_good())
        requests.late_after([20] * (PROVEN - 2))
    assert waits == pytest.approx([k * WAIT for k in (1, 2, 4, 8, 16, 20, 20)], abs=3)
    assert MAX_WAIT_NS == 20 * FIRST_WAIT_NS


def test_the_wait_is_short_again_after_a_minute_of_prompt_replies_while_poses_were_sent():
    requests, waits = Requests(), list[int]()
    for sending in (True, False, True):
        requests.late_after([LATE_MS, LATE_MS])
        waits.append(requests.prompt_until_good())
        requests.late_after([20] * (PROVEN + 1), sending=sending)
    assert waits == pytest.approx([WAIT, WAIT, 2 * WAIT], abs=3)


def test_eight_consecutive_missing_replies_of_an_active_autopilot_are_late():
    requests = Requests()
    states = requests.late_after([20] + [None] * (UNANSWERED + 1))
    assert states == [False] * (UNANSWERED + 1) + [True]  # the eighth has had a quarter of a second
    assert not any(Requests().late_after(([20] + [None] * (UNANSWERED - 1)) * 10))  # a radio may lose seven in a row


def test_a_silent_autopilot_is_not_a_blocked_bridge():
    requests = Requests()
    requests.late_after([20])
    assert not any(requests.late_after([None] * 100, active=False))


def test_an_active_autopilot_without_replies_gets_poses_again_after_half_a_minute_reported_once():
    requests = Requests()
    requests.late_after([20])
    start_ns, reports = requests.now_ns, 0
    while requests.now_ns - start_ns < 60_000 * MS:
        requests.now_ns += REQUEST_PERIOD_NS
        reports += requests.monitor.on_request(requests.now_ns)
        requests.monitor.on_frame()
        elapsed_ns = requests.now_ns - start_ns
        assert requests.monitor.late == (
            (UNANSWERED + 1) * REQUEST_PERIOD_NS <= elapsed_ns < GIVEN_UP * REQUEST_PERIOD_NS + FIRST_WAIT_NS
        )
    assert reports == 1
    assert "their latency is unknown" in (requests.monitor.status or "")
    requests.late_after([20])
    assert requests.monitor.status is None
    assert requests.late_after([None] * (UNANSWERED + 1))[-1]  # it has replied again


def test_after_a_silence_replies_are_optional_and_a_wait_continues_to_its_end():
    requests = Requests()
    assert requests.late_after([1000, 1000])[-1]
    requests.monitor.reset()
    states = requests.late_after([None] * (WAIT + 4))
    assert states[: WAIT - 1] == [True] * (WAIT - 1)
    assert not states[-1]
    assert not any(requests.late_after([None] * 1000))


def test_two_late_frames_within_a_second_are_late_even_without_replies():
    monitor = TimesyncMonitor()
    monitor.on_late_frame(0)
    monitor.on_late_frame(LATE_FRAMES_WITHIN_NS + 1)
    assert not monitor.late
    monitor.on_late_frame(2 * LATE_FRAMES_WITHIN_NS)
    assert monitor.late
    for request_ns in range(2 * LATE_FRAMES_WITHIN_NS, 2 * LATE_FRAMES_WITHIN_NS + FIRST_WAIT_NS, REQUEST_PERIOD_NS):
        monitor.on_request(request_ns)
        assert monitor.late
    monitor.on_request(2 * LATE_FRAMES_WITHIN_NS + FIRST_WAIT_NS)
    assert not monitor.late


def test_only_the_first_reply_to_our_request_counts():
    monitor = TimesyncMonitor()
    monitor.on_request(5)
    assert not monitor.on_reply(4, 10, sending=True)
    assert monitor.on_reply(5, 10, sending=True)
    assert not monitor.on_reply(5, 11, sending=True)
    for number in range(MAX_PENDING + 1):
        monitor.on_request(100 + number)
    assert not monitor.on_reply(100, 1000, sending=True)  # too old
    assert monitor.newest_ns == 5
