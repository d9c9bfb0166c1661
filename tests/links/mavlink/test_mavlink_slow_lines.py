"""A session over lines that are too slow or hang, in simulated time: how old poses are when they are handed on."""

from __future__ import annotations

import pytest
from mavlink_bridges import SlowFlight

from links.mavlink.round_trip import LATE_NS

LATE_S = 1e-9 * LATE_NS


def stale(flight: SlowFlight) -> int:
    return sum(age_s > LATE_S for age_s in flight.ages_s)


@pytest.mark.parametrize("kbit_per_s", [40.0, 57.6, 80.0, 96.0])  # 50 poses a second are 98
def test_a_bridge_too_slow_for_the_poses_hands_few_on_late_and_ever_fewer(
    kbit_per_s: float, monkeypatch: pytest.MonkeyPatch
):
    flight = SlowFlight(kbit_per_s, monkeypatch, bridge=True)
    flight.fly(60)
    assert 1 <= len(flight.late_since_s) <= 5
    assert stale(flight) <= 60 * len(flight.late_since_s)
    before, episodes = stale(flight), len(flight.late_since_s)
    flight.fly(120)
    assert len(flight.late_since_s) - episodes <= 4
    assert stale(flight) - before <= 240


def test_a_bridge_that_carries_the_poses_is_never_late(monkeypatch: pytest.MonkeyPatch):
    flight = SlowFlight(130.0, monkeypatch, bridge=True)
    flight.fly(120)
    assert flight.late_since_s == []
    assert len(flight.ages_s) >= 50 * 120 - 5
    assert stale(flight) == 0


def test_a_bridge_that_hangs_on_the_way_there_is_noticed_before_it_goes_on(monkeypatch: pytest.MonkeyPatch):
    flight = SlowFlight(1000.0, monkeypatch, bridge=True)
    flight.fly(20)
    flight.line.hangs = True
    flight.fly(5)
    sent = flight.session.counters["sent: ODOMETRY"]
    assert sent - len(flight.ages_s) <= 2.2 * 50  # that is what it will hand on late
    assert flight.late_since_s == pytest.approx([22.0], abs=0.2)
    flight.line.hangs = False
    flight.fly(2.9)
    assert flight.session.counters["sent: ODOMETRY"] == sent
    flight.fly(1)
    assert flight.session.counters["sent: ODOMETRY"] > sent


def test_who_answers_no_timesync_any_more_gets_poses_again_and_is_told(monkeypatch: pytest.MonkeyPatch):
    flight = SlowFlight(1000.0, monkeypatch, bridge=True)
    flight.fly(20)
    flight.answers = False
    flight.fly(29.5)
    sent = flight.session.counters["sent: ODOMETRY"]
    assert sent <= 50 * 22.2
    flight.fly(30)
    assert flight.session.counters["sent: ODOMETRY"] >= sent + 50 * 29
    told = [m.text for m in flight.got if m.get_type() == "STATUSTEXT"]
    assert told.count("grd: answers no TIMESYNC: late is not seen") == 1
    assert "whether they come late is not seen" in (flight.session.status or "")


def test_an_autopilot_that_restarts_and_then_answers_no_timesync_gets_poses_as_soon_as_it_is_heard(
    monkeypatch: pytest.MonkeyPatch,
):
    flight = SlowFlight(1000.0, monkeypatch, bridge=True)
    flight.fly(20)
    flight.answers = flight.speaks = False
    flight.fly(10)
    sent = flight.session.counters["sent: ODOMETRY"]
    flight.speaks = True
    flight.fly(60)
    assert flight.session.counters["sent: ODOMETRY"] >= sent + 50 * 59.5
    assert (flight.late_since_s, flight.session.status) == ([], None)


@pytest.mark.parametrize("kbit_per_s", [10.0, 14.0, 16.0, 18.0, 20.0, 24.0, 40.0])
def test_on_a_slow_tcp_or_serial_line_heartbeats_and_timesync_go_out_and_late_poses_do_not(
    kbit_per_s: float, monkeypatch: pytest.MonkeyPatch
):
    flight = SlowFlight(kbit_per_s, monkeypatch, bridge=False)
    flight.fly(60)
    assert flight.count("HEARTBEAT") >= 50
    assert sum(m.tc1 == 0 for m in flight.got if m.get_type() == "TIMESYNC") >= 180
    assert stale(flight) <= 20  # five trials, some four each; of 400 to 600
    if kbit_per_s >= 24:
        assert flight.late_since_s == []
        assert len(flight.ages_s) >= 0.9 * 60 * (125 * kbit_per_s - 4 * 28 - 21) / 244


@pytest.mark.parametrize("kbit_per_s", [14.0, 16.0, 20.0])
def test_with_fewer_poses_a_second_a_slow_line_carries_all_of_them_in_time(
    kbit_per_s: float, monkeypatch: pytest.MonkeyPatch
):
    flight = SlowFlight(kbit_per_s, monkeypatch, bridge=False)
    flight.pose_each = 40  # 5 a second
    flight.fly(60)
    assert flight.late_since_s == []
    assert len(flight.ages_s) >= 5 * 60 - 2
    assert max(flight.ages_s) <= 0.2
