"""Several matches of both cameras as one measurement: of the bank of yaw hypotheses, and of a decided heading."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_bank import InertialBank, joined, start
from stages.heading.inertial_heading import DISAGREE, InertialHeading
from stages.heading.inertial_state import THETA, InertialState
from stages.heading.rotation_matches import RotationMatches, add_matches, combine
from stages.kernels.geometry.so3 import exp_rotation

UP = np.array([0.0, 0.0, 1.0])
QUARTER = math.pi / 2


def matches(*yaws_deg: float, p=(0.9,), sigma_deg=0.3, tilt_deg=0.0) -> RotationMatches:
    R = np.array([rotation_z(math.radians(yaw)) @ exp_rotation(np.radians([tilt_deg, 0, 0])) for yaw in yaws_deg])
    return RotationMatches(R, np.tile(math.radians(sigma_deg) ** 2 * np.eye(3), (len(R), 1, 1)), np.array(p), np.eye(3))


def any_yaw() -> InertialBank:
    return start(np.zeros(3), 0.01 * np.eye(3), None, UP)


def near(bank: InertialBank, yaw_deg: float, reach_deg: float = 2.0) -> float:
    """Probability of the hypotheses that are narrow and near a yaw, on any branch."""
    off = np.remainder(bank.state.yaw_rad - math.radians(yaw_deg) + QUARTER / 2, QUARTER) - QUARTER / 2
    narrow = np.sqrt(bank.state.yaw_variance_rad2) < math.radians(5)
    return float(bank.weight[narrow & (np.abs(off) < math.radians(reach_deg))].sum())


def decided(yaw_deg=0.0, sigma_deg=3.0) -> InertialState:
    P = np.eye(15)[None] * 1e-2
    P[:, THETA, THETA] = math.radians(sigma_deg) ** 2 * np.eye(3)
    return InertialState(rotation_z(math.radians(yaw_deg))[None], *np.zeros((2, 1, 3)), np.zeros((1, 6)), P)


def test_one_match_leaves_four_equally_probable_branches_and_the_case_that_it_is_wrong():
    bank = any_yaw()
    right = add_matches(bank, matches(20.0), 1.0)
    assert right == pytest.approx(0.9, abs=0.05)
    assert near(bank, 20.0) == pytest.approx(0.9, abs=0.05)
    for k in range(4):
        off = np.abs(np.remainder(bank.state.yaw_rad - math.radians(20 + 90 * k) + math.pi, 2 * math.pi) - math.pi)
        narrow = np.sqrt(bank.state.yaw_variance_rad2) < math.radians(5)
        assert bank.weight[narrow & (off < 0.05)].sum() == pytest.approx(0.225, abs=0.02)


def test_many_matches_stay_apart_however_many_hypotheses_that_makes():
    """The wide free hypotheses are merged instead."""
    bank, streets_deg = any_yaw(), (2.0, 14.0, 27.0, 45.0)
    for _ in range(6):
        add_matches(bank, matches(*streets_deg, p=(0.4, 0.25, 0.15, 0.1)), 1.0)
    sigma_rad = np.sqrt(bank.state.yaw_variance_rad2[bank.tied])
    assert len(sigma_rad) == 4 * len(streets_deg)
    assert sigma_rad.max() < math.radians(1.0)


def test_two_matches_share_the_probability_as_stated():
    bank = any_yaw()
    add_matches(bank, matches(20.0, 54.0, p=(0.6, 0.3)), 1.0)
    assert near(bank, 20.0) == pytest.approx(0.6, abs=0.05)
    assert near(bank, 54.0) == pytest.approx(0.3, abs=0.05)


def test_images_that_repeat_the_same_match_do_not_make_it_more_probable():
    """A wrong match repeats itself in all images of a street."""
    bank = any_yaw()
    add_matches(bank, matches(20.0), 1.0)
    for _ in range(50):
        add_matches(bank, matches(20.0), 0.1)
    assert near(bank, 20.0) == pytest.approx(0.9, abs=0.05)
    assert bank.weight[bank.tied].sum() == pytest.approx(0.9, abs=0.05)
    assert np.sqrt(bank.state.yaw_variance_rad2[~bank.tied]).min() > math.radians(10)  # the free ones use no image


def test_a_match_that_returns_more_often_wins_among_the_tied_hypotheses():
    bank = any_yaw()
    add_matches(bank, matches(20.0, 54.0, p=(0.45, 0.45)), 1.0)
    for _ in range(20):
        add_matches(bank, matches(54.0), 0.2)
    assert near(bank, 54.0) > 5 * near(bank, 20.0)
    assert bank.weight[bank.tied].sum() == pytest.approx(0.9, abs=0.05)


def test_matches_that_later_images_contradict_leave_the_free_hypotheses_alone():
    heading = InertialHeading(ImuBuffer())
    heading.start(0, np.zeros(3), 0.01 * np.eye(3), None, UP)
    heading.add_rotation(0, matches(20.0), 1.0)
    for _ in range(DISAGREE - 1):
        heading.add_rotation(0, matches(60.0), 0.1)
    assert heading.bank is not None
    assert heading.bank.tied.any()
    heading.add_rotation(0, matches(60.0), 0.1)
    assert not heading.bank.tied.any()
    assert near(heading.bank, 20.0) == near(heading.bank, 60.0) == 0.0
    heading.add_rotation(0, matches(60.0), 0.1)
    assert near(heading.bank, 60.0) == pytest.approx(0.9, abs=0.05)


def test_a_street_15_deg_from_that_of_the_cameras_keeps_the_heading_undecided():
    """Without cameras yaws within 20 deg of each other count as the same."""
    near_probability = {}
    for tied in (True, False):
        heading = InertialHeading(ImuBuffer())
        heading.resume(0, decided(0.0, 0.3))
        assert heading.bank is not None
        both = joined([decided(0.0, 0.3), decided(15.0, 1.5)])
        heading.bank.replace(both, np.log([0.97, 0.03]), np.array([tied, False]))
        heading.add_position(np.zeros(3), 0.01 * np.eye(3))
        near_probability[tied] = heading.near_probability
    assert near_probability[True] == pytest.approx(0.97, abs=0.01)
    assert near_probability[False] > 0.999


def test_a_match_with_another_tilt_is_not_used():
    bank = any_yaw()
    assert add_matches(bank, matches(20.0, tilt_deg=25.0), 1.0) == 0.0
    assert near(bank, 20.0) == 0.0


def test_a_decided_heading_takes_the_match_that_agrees_and_ignores_others():
    one = combine(decided(1.0), matches(34.0, 0.0 + 90, p=(0.7, 0.25)))
    assert one.R_map_drone is not None
    assert math.degrees(math.atan2(one.R_map_drone[1, 0], one.R_map_drone[0, 0])) == pytest.approx(0.0, abs=0.2)


def test_two_matches_that_both_agree_have_a_covariance_that_covers_both():
    one = combine(decided(0.0, 6.0), matches(-6.0, 6.0, p=(0.45, 0.45)))
    assert one.R_map_drone is not None
    assert math.degrees(math.sqrt(one.spread_rad2[2, 2])) > 5.5


def test_a_match_that_contradicts_a_decided_heading_is_rejected():
    one = combine(decided(0.0, 1.0), matches(20.0))
    assert one.R_map_drone is None
    assert math.degrees(abs(one.residual_rad[2])) == pytest.approx(20.0, abs=0.1)
