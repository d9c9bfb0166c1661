"""Whether a cue is of the drone: it moves as that does, or as something else."""

from __future__ import annotations

import numpy as np
import pytest

from stages.fuse.cues.cue_owner import LEAST, PRIOR, CueOwner
from tests.stages.fuse.imu_flights import ns

NOISE_M2, WALK_M2 = 0.05 * np.eye(3), 0.06 * np.eye(3)


def follow(cue, own, seconds: float, vehicle=lambda t: np.zeros(3), step_s: float = 0.2, into: CueOwner | None = None):
    owner = into or CueOwner()
    for t in np.arange(0.0, seconds, step_s):
        value, mine = np.atleast_1d(cue(t)), np.atleast_1d(own(t))
        n = len(value)
        owner.add(ns(t), value, mine, vehicle(t), (NOISE_M2[:n, :n], WALK_M2[:n, :n]))
    return owner


def path(t):
    return np.array([3.0 * np.sin(0.8 * t), 2.0 * np.cos(0.5 * t), 10.0])


def still(t):
    return np.array([4.0, 1.0, 10.0])


def test_a_cue_that_moves_with_the_drone_is_certain_whatever_its_offset():
    owner = follow(lambda t: path(t) + np.array([5.0, -9.0, 3.0]), path, 4.0)
    assert owner.certain
    assert not owner.denied


@pytest.mark.parametrize("seconds", [4.0, 60.0])
def test_nothing_is_known_while_both_stand_still(seconds):
    owner = follow(still, still, seconds)
    assert not owner.certain
    assert not owner.denied


def test_a_cue_of_an_object_that_hovers_is_denied_when_the_drone_moves():
    assert follow(still, path, 4.0).denied


def test_a_cue_of_an_object_that_moves_is_denied_while_the_drone_hovers():
    assert follow(path, still, 4.0).denied


def test_an_object_that_stands_beside_the_road_is_not_the_drone_that_follows_the_vehicle():
    def vehicle(t):
        return np.array([5.0 * t, 0.0, 0.0])

    owner = follow(lambda t: still(t) - vehicle(t), still, 4.0, vehicle)
    assert owner.denied


def test_a_drone_that_hovers_over_a_moving_vehicle_is_not_told_from_another_that_does():
    owner = follow(still, still, 30.0, lambda t: np.array([5.0 * t, 0.0, 0.0]))
    assert not owner.certain


def test_one_reflection_does_not_end_it():
    jump = np.array([3.0, 0.0, 0.0])
    owner = follow(lambda t: path(t) + jump * (6.1 < t < 7.3), path, 30.0)
    assert owner.certain


def test_a_change_of_the_object_is_noticed():
    def other(t):
        return path(t) if t < 10.0 else path(10.0) + np.array([0.0, 0.0, 1.5 * (t - 10.0)])

    assert follow(other, path, 10.0).certain
    assert not follow(other, path, 14.0).certain


def test_a_distance_alone_is_enough():
    def distance(t):
        return np.linalg.norm(path(t) * [4.0, 4.0, 1.0])

    assert follow(lambda t: distance(t) + 0.3, distance, 20.0).certain
    assert follow(lambda t: np.linalg.norm(still(t)), distance, 20.0).denied


def test_spans_without_the_lidar_do_not_count():
    owner = CueOwner()
    for k in range(200):
        if k % 4 == 0:
            owner.pause()
        t = 0.2 * k
        owner.add(ns(t), path(t), still(t), np.zeros(3), (NOISE_M2, WALK_M2))
    assert not owner.denied


def test_by_hand():
    """One span of 1 s: own moved 1 m, so did the cue; densities with S = 0.05 + 0.06 an axis."""
    owner = CueOwner()
    for t, x in ((0.0, 0.0), (1.0, 1.0)):
        owner.add(ns(t), np.array([x, 0, 0]), np.array([x, 0, 0]), np.zeros(3), (NOISE_M2, WALK_M2))
    S, free, out = 0.11, 9.11, 0.05 * 20.0**-3

    def density(d2, s):
        return 0.95 * np.exp(-0.5 * d2 / s) / (2 * np.pi * s) ** 1.5 + out

    weight = PRIOR * [density(0, S), density(1, S), density(1, S), density(1, free)]
    weight = np.maximum(weight / weight.sum(), LEAST)
    assert owner._probability == pytest.approx(weight / weight.sum())
