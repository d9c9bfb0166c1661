"""EvidenceDetect with cues: a true one speeds acceptance, a wrong one neither accepts nor hides anything."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect import EvidenceDetect
from stages.messages import CueKind, CueState, DroneCue
from tests.stages.caster import Ball, Drone, still
from tests.stages.detect.test_candidate import candidate
from tests.stages.detect.test_evidence_detect import MOVING, PLACE_M, accepted_after_s, observation, reasons_of, run
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
        reference_map_m=np.zeros(3),
    )


class Receiver:
    """Publishes cues at 5 Hz, `off_m` from a trajectory, and keeps the states of the cue."""

    def __init__(self, trajectory, off_m=(0.0, 0.0, 0.0)) -> None:
        self._trajectory, self._off_m, self._next_s = trajectory, np.asarray(off_m), 0.0
        self.states: list[CueState] = []

    def __call__(self, stage: EvidenceDetect, t_s: float) -> None:
        if t_s >= self._next_s:
            self._next_s += 0.2
            xyz_m = self._trajectory(np.array([t_s - 0.2]))[0] + self._off_m
            self.states.append(stage.on_cue(gnss(t_s, xyz_m)))


@pytest.mark.parametrize("seed", range(2))
def test_a_true_cue_speeds_acceptance(seed):
    _, without = run([Drone(MOVING, seed=seed)])
    candidates, with_cue = run([Drone(MOVING, seed=seed)], publish=Receiver(MOVING, (2.0, -2.0, 1.0)))
    assert accepted_after_s(with_cue) < accepted_after_s(without) - 0.05  # scan passes are 0.1 s apart
    assert "cues +2.0 (gnss +2.0)" in reasons_of(candidates)


def test_a_cue_30_m_off_delays_the_drone_by_about_a_second_and_is_reported():
    receiver = Receiver(MOVING, OFF_M)
    _, without = run([Drone(MOVING)])
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


def test_a_balloon_exactly_at_a_lying_cue_is_not_accepted():
    place = still(*PLACE_M)
    _, detections = run([Ball(place, 0.25)], seconds=4.0, publish=Receiver(place))
    assert accepted_after_s(detections) == math.inf


def test_a_cue_that_matches_an_accepted_candidate_adds_nothing_to_another_one():
    stage = EvidenceDetect(parked=True)
    now = stage._now
    drone, other = (candidate(observation(0.0, np.array(PLACE_M) + k)) for k in (0.0, 2.0))
    other.number = drone.number + 1
    for c in (drone, other):
        c.scan_passes = 3
        now.table.put(c)
    stage.on_cue(gnss(0.2, PLACE_M))
    stage._add_cues(now, other)
    assert other.cue_nats == pytest.approx(2.0)
    drone.accepted, drone.cue_nats, other.cue_nats = True, 2.0, None
    stage._add_cues(now, other)
    assert other.cue_nats == 0.0


def test_after_the_drone_is_known_the_cues_bias_is():
    receiver = Receiver(MOVING, (2.0, -2.0, 1.0))
    run([Drone(MOVING)], seconds=4.0, publish=receiver)
    last = receiver.states[-1]
    assert last.trusted
    assert last.bias_m == pytest.approx((2.0, -2.0, 1.0), abs=0.4)
    assert last.bias_sigma_m < 1.0
