"""Pointing of beams, checked by ray tracing, and the step of a search that covers all directions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.aim.beams import (
    low_discrepancy,
    rotor_azimuth_rad,
    servo_positions_rad,
    sweep_step_rad,
    table_angles_rad,
)
from stages.geometry.frames import Harmonic, LidarMount, Pose
from tests.stages.caster import beams_vehicle
from tests.stages.made import ELEVATION_RAD, ON_ITS_SIDE

TRAVEL_RAD = (0.0, math.pi)
ASKEW = LidarMount(
    T_vehicle_turntable=Pose(xyz_m=(0.3, -0.2, 0.5), rpy_deg=(2.0, -3.0, 40.0)),
    T_turntable_lidar=Pose(xyz_m=(0.03, 0.02, 0.1), rpy_deg=(88.0, 1.0, -2.0)),
    servo_sign=-1,
    servo_zero_deg=-170.0,
    servo_harmonics=(
        Harmonic(order=1, amplitude_deg=0.8, phase_deg=20.0),
        Harmonic(order=2, amplitude_deg=0.3, phase_deg=-70.0),
    ),
)
MOUNTS = {"on its side": ON_ITS_SIDE, "askew, with sign, zero and harmonics": ASKEW}


def p_turntable(mount, p_vehicle_m):
    T = mount.T_vehicle_turntable.matrix()
    return T[:3, :3].T @ (np.asarray(p_vehicle_m) - T[:3, 3])


def missed_by_rad(mount, servo_rad, azimuth_rad, elevation_rad, p_vehicle_m):
    """Angle between a beam, for a servo position, and the line of sight to a position."""
    beam = np.array(
        [
            math.cos(elevation_rad) * math.sin(azimuth_rad),
            math.cos(elevation_rad) * math.cos(azimuth_rad),
            math.sin(elevation_rad),
        ]
    )
    origin_m, direction = beams_vehicle(mount, np.array([servo_rad]), beam[np.newaxis])
    line = np.asarray(p_vehicle_m) - origin_m[0]
    return math.atan2(np.linalg.norm(np.cross(direction[0], line)), float(direction[0] @ line))


def positions(n, seed=0, nearest_m=4.0):
    rng = np.random.default_rng(seed)
    up = rng.normal(size=(n, 3))
    up[:, 2] = np.abs(up[:, 2]) + 0.05
    return up / np.linalg.norm(up, axis=1, keepdims=True) * rng.uniform(nearest_m, 50.0, (n, 1))


@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
def test_the_ray_of_the_chosen_beam_meets_the_position(mount):
    T_tl, met = mount.T_turntable_lidar.matrix(), 0
    for p_vehicle_m in positions(40):
        p = p_turntable(mount, p_vehicle_m)
        for elevation in ELEVATION_RAD:
            for theta in table_angles_rad(T_tl, p, elevation):
                azimuth = rotor_azimuth_rad(T_tl, p, theta)
                for servo_rad in servo_positions_rad(mount, theta, (-math.tau, math.tau)):
                    missed_m = missed_by_rad(mount, servo_rad, azimuth, elevation, p_vehicle_m) * np.linalg.norm(
                        p_vehicle_m
                    )
                    assert missed_m < 0.01
                    met += 1
    assert met > 1000


def test_within_half_a_turn_a_beam_meets_any_position_except_near_the_axis():
    """The elevations are odd degrees: the beams of 1 deg reach to within 1 deg of the axis."""
    T_tl = ON_ITS_SIDE.T_turntable_lidar.matrix()
    for off_deg, azimuth_deg in [(1.05, 10.0), (1.05, 100.0), (3.0, 200.0), (20.0, 300.0), (89.0, 45.0)]:
        off, azimuth = math.radians(off_deg), math.radians(azimuth_deg)
        level = math.sin(off)
        p = np.array([0, 0, 0.1]) + 30.0 * np.array(
            [level * math.cos(azimuth), level * math.sin(azimuth), math.cos(off)]
        )
        found = [
            servo_rad
            for elevation in ELEVATION_RAD
            for theta in table_angles_rad(T_tl, p, elevation)
            for servo_rad in servo_positions_rad(ON_ITS_SIDE, theta, TRAVEL_RAD)
        ]
        assert found, (off_deg, azimuth_deg)
        assert all(0.0 <= servo_rad <= math.pi for servo_rad in found)
    near_axis = np.array([0, 0, 0.1]) + 30.0 * np.array([math.sin(math.radians(0.95)), 0, math.cos(math.radians(0.95))])
    assert not any(table_angles_rad(T_tl, near_axis, elevation) for elevation in ELEVATION_RAD)
    assert table_angles_rad(T_tl, np.array([0, 0, 30.0]), 0.0) == ()  # on the axis no angle is better than another


def test_a_beam_of_elevation_0_lies_in_the_scan_plane():
    found = table_angles_rad(ON_ITS_SIDE.T_turntable_lidar.matrix(), np.array([10.0, 10.0, 5.0]), 0.0)
    assert sorted(found) == pytest.approx([math.radians(45), math.radians(225)])


@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
def test_servo_positions_invert_sign_zero_and_harmonics_and_stay_within_the_travel(mount):
    for theta in np.linspace(0.0, math.tau, 50, endpoint=False):
        found = servo_positions_rad(mount, float(theta), (0.0, math.tau))
        assert 1 <= len(found) <= 2
        for servo_rad in found:
            assert 0.0 <= servo_rad <= math.tau
            turned = float(mount.turntable_rad(np.array([servo_rad]))[0])
            assert math.remainder(turned - theta, math.tau) == pytest.approx(0.0, abs=1e-5)
    assert servo_positions_rad(ON_ITS_SIDE, 1.5 * math.pi, TRAVEL_RAD) == []
    assert servo_positions_rad(ON_ITS_SIDE, -math.pi, TRAVEL_RAD) == [pytest.approx(math.pi)]


def test_the_rotor_azimuth_is_measured_from_the_lidars_y_axis():
    """Azimuth 0 is +y_lidar, growing towards +x_lidar; on its side the LiDAR has +y_lidar up and +x_lidar ahead."""
    T_tl = ON_ITS_SIDE.T_turntable_lidar.matrix()
    assert rotor_azimuth_rad(T_tl, np.array([0.0, 0.0, 20.0]), 0.3) == pytest.approx(0.0, abs=1e-12)
    assert rotor_azimuth_rad(T_tl, np.array([20.0, 0.0, 0.1]), 0.0) == pytest.approx(math.pi / 2)
    assert rotor_azimuth_rad(T_tl, np.array([20.0, 0.0, 0.1]), math.pi) == pytest.approx(3 * math.pi / 2)


def test_each_prefix_of_the_offset_sequence_fills_its_range_evenly():
    members = [low_discrepancy(k) for k in range(64)]
    assert members[:4] == [0.0, -0.5, 0.5, -0.75]
    assert len(set(members)) == 64
    for n in range(1, 65):
        gaps = np.diff(np.sort([-1.0, *members[:n], 1.0]))
        assert gaps.max() <= 4.0 / (n + 1)


def largest_gap(step_rad, turns=50):
    """Largest gap between observed directions that the whole fan has passed, in beam spacings."""
    directions = np.sort((np.arange(turns)[:, np.newaxis] * step_rad + ELEVATION_RAD).ravel())
    inside = directions[
        (directions > ELEVATION_RAD.max()) & (directions < (turns - 1) * step_rad + ELEVATION_RAD.min())
    ]
    return float(np.diff(inside).max()) / math.radians(2.0)


@pytest.mark.parametrize("wanted_deg", [0.3, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0])
def test_the_search_step_avoids_aliasing_of_rotor_and_servo(wanted_deg):
    spacing = math.radians(2.0)
    step = sweep_step_rad(spacing, math.radians(wanted_deg))
    assert abs(step - math.radians(wanted_deg)) <= spacing  # about the requested speed
    assert largest_gap(step) < 0.7
    if wanted_deg % 2 == 0:
        assert largest_gap(math.radians(wanted_deg)) > 0.99  # the unadjusted step repeats the same directions


def test_the_search_step_of_a_slow_table_spreads_over_the_whole_spacing():
    step = sweep_step_rad(math.radians(2.0), math.radians(1.2))
    assert largest_gap(step) < 0.15
