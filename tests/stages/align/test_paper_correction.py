"""Correction by motion: R_f by hand, the last seven, and motions that are too short, too steep, inconsistent or unknown."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.align.paper_correction import CorrectionRule, MotionCorrection, heading_change_rad
from stages.geometry.frames import rotation_z
from tests.stages.align.paper_flight import Flight


def fly(flight, images, wrong_deg=0.0, step=14, fixes=None, vehicle=True, motion=None):
    """Feed `images` images; R_GD0 is the true one with `wrong_deg` on its left, in the world."""
    correction = MotionCorrection(CorrectionRule())
    for k in range(images):
        if vehicle:
            correction.add_vehicle(flight.vehicle(k))
        if fixes is None or k in fixes:
            correction.add_fix(flight.fix(k))
        R_G = flight.R_vehicle(k)
        wrong = R_G.T @ rotation_z(math.radians(wrong_deg)) @ R_G @ flight.R_vehicle_drone(k)
        correction.add_image(flight.fix(k).stamp_ns, wrong)
        if k >= step:
            correction.add_motion(flight.motion(k - step, k) if motion is None else motion(k - step, k))
    return correction


def turn_deg(correction):
    turn = correction.turn_rad()
    return None if turn is None else math.degrees(turn)


@pytest.mark.parametrize(
    ("f_hat", "f", "deg"),
    [
        ((1, 0, 0), (0, 2, 0), 90),
        ((0, 2, 0.5), (3, 0, 0), -90),
        ((1, 0, 0), (-1, 1e-9, 0), 180),
        ((1, 1, 0.3), (5, 5, -2), 0),
        ((1, 0, 0), (math.cos(0.3), math.sin(0.3), 0.2), math.degrees(0.3)),
    ],
)
def test_the_heading_change_rotates_one_heading_to_the_other(f_hat, f, deg):
    f_hat, f = np.array(f_hat, float), np.array(f, float)
    angle = heading_change_rad(f_hat, f)
    assert math.degrees(angle) == pytest.approx(deg, abs=1e-6)
    turned = rotation_z(angle) @ f_hat
    assert math.atan2(turned[1], turned[0]) == pytest.approx(math.atan2(f[1], f[0]), abs=1e-6)


def test_a_steep_vector_has_no_heading():
    assert heading_change_rad(np.array([0.1, 0, 2.0]), np.array([1.0, 0, 0])) is None
    assert heading_change_rad(np.array([1.0, 0, 0]), np.array([0.0, 0.5, -3.0])) is None
    assert heading_change_rad(np.array([1.0, 0, 1.7]), np.array([1.0, 0, 0])) is not None, "just below 60 deg"


@pytest.mark.parametrize("wrong_deg", [-90, 0, 90, 170])
def test_the_turn_undoes_a_wrong_yaw_while_both_move_and_turn(wrong_deg):
    flight = Flight(drone_yaw_deg=40, drone_dps=12.0)
    assert turn_deg(fly(flight, 25, wrong_deg)) == pytest.approx(-wrong_deg, abs=1e-6)


def test_turning_the_world_changes_nothing():
    for yaw in (0.0, 77.0, 200.0):
        R = rotation_z(math.radians(yaw))
        flight = Flight(drone_yaw_deg=40 + yaw, speed_mps=R @ [2.0, 1.0, 0.1], vehicle_mps=0.0, vehicle_dps=0.0)
        assert turn_deg(fly(flight, 25, 90)) == pytest.approx(-90, abs=1e-6)


def test_single_steps_are_chained_to_fourteen_images():
    flight = Flight(drone_yaw_deg=-30, drone_dps=20.0)
    assert turn_deg(fly(flight, 25, 90, step=1)) == pytest.approx(-90, abs=0.5)
    assert turn_deg(fly(flight, 25, 90, step=5)) == pytest.approx(-90, abs=0.5)


def test_motions_from_key_images_are_chained_over_the_keys():
    """A key every 4 images: the motion to image k begins at the key before it."""
    flight = Flight(drone_yaw_deg=-30, drone_dps=20.0)
    correction = fly(flight, 30, 90, step=99)
    for k in range(1, 30):
        correction.add_motion(flight.motion((k - 1) // 4 * 4, k))
    assert turn_deg(correction) == pytest.approx(-90, abs=0.5)


def test_a_chain_with_a_missing_step_gives_no_turn():
    flight = Flight()
    correction = fly(flight, 30, step=99)
    for k in range(1, 30):
        if k % 8:
            correction.add_motion(flight.motion(k - 1, k))
    assert turn_deg(correction) is None


def test_seven_are_needed():
    flight = Flight()
    assert turn_deg(fly(flight, 14 + 6)) is None
    assert turn_deg(fly(flight, 14 + 7)) == pytest.approx(0.0, abs=1e-6)


def test_every_pair_is_used_once():
    flight = Flight()
    correction = fly(flight, 25, 90)
    assert turn_deg(correction) == pytest.approx(-90, abs=1e-6)
    assert turn_deg(correction) is None, "the drone hovers: old motion is not used"


def test_less_than_a_metre_does_not_count():
    assert turn_deg(fly(Flight(speed_mps=(0.7, 0, 0)), 40)) is None, "14 images: 0.98 m"
    assert turn_deg(fly(Flight(speed_mps=(0.72, 0, 0)), 40)) is not None
    assert turn_deg(fly(Flight(speed_mps=(0.72, 0, 0)), 40, step=1)) is not None, "chained to 14, not to 13"
    assert turn_deg(fly(Flight(speed_mps=(0.7, 0, 0)), 40, step=1)) is None


def test_inconsistent_directions_correct_nothing():
    flight = Flight()

    def swinging(i, j):
        motion = flight.motion(i, j)
        turn = rotation_z(math.radians(35.0 if j % 2 else -35.0))
        return dataclasses.replace(motion, direction_from=turn @ motion.direction_from)

    assert turn_deg(fly(flight, 30, motion=swinging)) is None


def test_a_climb_corrects_nothing():
    assert turn_deg(fly(Flight(speed_mps=(0.2, 0.1, 2.0)), 30)) is None


def test_a_static_drone_has_no_direction():
    flight = Flight(speed_mps=(0.0, 0.0, 0.0))
    assert flight.motion(0, 14).direction_from is None
    assert turn_deg(fly(flight, 30)) is None


def test_without_vehicle_odometry_the_vehicle_is_assumed_to_stand():
    standing = Flight(vehicle_mps=0.0, vehicle_dps=0.0)
    assert turn_deg(fly(standing, 25, 90, vehicle=False)) == pytest.approx(-90, abs=1e-6)


def test_positions_are_interpolated_between_fixes_but_not_across_gaps():
    flight = Flight(vehicle_dps=0.0)
    assert turn_deg(fly(flight, 30, 90, fixes=range(0, 31, 4))) == pytest.approx(-90, abs=1e-6)
    assert turn_deg(fly(flight, 40, 90, fixes=range(0, 40, 6))) is None, "gaps of 0.6 s"
    assert turn_deg(fly(flight, 40, 90, fixes=())) is None


def test_a_pair_never_spans_two_tracks():
    """The track changes at image 18: the first whole pair is (18, 32), the seventh (24, 38)."""
    flight = Flight()

    def until(images):
        correction = fly(flight, images, 90, fixes=())
        for k in range(images):
            correction.add_fix(flight.fix(k, track_id=1 if k < 18 else 2))
        return turn_deg(correction)

    assert until(25) is None
    assert until(38) is None
    assert until(39) == pytest.approx(-90, abs=1e-6)


def test_pairs_of_a_wrong_rotation_are_dropped():
    flight = Flight()
    correction = fly(flight, 25, 90)
    assert turn_deg(correction) == pytest.approx(-90, abs=1e-6)
    correction.restart()
    assert turn_deg(correction) is None
    for k in range(25, 25 + 20):
        correction.add_vehicle(flight.vehicle(k))
        correction.add_fix(flight.fix(k))
        correction.add_image(flight.fix(k).stamp_ns, flight.R_vehicle_drone(k))
        correction.add_motion(flight.motion(k - 14, k))
    assert turn_deg(correction) is None, "six pairs begin after it"
    correction.add_vehicle(flight.vehicle(45))
    correction.add_fix(flight.fix(45))
    correction.add_image(flight.fix(45).stamp_ns, flight.R_vehicle_drone(45))
    correction.add_motion(flight.motion(31, 45))
    assert turn_deg(correction) == pytest.approx(0.0, abs=1e-6)


def test_a_motion_waits_a_limited_time_for_the_fix_after_it():
    flight = Flight()
    correction = fly(flight, 21, fixes=range(18))
    assert turn_deg(correction) is None
    for k in range(18, 21):
        correction.add_fix(flight.fix(k))
    assert turn_deg(correction) == pytest.approx(0.0, abs=1e-6)
    late = fly(flight, 21, fixes=range(18))
    late.add_image(flight.fix(40).stamp_ns, None)
    assert turn_deg(late) is None
    for k in range(18, 21):
        late.add_fix(flight.fix(k))
    assert turn_deg(late) is None, "given up"
