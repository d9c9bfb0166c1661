"""EvidenceDetect with cues: a true one speeds acceptance, a wrong one neither accepts nor hides anything."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect import EvidenceDetect
from stages.messages import CueKind, CueState, DroneCue
from tests.stages.caster import Ball, Drone, still
from tests.stages.detect.shipped import detector
from tests.stages.detect.test_candidate import candidate
from tests.stages.detect.test_evidence_detect import (
    MOVING,
    PLACE_M,
    accepted_after_s,
    observation,
    predicted,
    run,
    telemetry_of,
)
from tests.stages.made import START_NS

OFF_M = np.array([20.0, 0.0, 22.0])  # 30 m


def gnss(t_s: float, xyz_m) -> DroneCue:
    return DroneCue(
        stamp_ns=START_NS + round(1e9 * (t_s - 0.2)),
        source="gnss",
        kind=CueKind.POSITION,
        value_m=np.asarray(xyz_m, dtype=np.float64),
        covariance_m2=0.2 * np.eye(3),
        bias_covariance_m2=12.0 * np.eye(3),
        bias_time_s=120.0,
        yaw_sigma_rad=0.0,
        reference_map_m=np.zeros(3),
    )


class Receiver:
    """Publishes telemetry, and cues at 5 Hz, `off_m` from a trajectory, and keeps the states of the cue."""

    def __init__(self, trajectory, off_m=(0.0, 0.0, 0.0), telemetry=telemetry_of(MOVING)) -> None:  # noqa: B008
        self._trajectory, self._off_m, self._telemetry, self._next_s = trajectory, np.asarray(off_m), telemetry, 0.0
        self.states: list[CueState] = []

    def __call__(self, stage: EvidenceDetect, t_s: float) -> None:
        if self._telemetry is not None:
            self._telemetry(stage, t_s)
        if t_s >= self._next_s:
            self._next_s += 0.2
            xyz_m = self._trajectory(np.array([t_s - 0.2]))[0] + self._off_m
            self.states.append(stage.on_cue(gnss(t_s, xyz_m)))


def test_a_cue_30_m_off_delays_the_drone_by_about_a_second_and_is_reported():
    receiver = Receiver(MOVING, OFF_M)
    _, without = run([Drone(MOVING)], publish=telemetry_of(MOVING))
    _, detections = run([Drone(MOVING)], seconds=4.0, publish=receiver)
    assert accepted_after_s(detections) < accepted_after_s(without) + 1.3
    assert not receiver.states[-1].trusted
    assert "contradicts the LiDAR" in receiver.states[-1].reason


def test_the_first_observations_alone_are_never_accepted_by_a_cue():
    """Nor is a single observation away from the cue dropped: it stays promising."""
    for off_m in ((0.0, 0.0, 0.0), OFF_M):
        candidates, _ = run([Drone(MOVING)], seconds=0.6, publish=Receiver(MOVING, off_m))
        few = [(p, n) for c in candidates for p, n in zip(c.probability.tolist(), c.scan_passes.tolist(), strict=True)]
        assert any(n == 1 for _, n in few)
        assert all(p < 0.95 for p, n in few if n < 3)
        assert all(p >= 0.0139 for p, n in few if n == 1)


def test_a_balloon_exactly_at_a_wrong_cue_is_not_accepted():
    place = still(*PLACE_M)
    _, detections = run([Ball(place, 0.25)], seconds=4.0, publish=Receiver(place))
    assert accepted_after_s(detections) == math.inf


def test_a_cue_that_matches_an_accepted_candidate_adds_nothing_to_another_one():
    stage = detector(parked=True)
    now = stage._now
    drone, other = (candidate(observation(0.0, np.array(PLACE_M) + k)) for k in (0.0, 2.0))
    other.number = drone.number + 1
    for c in (drone, other):
        c.scan_passes = 3
        now.table.put(c)
    stage.on_cue(gnss(0.2, PLACE_M))
    now.cues.add_to(other, now.trail, now.table)
    assert other.cue_nats == pytest.approx(2.0)
    drone.accepted, drone.cue_nats, other.cue_nats = True, 2.0, None
    now.cues.add_to(other, now.trail, now.table)
    assert other.cue_nats == 0.0


def test_after_the_drone_is_known_the_cues_bias_is():
    receiver = Receiver(MOVING, (2.0, -2.0, 1.0))
    run([Drone(MOVING)], seconds=4.0, publish=receiver)
    last = receiver.states[-1]
    assert last.trusted
    assert last.bias_m == pytest.approx((2.0, -2.0, 1.0), abs=0.4)
    assert last.bias_sigma_m < 1.0


def classified(stage: EvidenceDetect, c, lidar_nats: float, monkeypatch):
    """The candidate, classified with these log-odds by the LiDAR."""
    predicted(lidar_nats, monkeypatch)
    stage._classify(stage._now, c)
    return c


def test_a_cue_does_not_keep_an_accepted_candidate_that_the_lidar_rejects(monkeypatch):
    stage, c = detector(parked=True), candidate(observation(0.0, np.array(PLACE_M)))
    c.scan_passes = 8
    stage.on_cue(gnss(0.2, PLACE_M))
    assert classified(stage, c, 3.5, monkeypatch).accepted
    assert classified(stage, c, 2.0, monkeypatch).accepted  # hysteresis
    assert not classified(stage, c, -0.7, monkeypatch).accepted  # 33 %, with the cue 79 %
    assert c.log_odds == pytest.approx(1.3, abs=0.05)


FLIGHT_MPS = np.array([4.0, 0.0, 0.5])
AT_REST_MPS = np.zeros(3)


def observed(flies_mps, cue_flies_mps, off_m=(0.0, 0.0, 0.0), seconds=1.4):
    """A stage with a cue, and a candidate after these seconds, each with a constant velocity."""
    stage, place_m = detector(parked=True), np.array(PLACE_M)
    times_s = np.arange(0.0, seconds + 1e-9, 0.1)
    c = candidate(*(observation(t, place_m + t * flies_mps) for t in times_s))
    c.scan_passes = len(times_s)
    for t in times_s[::2]:
        stage.on_cue(gnss(t + 0.2, place_m + t * cue_flies_mps + np.asarray(off_m)))
    return stage, c


def test_a_cue_that_moves_as_a_candidate_has_it_accepted(monkeypatch):
    stage, c = observed(FLIGHT_MPS, FLIGHT_MPS, (2.0, -2.0, 1.0))
    assert not classified(observed(FLIGHT_MPS, FLIGHT_MPS)[0], c, 0.8, monkeypatch).accepted
    c.cue_nats = None
    assert classified(stage, c, 1.0, monkeypatch).accepted
    assert "cues +2.0 (gnss +2.0)" in c.reason


@pytest.mark.parametrize(
    ("flies_mps", "cue_flies_mps", "off_m"),
    [
        (AT_REST_MPS, AT_REST_MPS, (0.0, 0.0, 0.0)),  # a lamp exactly where the cue of a drone is that hovers elsewhere
        (AT_REST_MPS, FLIGHT_MPS, -1.4 * FLIGHT_MPS),  # a lamp that the cue passes
        (FLIGHT_MPS, AT_REST_MPS, 1.4 * FLIGHT_MPS),  # a bird that passes the cue
        (FLIGHT_MPS, FLIGHT_MPS[[1, 0, 2]], (5.6, -5.6, 0.0)),  # one that flies elsewhere
    ],
)
def test_a_cue_that_does_not_show_that_it_is_of_a_candidate_never_has_it_accepted(
    flies_mps, cue_flies_mps, off_m, monkeypatch
):
    stage, c = observed(flies_mps, cue_flies_mps, off_m)
    c = classified(stage, c, 2.4, monkeypatch)
    assert c.cue_nats == pytest.approx(2.0)
    assert not c.accepted
    assert c.log_odds == pytest.approx(math.log(19.0) - 0.5)
    assert classified(stage, c, 3.0, monkeypatch).accepted  # by the LiDAR


def test_a_cue_that_agreed_with_the_drone_has_one_accepted_that_hovers(monkeypatch):
    stage, c = detector(parked=True), candidate(observation(0.0, np.array(PLACE_M)))
    c.scan_passes = 8
    stage._now.table.put(c)
    classified(stage, c, 3.5, monkeypatch)
    for k in range(12):
        c.seen_ns = c.stamp_ns = START_NS + k * 200_000_000
        stage.on_cue(gnss(0.2 + 0.2 * k, PLACE_M))
    c.accepted, c.cue_nats = False, None
    assert classified(stage, c, 1.0, monkeypatch).accepted


def proven(c):
    """The candidate, with a cue that is proven to be of it."""
    c.proven_cues = {"gnss"}
    return c


def test_what_limits_the_first_observations_does_not_limit_the_next(monkeypatch):
    stage, c = detector(parked=True), proven(candidate(observation(0.0, np.array(PLACE_M))))
    stage.on_cue(gnss(0.2, PLACE_M))
    for passes in (1, 2):
        c.scan_passes = passes
        assert classified(stage, c, 2.0, monkeypatch).log_odds == pytest.approx(math.log(19.0) - 0.5)
    c.scan_passes = 3
    assert classified(stage, c, 2.0, monkeypatch).log_odds == pytest.approx(4.0)


def test_a_gap_of_the_cue_is_no_contradiction(monkeypatch):
    stage, c = detector(parked=True), proven(candidate(observation(0.0, np.array(PLACE_M))))
    c.scan_passes = 8
    stage.on_cue(gnss(0.2, PLACE_M))
    assert classified(stage, c, 1.0, monkeypatch).log_odds == pytest.approx(3.0)
    c.stamp_ns = START_NS + 2_000_000_000  # the cue is too old
    assert classified(stage, c, 1.0, monkeypatch).log_odds == 1.0
    stage.on_cue(gnss(2.2, PLACE_M))
    assert classified(stage, c, 1.0, monkeypatch).log_odds == pytest.approx(3.0)


def test_a_jump_of_frame_map_removes_the_cues_of_the_old_one():
    stage, c = detector(parked=True), candidate(observation(0.0, np.array(PLACE_M)))
    c.scan_passes = 8
    stage.on_cue(gnss(0.2, PLACE_M))
    stage._now.odometry_jumped = True
    stage._prune(stage._now, c.stamp_ns)
    stage._now.cues.add_to(c, stage._now.trail, stage._now.table)
    assert c.cue_nats is None


def test_a_cue_is_compared_only_with_what_the_lidar_alone_accepts(monkeypatch):
    stage = detector(parked=True, cues={"max_gnss": 6.0, "max_sum": 6.0})
    c = proven(candidate(observation(0.0, np.array(PLACE_M))))
    c.scan_passes = 8
    stage._now.table.put(c)
    stage.on_cue(gnss(0.2, PLACE_M))
    assert classified(stage, c, 1.0, monkeypatch).accepted
    assert math.isnan(stage.on_cue(gnss(0.3, PLACE_M)).offset_m)
    classified(stage, c, 3.5, monkeypatch)
    assert stage.on_cue(gnss(0.4, PLACE_M)).offset_m == pytest.approx(0.0, abs=1e-9)
