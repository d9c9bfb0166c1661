"""A session over slow or blocked lines, in simulated time: the age of poses when they are forwarded."""

from __future__ import annotations

import pytest

from links.mavlink.timesync_monitor import MAX_LATENCY_NS
from tests.links.mavlink.transport.mavlink_bridges import SlowFlight

LATE_S = 1e-9 * MAX_LATENCY_NS


def stale(flight: SlowFlight) -> int:
    return sum(age_s > LATE_S for age_s in flight.ages_s)


@pytest.mark.parametrize(
    "kbit_per_s", [40.0, *(pytest.param(rate, marks=pytest.mark.slow) for rate in (57.6, 80.0)), 96.0]
)  # 50 poses/s need 98
def test_a_bridge_too_slow_for_the_poses_forwards_few_late_ones_and_ever_fewer(
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


def test_a_fast_enough_bridge_is_never_late(monkeypatch: pytest.MonkeyPatch):
    flight = SlowFlight(130.0, monkeypatch, bridge=True)
    flight.fly(120)
    assert flight.late_since_s == []
    assert len(flight.ages_s) >= 50 * 120 - 5
    assert stale(flight) == 0


def test_a_bridge_blocked_in_forward_direction_is_noticed_before_it_resumes(monkeypatch: pytest.MonkeyPatch):
    flight = SlowFlight(1000.0, monkeypatch, bridge=True)
    flight.fly(20)
    flight.line.blocked = True
    flight.fly(5)
    sent = flight.session.counters["sent: ODOMETRY"]
    assert sent - len(flight.ages_s) <= 2.2 * 50  # these will be forwarded late
    assert flight.late_since_s == pytest.approx([22.0], abs=0.2)
    flight.line.blocked = False
    flight.fly(2.9)
    assert flight.session.counters["sent: ODOMETRY"] == sent
    flight.fly(1)
    assert flight.session.counters["sent: ODOMETRY"] > sent


def test_an_autopilot_that_stops_replying_to_timesync_gets_poses_again_with_a_warning(monkeypatch: pytest.MonkeyPatch):
    flight = SlowFlight(1000.0, monkeypatch, bridge=True)
    flight.fly(20)
    flight.replies = False
    flight.fly(29.5)
    sent = flight.session.counters["sent: ODOMETRY"]
    assert sent <= 50 * 22.2
    flight.fly(30)
    assert flight.session.counters["sent: ODOMETRY"] >= sent + 50 * 29
    texts = [m.text for m in flight.received if m.get_type() == "STATUSTEXT"]
    assert texts.count("grd: no TIMESYNC replies: latency unknown") == 1
    assert "their latency is unknown" in (flight.session.status or "")


def test_a_restarted_autopilot_without_timesync_replies_gets_poses_with_its_first_frame(
    monkeypatch: pytest.MonkeyPatch,
):
    flight = SlowFlight(1000.0, monkeypatch, bridge=True)
    flight.fly(20)
    flight.replies = flight.active = False
    flight.fly(10)
    sent = flight.session.counters["sent: ODOMETRY"]
    flight.active = True
    flight.fly(60)
    assert flight.session.counters["sent: ODOMETRY"] >= sent + 50 * 59.5
    assert (flight.late_since_s, flight.session.status) == ([], None)


@pytest.mark.parametrize(
    "kbit_per_s", [10.0, 16.0, *(pytest.param(rate, marks=pytest.mark.slow) for rate in (14.0, 18.0, 24.0)), 20.0, 40.0]
)
def test_on_a_slow_tcp_or_serial_line_heartbeats_and_timesync_are_sent_and_late_poses_are_not(
    kbit_per_s: float, monkeypatch: pytest.MonkeyPatch
):
    flight = SlowFlight(kbit_per_s, monkeypatch, bridge=False)
    flight.fly(60)
    assert flight.count("HEARTBEAT") >= 50
    assert sum(m.tc1 == 0 for m in flight.received if m.get_type() == "TIMESYNC") >= 180
    assert stale(flight) <= 20  # five trials of about four each, of 400 to 600
    if kbit_per_s >= 24:
        assert flight.late_since_s == []
        assert len(flight.ages_s) >= 0.9 * 60 * (125 * kbit_per_s - 4 * 28 - 21) / 244


@pytest.mark.parametrize("kbit_per_s", [14.0, 16.0, 20.0])
def test_with_a_lower_pose_rate_a_slow_line_transmits_all_of_them_in_time(
    kbit_per_s: float, monkeypatch: pytest.MonkeyPatch
):
    flight = SlowFlight(kbit_per_s, monkeypatch, bridge=False)
    flight.pose_steps = 40  # 5 Hz
    flight.fly(60)
    assert flight.late_since_s == []
    assert len(flight.ages_s) >= 5 * 60 - 2
    assert max(flight.ages_s) <= 0.2
