"""The joint refinement: exact lines give the exact rotation, its covariance matches the errors, symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.align.refine import Refined, Tolerances, from_square, half_turn_difference, refine, street_directions
from stages.align.spectra import level_lines, overlap, peaks, spectrum
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import CameraMount
from tests.stages.align.made_lines import ATLANTA, CAMPUS, MANHATTAN, seen, turned

STRAIGHT = math.radians(0.25)
ALLOWED = Tolerances(STRAIGHT, math.radians(0.1), math.radians(0.5), 0.0)


def aligned(R_world_vehicle, R_world_drone, streets=MANHATTAN, allowed=ALLOWED, **kwargs) -> Refined:
    """The refinement of one pair, as in the stage."""
    vehicle = level_lines(seen(CameraMount.VEHICLE, R_world_vehicle, streets, **kwargs), STRAIGHT)
    drone = level_lines(seen(CameraMount.DRONE, R_world_drone, streets, **kwargs), STRAIGHT)
    assert vehicle is not None
    assert drone is not None
    a, b = spectrum(vehicle), spectrum(drone)
    yaw = peaks(overlap(a, b), math.radians(4))[0].yaw_rad
    return refine(vehicle, drone, street_directions(a, b, yaw), yaw, allowed)


def error(refined: Refined, R_world_vehicle, R_world_drone):
    """phi of R_true exp(phi) = R (3,), for the branch that is nearest, and which that is."""
    R_true = R_world_vehicle.T @ R_world_drone
    errors = [log_rotation(R_true.T @ refined.R_vehicle_drone(k)) for k in range(4)]
    k = int(np.argmin([np.linalg.norm(e) for e in errors]))
    return errors[k], k


@pytest.mark.parametrize("streets", [MANHATTAN, ATLANTA, CAMPUS])
@pytest.mark.parametrize("yaw_deg", [3.0, 47.0, 158.0, 290.0])
def test_perfect_lines_give_the_rotation_also_of_tilted_carriers(streets, yaw_deg):
    R_v, R_d = turned(2.0, -3.0, 20.0), turned(-12.0, 9.0, yaw_deg)
    phi, _ = error(aligned(R_v, R_d, streets, sigma_rad=0.0), R_v, R_d)
    np.testing.assert_allclose(phi, 0.0, atol=1e-5)


def test_the_tilt_is_that_of_the_images_with_its_sigma_and_its_effect_on_the_yaw():
    """The lines have determined the verticals before: they give no more of them here."""
    R_v, R_d = turned(0, 0, 0), turned(0, 0, 31)
    options = {"per_direction": 60, "sigma_rad": 1e-4, "up_error_rad": 0.02, "seed": 2}
    refined = aligned(R_v, R_d, up_sigma_rad=0.02, **options)
    images = [seen(mount, R, **options) for mount, R in ((CameraMount.VEHICLE, R_v), (CameraMount.DRONE, R_d))]
    for image, R_level in zip(images, (refined.R_vehicle_level, refined.R_drone_level), strict=True):
        np.testing.assert_allclose(R_level[:, 2], image.direction[0], atol=1e-12)
    np.testing.assert_allclose(refined.covariance[:4, :4], 0.02**2 * np.eye(4), atol=1e-12)
    exact = aligned(R_v, R_d, up_sigma_rad=1e-6, **options)
    assert refined.yaw_sigma_rad > 1.2 * exact.yaw_sigma_rad


def test_turning_the_world_changes_nothing():
    R_v, R_d, turn = turned(1, 2, 3), turned(4, 5, 66), rotation_z(0.4)
    here = aligned(R_v, R_d)
    there = aligned(turn @ R_v, turn @ R_d, tuple(a + math.degrees(0.4) for a in MANHATTAN))
    np.testing.assert_allclose(
        error(here, R_v, R_d)[0], error(there, turn @ R_v, turn @ R_d)[0], atol=math.radians(0.3)
    )


def test_the_four_branches_differ_by_90_deg_about_the_vertical():
    R_v, R_d = turned(5, -4, 0), turned(0, 0, 10)
    refined = aligned(R_v, R_d, sigma_rad=0.0)
    up = R_v.T[:, 2]
    for k in range(4):
        step = refined.R_vehicle_drone(k + 1) @ refined.R_vehicle_drone(k).T
        np.testing.assert_allclose(step @ up, up, atol=1e-6)
        assert np.trace(step) == pytest.approx(1.0)


@pytest.mark.parametrize("streets", [MANHATTAN, ATLANTA, CAMPUS])
def test_the_covariance_matches_the_errors(streets):
    """NEES over 120 pairs, with shared errors as in the tolerances; three degrees of freedom."""
    rng = np.random.default_rng(7)
    shared = math.radians(0.2)
    allowed = Tolerances(STRAIGHT, shared, math.radians(0.5), 0.0)
    nees = []
    for seed in range(120):
        R_v, R_d = turned(*rng.normal(0, 3, 2), rng.uniform(0, 360)), turned(*rng.normal(0, 9, 2), rng.uniform(0, 360))
        refined = aligned(
            R_v, R_d, streets, allowed, seed=seed, direction_error_rad=shared, up_error_rad=0.004, up_sigma_rad=0.004
        )
        phi, k = error(refined, R_v, R_d)
        nees.append(phi @ np.linalg.solve(refined.covariance_rad2(k), phi))
    assert 0.4 < np.mean(nees) / 3 < 1.5
    assert np.mean(np.array(nees) < 7.815) > 0.9


def test_more_lines_of_one_street_do_not_reduce_sigma_below_their_shared_error():
    R_v, R_d = turned(0, 0, 0), turned(0, 0, 31)
    few, many = (aligned(R_v, R_d, per_direction=n, sigma_rad=0.003).yaw_sigma_rad for n in (20, 400))
    assert many < few
    assert many > math.radians(0.1)  # two cameras, two directions: 0.1 sqrt(2) / sqrt(2) at best


def test_few_or_inconsistent_lines_increase_sigma():
    R_v, R_d = turned(0, 0, 0), turned(0, 0, 31)
    good, few, odd = (
        aligned(R_v, R_d, per_direction=n, sigma_rad=0.003, direction_error_rad=0.0, random_lines=s).yaw_sigma_rad
        for n, s in ((40, 0), (4, 0), (40, 2000))
    )
    assert few > 1.5 * good
    assert odd > 1.2 * good


def test_random_lines_hardly_change_the_yaw():
    R_v, R_d = turned(1, 1, 0), turned(-3, 2, 31)
    phi, _ = error(aligned(R_v, R_d, per_direction=25, random_lines=25, sigma_rad=0.002), R_v, R_d)
    assert np.linalg.norm(phi) < math.radians(0.3)


def test_cameras_on_different_streets_of_a_crossing_are_tied_by_its_right_angle():
    vehicle = level_lines(seen(CameraMount.VEHICLE, turned(0, 0, 0), (10.0,), sigma_rad=0.0), STRAIGHT)
    drone = level_lines(seen(CameraMount.DRONE, turned(0, 0, 25), (100.0,), sigma_rad=0.0), STRAIGHT)
    assert vehicle is not None
    assert drone is not None
    a, b = spectrum(vehicle), spectrum(drone)
    directions = street_directions(a, b, math.radians(25.0))
    refined = refine(vehicle, drone, directions, math.radians(25.0), ALLOWED)
    assert math.degrees(refined.yaw_rad) == pytest.approx(25.0, abs=0.01)
    assert math.radians(0.5) < refined.yaw_sigma_rad < math.radians(0.8)
    assert refined.directions == 0  # none in common


def test_street_directions_are_the_strongest_of_both_and_not_too_many():
    vehicle = level_lines(seen(CameraMount.VEHICLE, turned(0, 0, 0), (0.0, 25.0, 50.0, 75.0), sigma_rad=0.0), STRAIGHT)
    drone = level_lines(seen(CameraMount.DRONE, turned(0, 0, 0), (100.0, 125.0, 150.0, 175.0), sigma_rad=0.0), STRAIGHT)
    assert vehicle is not None
    assert drone is not None
    found = np.degrees(street_directions(spectrum(vehicle), spectrum(drone), 0.0))
    assert len(found) == 6
    assert all(min(abs((f - a + 90) % 180 - 90) for a in range(0, 200, 25)) < 0.3 for f in found)


@pytest.mark.parametrize(("angle", "square"), [(90, 0), (-90, 0), (88, -2), (-88, 2), (272, 2), (45, -45)])
def test_from_square(angle, square):
    assert math.degrees(from_square(math.radians(angle))) == pytest.approx(square)


@pytest.mark.parametrize(("angle", "nearest"), [(0, 0), (179, -1), (-100, 80), (90, -90)])
def test_half_turn_difference(angle, nearest):
    assert math.degrees(half_turn_difference(math.radians(angle))) == pytest.approx(nearest)
