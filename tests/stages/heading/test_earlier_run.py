"""The heading of an earlier run: the probability that it holds by position and direction of flight, and its use."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.earlier_run import AGREEING, FRAME_AREA_M2, EarlierHeading, EarlierRun
from stages.heading.inertial_heading import FREE_SIGMA_MPS
from stages.messages import HeadingPrior

S = 1_000_000_000
SHARE = 0.05
NO_ERROR = np.zeros((3, 3))
FORWARD = np.array([5.0, 0.0, 0.0])
PRIOR = HeadingPrior(
    stamp_ns=S,
    yaw_map_rad=0.4,
    yaw_map_odom_rad=0.1,
    sigma_rad=0.03,
    xyz_map_m=np.array([10.0, 2.0, 10.0]),
    position_sigma_m=0.8,
    velocity_map_mps=FORWARD,
    velocity_sigma_mps=0.3,
)
HOVERING = dataclasses.replace(PRIOR, velocity_map_mps=np.zeros(3))


def heading(
    off_m=(0.0, 0.0, 0.0), velocity_map_mps=None, prior: HeadingPrior = PRIOR, late_ns: int = 0
) -> EarlierHeading | None:
    """At a LiDAR position that is off the prior's."""
    run = EarlierRun(SHARE)
    run.prior = prior
    run.add(prior.stamp_ns + late_ns, prior.xyz_map_m + np.array(off_m), NO_ERROR, velocity_map_mps)
    return run.heading(decided=False)


def probability(*args, **changes) -> float:
    found = heading(*args, **changes)
    assert found is not None
    return found.probability


def test_position_and_direction_of_flight_give_the_probability():
    near = (1 - SHARE) * FRAME_AREA_M2 * math.exp(-0.5 * 0.6**2 / 0.64) / (2 * math.pi * 0.64)
    found = heading((0.6, 0.0, 0.0))
    assert found is not None
    assert found.probability == pytest.approx(near / (near + SHARE))
    assert found.log_ratio == pytest.approx(math.log(near + SHARE))
    k = 5.0 * 4.0 / (FREE_SIGMA_MPS**2 + 0.09)
    agrees = near * math.exp(k * math.cos(0.2)) / np.i0(k)
    found = heading((0.6, 0.0, 0.0), rotation_z(0.2) @ (0.8 * FORWARD))
    assert found is not None
    assert found.probability == pytest.approx(agrees / (agrees + SHARE))
    assert found.log_ratio == pytest.approx(math.log(near + SHARE))  # another drone may fly in the same direction


def test_the_direction_of_flight_decides_what_the_position_of_a_drifted_estimate_does_not():
    drifted = 0.7, 1.0, 0.0
    assert probability(drifted) < 0.999 < probability(drifted, FORWARD)
    assert probability(drifted, -FORWARD) < 1e-6


def test_the_direction_of_a_hovering_drone_says_nothing():
    noise = np.array([0.3, -0.4, 0.1])
    assert probability(velocity_map_mps=noise, prior=HOVERING) == probability(prior=HOVERING)


def test_a_direction_is_worth_what_a_uniform_one_leaves():
    """The mean of the ratio over all directions of a changed frame is 1."""
    odds = []
    for a in np.linspace(0, 2 * math.pi, 200, endpoint=False):
        p = probability(velocity_map_mps=rotation_z(a) @ FORWARD)
        odds.append(p / (1 - p))
    p = probability()
    assert np.mean(odds) == pytest.approx(p / (1 - p), rel=1e-3)


def test_a_turned_world_changes_nothing_but_the_yaw():
    R = rotation_z(1.0)
    turned = dataclasses.replace(PRIOR, xyz_map_m=R @ PRIOR.xyz_map_m, velocity_map_mps=R @ FORWARD)
    off_m, velocity = np.array([0.3, -0.5, 0.2]), np.array([4.6, 0.7, 0.0])
    assert probability(R @ off_m, R @ velocity, prior=turned) == pytest.approx(probability(off_m, velocity))


@pytest.mark.parametrize("late_ns", [-80_000_000, 80_000_000])
def test_a_prior_of_another_time_is_moved_to_that_of_the_position(late_ns):
    assert probability(1e-9 * late_ns * FORWARD, late_ns=late_ns) == pytest.approx(probability())


def test_an_object_elsewhere_is_probably_another_one():
    here, elsewhere = heading(), heading((6.0, 0.0, 0.0), FORWARD)
    assert here is not None
    assert elsewhere is not None
    assert here.log_ratio > 4.0
    assert elsewhere.log_ratio == pytest.approx(math.log(SHARE), abs=0.01)
    assert elsewhere.probability < 0.01


def test_without_a_prior_of_the_time_there_is_no_heading():
    run = EarlierRun(SHARE)
    run.add(S, PRIOR.xyz_map_m, NO_ERROR, None)
    assert run.heading(decided=False) is None
    assert heading(late_ns=200_000_000) is None


def test_the_heading_is_used_once_and_not_when_one_is_decided():
    run = EarlierRun(SHARE)
    run.prior = PRIOR
    run.add(S, PRIOR.xyz_map_m, NO_ERROR, None)
    assert run.heading(decided=False) is not None
    assert run.heading(decided=False) is None
    run = EarlierRun(SHARE)
    run.prior = PRIOR
    run.add(S, PRIOR.xyz_map_m, NO_ERROR, None)
    assert run.heading(decided=True) is None
    assert run.heading(decided=False) is None


def test_the_yaw_of_the_frame_needs_positions_in_a_row_that_agree():
    run = EarlierRun(SHARE)
    run.prior = PRIOR
    found = []
    for off_m in [0.0] * (AGREEING - 1) + [5.0] + [0.0] * AGREEING:
        run.add(S, PRIOR.xyz_map_m + np.array([off_m, 0.0, 0.0]), NO_ERROR, FORWARD)
        found.append(run.odom_yaw(S))
    assert found[:-1] == [None] * (len(found) - 1)
    assert found[-1] is not None
    assert (found[-1].yaw_rad, found[-1].sigma_rad) == (0.1, 0.03)
