"""A frame after an interruption: the probability that it is the same by position and direction of flight, its use."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.inertial_bank import NEAR_RAD
from stages.heading.inertial_heading import FREE_SIGMA_MPS
from stages.heading.same_frame import FIRST, FRAME_AREA_M2, PriorHeading, SameFrame
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
    off_m=(0.0, 0.0, 0.0),
    velocity_map_mps=None,
    prior: HeadingPrior = PRIOR,
    late_ns: int = 0,
    vehicle_map_m=None,
    turn_rad: float = math.pi,
) -> PriorHeading | None:
    """At a LiDAR position that is off the prior's."""
    run, xyz_m = SameFrame(SHARE, turn_rad), prior.xyz_map_m + np.array(off_m)
    run.add(prior, prior.stamp_ns + late_ns, xyz_m, NO_ERROR, velocity_map_mps, vehicle_map_m)
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
    run = SameFrame(SHARE, math.pi)
    run.add(None, S, PRIOR.xyz_map_m, NO_ERROR, None, None)
    assert run.heading(decided=False) is None
    assert heading(late_ns=200_000_000) is None


@pytest.mark.parametrize("decided", [False, True])
def test_the_heading_is_used_once_and_not_when_one_is_decided(decided: bool):
    run = SameFrame(SHARE, math.pi)
    run.add(PRIOR, S, PRIOR.xyz_map_m, NO_ERROR, None, None)
    assert (run.heading(decided) is None) is decided
    assert run.heading(decided=False) is None


# a frame that may be turned about the vehicle

BESIDE = PRIOR.xyz_map_m - np.array([6.0, 0.0, 10.0])
BELOW = PRIOR.xyz_map_m - np.array([0.0, 0.0, 10.0])


def test_the_probability_counts_the_frames_that_are_turned_about_the_vehicle():
    """Against a sum over turned priors; those within 20 deg are near enough."""
    turns_rad = np.radians(np.arange(-180.0, 180.0))
    k = 25.0 / (FREE_SIGMA_MPS**2 + 0.09)
    ratios = []
    for b in turns_rad:
        off_m = rotation_z(b) @ (PRIOR.xyz_map_m - BESIDE) - (PRIOR.xyz_map_m - BESIDE)
        position = FRAME_AREA_M2 * math.exp(-0.5 * float(off_m @ off_m) / 0.64) / (2 * math.pi * 0.64)
        ratios.append(position * math.exp(k * math.cos(b)) / np.i0(k))
    same, turned = (1 - SHARE) * ratios[180], SHARE / 2 * np.array(ratios) / 360
    near = np.abs(turns_rad) < NEAR_RAD
    holds = same + turned[near].sum()
    found = heading(velocity_map_mps=FORWARD, vehicle_map_m=BESIDE)
    assert found is not None
    assert found.probability == pytest.approx(holds / (same + turned.sum() + SHARE / 2), abs=1e-6)
    variance = PRIOR.sigma_rad**2 + (turned[near] @ turns_rad[near] ** 2) / holds
    assert found.sigma_rad == pytest.approx(math.sqrt(variance))


def test_above_the_vehicle_only_the_direction_of_flight_shows_a_turn():
    far = SHARE / 2 * 321 / 360  # of the turns, more than 20 deg
    assert probability(prior=HOVERING, vehicle_map_m=BELOW) == pytest.approx(1 - far / (1 - SHARE / 2), abs=1e-3)
    above = compared(*[0.0] * FIRST, prior=HOVERING, vehicle_map_m=BELOW)
    assert above.odom_yaw(S) is None
    assert probability(velocity_map_mps=FORWARD, vehicle_map_m=BELOW) > 0.99
    turned = rotation_z(math.radians(60.0)) @ FORWARD
    assert probability(velocity_map_mps=turned, vehicle_map_m=BELOW) < 0.01
    assert probability(prior=HOVERING, vehicle_map_m=BESIDE) > 0.99


def test_a_vehicle_that_stood_still_excludes_a_turn():
    assert probability(prior=HOVERING, vehicle_map_m=BELOW, turn_rad=math.radians(6.0)) > 0.998


# the yaw of the autopilot's frame


def compared(*offs_m: float, prior: HeadingPrior = PRIOR, vehicle_map_m=None) -> SameFrame:
    """After LiDAR positions that are off the prior's."""
    run = SameFrame(SHARE, math.pi)
    for off_m in offs_m:
        run.add(prior, S, prior.xyz_map_m + np.array([off_m, 0.0, 0.0]), NO_ERROR, FORWARD, vehicle_map_m)
    return run


def test_the_yaw_of_the_frame_is_that_of_the_prior_if_its_first_positions_agree():
    assert compared(*[0.0] * (FIRST - 1)).odom_yaw(S) is None
    for offs_m in ([0.0] * FIRST, [5.0, 5.0, 0.0, 0.0, 0.0]):  # two outliers
        yaw = compared(*offs_m).odom_yaw(S)
        assert yaw is not None
        assert (yaw.yaw_rad, yaw.sigma_rad) == (0.1, 0.03)


def test_a_position_that_agrees_only_because_the_prior_s_sigma_has_grown_shows_nothing():
    run = compared(*[5.0] * FIRST)
    uncertain = dataclasses.replace(PRIOR, position_sigma_m=5.0)
    for _ in range(2 * FIRST):
        run.add(uncertain, S, PRIOR.xyz_map_m + np.array([5.0, 0.0, 0.0]), NO_ERROR, FORWARD, None)
    assert run.odom_yaw(S) is None


def test_the_positions_of_another_object_are_judged_anew():
    run = compared(*[5.0] * FIRST)
    run.restart()
    for _ in range(FIRST):
        run.add(PRIOR, S, PRIOR.xyz_map_m, NO_ERROR, FORWARD, None)
    assert run.odom_yaw(S) is not None


@pytest.mark.parametrize(
    ("off_deg", "other"), [(0.0, False), (24.0, False), (-24.0, False), (27.0, True), (180.0, True)]
)
def test_a_decided_yaw_far_from_the_prior_s_contradicts_it(off_deg: float, other: bool):
    """20 deg, and three sigmas of the prior: 5.2 deg."""
    run, yaw_rad = SameFrame(SHARE, math.pi), PRIOR.yaw_map_rad + math.radians(off_deg)
    assert not run.contradicts(yaw_rad)
    run.add(PRIOR, PRIOR.stamp_ns, PRIOR.xyz_map_m, NO_ERROR, None, None)
    assert run.contradicts(yaw_rad + 2.0 * math.pi) == other
    run.add(None, PRIOR.stamp_ns, PRIOR.xyz_map_m, NO_ERROR, None, None)
    assert not run.contradicts(yaw_rad)
