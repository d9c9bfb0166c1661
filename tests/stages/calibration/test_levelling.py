"""Zero and axis tilt by the stated orientation: found, with the sigma of the statement, or rejected with a reason."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.calibration.calibrate import calibrate
from stages.calibration.levelling import Standing, stand
from stages.geometry.frames import rotation_from_rpy_deg
from tests.stages.calibration.made_sweep import GROUND, RIG, sweep, wrong_mount

STATED_RAD = math.radians(0.15)
ENDS = ((1.0, 0.0, 0.0, 14.0), (-1.0, 0.0, 0.0, 16.0))
WALLS = ((0.0, 1.0, 0.0, 5.0), (0.0, -1.0, 0.0, 9.0))  # parallel to the vehicle
TILT_DEG = (1.2, -0.8)


def seen(plane, R):
    """A plane in the axes of a base with this orientation in the vehicle."""
    *normal, distance = plane
    return (*(np.asarray(normal) @ R), distance)


def turned(plane, deg):
    """A plane turned about the upright."""
    *normal, distance = plane
    return (*(rotation_from_rpy_deg((0.0, 0.0, deg)) @ normal), distance)


def sloped(deg):
    """Ground that rises to the left."""
    return (0.0, math.sin(math.radians(deg)), -math.cos(math.radians(deg)), 2.0)


def found_in(planes, zero_deg=0.5, tilt_deg=(0.0, 0.0), seed=3, **stated):
    """(true mount except its encoder, the calibration) with the stated orientation."""
    R = rotation_from_rpy_deg((*tilt_deg, 0.0))
    true = wrong_mount(seed).moved({"zero": math.radians(zero_deg)})
    made = sweep(true, planes=[seen(plane, R) for plane in planes], seed=seed)
    found = calibrate(made.returns, made.trace, RIG)
    return true, stand(found, RIG, Standing(**stated))


def finding(found, name):
    return next(f for f in found.findings if f.name == name)


def off_deg(true, found):
    """Mean error of the turntable angle over the sweep."""
    at = np.radians(np.linspace(5.0, 175.0, 171))
    wanted = true.sign * (at - true.zero_rad) - true.encoder_error_rad(at)
    return math.degrees(float(np.mean(found.mount.turntable_rad(at) - wanted)))


@pytest.mark.parametrize("zero_deg", [0.5, -0.5])
def test_a_wall_next_to_the_vehicle_determines_the_zero(zero_deg):
    true, found = found_in((*GROUND, *WALLS, *ENDS), zero_deg, parallel_rad=STATED_RAD)
    result = finding(found, "zero")
    assert result.rejected == ""
    assert abs(off_deg(true, found)) < 0.05
    assert 0.15 <= result.sigma < 0.2
    assert result.after == found.mount.servo_zero_deg
    assert result.what == "servo's zero, by the wall 5.0 m to the left"
    assert found.mount.pointing_sigma_deg == pytest.approx(
        math.hypot(result.sigma, math.degrees(found.curve_sigma_rad))
    )


def test_without_a_stated_orientation_nothing_changes():
    true, found = found_in((*GROUND, *WALLS, *ENDS))
    assert abs(off_deg(true, found)) > 0.3
    assert "--parallel" in finding(found, "zero").rejected
    assert found.mount.T_vehicle_turntable == RIG.T_vehicle_turntable
    assert found.mount.pointing_sigma_deg < 0.15  # a zero set by eye


def test_an_angle_to_the_wall_is_in_the_zero_and_within_its_sigma():
    askew = [turned(wall, 0.2) for wall in WALLS]
    true, found = found_in((*GROUND, *askew, *ENDS), parallel_rad=STATED_RAD)
    assert off_deg(true, found) == pytest.approx(-0.2, abs=0.05)
    assert abs(off_deg(true, found)) < 2 * finding(found, "zero").sigma


@pytest.mark.parametrize(
    ("planes", "why"),
    [
        ((turned(WALLS[0], 2.0), WALLS[1]), "the walls on both sides differ by 2"),
        ((turned(WALLS[0], 25.0), turned(WALLS[1], 25.0)), "no wall of 4 m"),
        ((turned(WALLS[0], 4.0), turned(WALLS[1], 4.0)), "4.5 deg off the vehicle's heading"),
        (((0.0, 1.0, 0.0, 12.0), (0.0, -1.0, 0.0, 15.0)), "within 10 m"),
    ],
)
def test_unsuitable_walls_are_rejected(planes, why):
    _, found = found_in((*GROUND, *planes, *ENDS), parallel_rad=STATED_RAD)
    result = finding(found, "zero")
    assert why in result.rejected
    assert found.mount.servo_zero_deg == result.before


def test_an_orientation_less_accurate_than_an_uncalibrated_rig_is_rejected():
    _, found = found_in((*GROUND, *WALLS, *ENDS), parallel_rad=math.radians(0.5))
    assert "as bought" in finding(found, "zero").rejected


def test_the_ground_determines_the_tilt_of_the_axis_but_not_the_zero():
    true, found = found_in((*GROUND, *WALLS, *ENDS), tilt_deg=TILT_DEG, level_rad=STATED_RAD)
    R = found.mount.T_vehicle_turntable.matrix()[:3, :3]
    off = R @ rotation_from_rpy_deg((*TILT_DEG, 0.0)).T
    assert math.degrees(math.hypot(off[0, 2], off[1, 2])) < 0.05
    assert [finding(found, f"level_{axis}").after for axis in "xy"] == pytest.approx(TILT_DEG, abs=0.05)
    assert 0.15 <= finding(found, "level_x").sigma < 0.3
    assert found.mount.T_vehicle_turntable.xyz_m == RIG.T_vehicle_turntable.xyz_m
    assert finding(found, "zero").rejected
    assert abs(off_deg(true, found)) > 0.3


def test_ground_and_wall_together_determine_the_zero_of_a_tilted_axis():
    true, found = found_in((*GROUND, *WALLS, *ENDS), tilt_deg=TILT_DEG, level_rad=STATED_RAD, parallel_rad=STATED_RAD)
    assert finding(found, "zero").rejected == ""
    assert abs(off_deg(true, found)) < 0.06


def test_an_even_slope_counts_as_level():
    """The statement is about the ground around the vehicle: its wheels stand on the same slope."""
    _, found = found_in((sloped(3.0), *WALLS, *ENDS), tilt_deg=(3.0, 0.0), level_rad=STATED_RAD)
    assert finding(found, "level_x").rejected == ""
    assert finding(found, "level_x").after == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("rises_deg", [4.0, 8.0])
def test_curved_ground_is_rejected(rises_deg):
    _, found = found_in((sloped(rises_deg), sloped(-rises_deg), *WALLS, *ENDS), level_rad=STATED_RAD)
    assert finding(found, "level_x").rejected
    assert found.mount.T_vehicle_turntable == RIG.T_vehicle_turntable


@pytest.mark.parametrize("rises_deg", [0.4, pytest.param(1.0, marks=pytest.mark.slow), 2.0])
def test_a_slope_next_to_the_vehicle_is_rejected_or_in_the_sigma(rises_deg):
    _, found = found_in((*GROUND, sloped(rises_deg), *WALLS, *ENDS), level_rad=STATED_RAD)
    result = finding(found, "level_x")
    assert result.rejected or abs(result.after) < 2 * result.sigma


def test_ground_that_was_not_observed_around_the_vehicle_is_rejected():
    _, found = found_in((*WALLS, *ENDS), level_rad=STATED_RAD)
    assert "too little of the ground" in finding(found, "level_x").rejected
