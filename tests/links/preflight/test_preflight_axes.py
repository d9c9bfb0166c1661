"""Axes and signs by artificial motions: agreeing, swapped, reflected, and without enough motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.preflight.axes import compare, compare_paths
from links.preflight.check_result import Level
from links.preflight.hand_motion import MOTIONS, check_motion
from links.preflight.motion_checks import (
    gravity_check,
    heading_check,
    motion_checks,
    path_check,
    turning_check,
    velocity_check,
)
from links.preflight.observations import Observations
from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.messages import DroneAttitude, DroneFix, DroneImu, DroneLocalPosition, DroneOdometry, VehicleMotion

RNG = np.random.default_rng(7)
S = 1_000_000_000


def some(n=200):
    t = np.linspace(0, 6, n)
    return np.stack([np.sin(t), np.cos(1.7 * t), 0.8 * np.sin(2.3 * t)], axis=1)


def test_equal_vectors_agree_along_every_axis_and_noise_does_not_matter():
    a = some()
    found = compare(a, a + 0.1 * RNG.standard_normal(a.shape), 0.1)
    assert (found.compared, found.wrong, found.permutation) == ("xyz", "", None)


@pytest.mark.parametrize(
    ("permutation", "wrong", "expected_text"),
    [
        (np.diag([1.0, 1.0, -1.0]), "z", "z is measured as -z"),
        (np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, 1]]), "xy", "x is measured as y, y is measured as x"),
        (np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]), "xy", "x is measured as -y, y is measured as x"),
        (np.array([[0, 0, 1.0], [0, 1, 0], [1, 0, 0]]), "xz", "x is measured as z, z is measured as x"),
    ],
)
def test_a_permutation_of_axes_is_reported(permutation, wrong, expected_text):
    a = some()
    found = compare(a, a @ permutation.T, 0.1)
    assert (found.wrong, found.permutation) == (wrong, expected_text)


def test_a_small_motion_along_one_axis_is_compared_on_its_own():
    a = some() * [5.0, 5.0, 0.3]
    assert compare(a, a * [1, 1, -1], 0.1).wrong == "z"
    assert compare(a, a * [1, 1, -1], 0.5).wrong == ""
    assert compare(a, a * [1, 1, -1], 0.5).compared == "xy"


def test_unrelated_motions_fit_no_permutation():
    found = compare(some(), RNG.standard_normal((200, 3)), 0.1)
    assert (found.wrong, found.permutation) == ("xyz", None)


def test_paths_may_differ_by_translation_and_yaw_but_not_by_a_reflection():
    a = some()
    for yaw_rad in (0.0, 1.0, 2.9, -1.6):
        b = a @ rotation_z(yaw_rad).T + [10.0, -4.0, 2.0]
        assert compare_paths(a, b, 0.1).wrong == ""
        reflected = compare_paths(a, b * [1, -1, 1], 0.1)
        assert "x" in reflected.wrong or "y" in reflected.wrong
        assert reflected.permutation is not None
    assert compare_paths(a, a * [1, 1, -1], 0.1).permutation == "z is measured as -z"


def test_a_straight_line_does_not_distinguish_left_from_right():
    line = np.outer(np.linspace(0, 4, 50), [1.0, 0.5, 0.0])
    found = compare_paths(line, line * [1, -1, 1], 0.2)
    assert (found.compared, found.wrong) == ("", "")


def attitude(stamp_ns, rotation):
    return DroneAttitude(stamp_ns=stamp_ns, R_odom_drone=rotation, angular_velocity_drone_radps=np.zeros(3))


def fix(stamp_ns, xyz_m):
    return DroneFix(stamp_ns=stamp_ns, xyz_vehicle_m=xyz_m, covariance_m2=np.eye(3), hits=9)


def attitudes(seconds=6.0, rates_of=lambda w: w, rate_hz=50):
    """Attitudes of a drone that is rotated about all axes."""
    made = []
    for k in range(int(seconds * rate_hz)):
        t, dt = k / rate_hz, 1e-4
        rotation, later = (
            rotation_from_rpy_deg((25 * math.sin(2 * u), 20 * math.sin(1.5 * u + 1), 40 * math.sin(u)))
            for u in (t, t + dt)
        )
        turn = rotation.T @ later
        rates = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (2 * dt)
        made.append(
            DroneAttitude(stamp_ns=round(t * S), R_odom_drone=rotation, angular_velocity_drone_radps=rates_of(rates))
        )
    return made


def imu_of(poses, permutation=None):
    permutation = np.eye(3) if permutation is None else permutation
    return [
        DroneImu(
            stamp_ns=p.stamp_ns + 1_000_000,
            acceleration_drone_mps2=permutation @ p.R_odom_drone.T @ [0, 0, 9.81],
            angular_velocity_drone_radps=permutation @ p.angular_velocity_drone_radps,
        )
        for p in poses
    ]


def test_an_accelerometer_is_compared_with_the_attitudes_vertical():
    poses = attitudes()
    good = gravity_check(poses, imu_of(poses))
    assert good.level is Level.OK
    assert "along x, y, z" in good.sentence
    down = gravity_check(poses, imu_of(poses, np.diag([1.0, -1.0, -1.0])))
    assert down.level is Level.FAIL
    assert "y is measured as -y, z is measured as -z" in down.sentence
    swapped = gravity_check(poses, imu_of(poses, np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]])))
    assert swapped.level is Level.FAIL
    assert "x is measured as -y, y is measured as x" in swapped.sentence
    assert gravity_check(poses, []).level is Level.WARNING


def test_angular_velocities_are_compared_with_the_attitudes_changes():
    poses = attitudes()
    assert turning_check("gyro", poses, poses).level is Level.OK
    flipped = turning_check("gyro", poses, imu_of(poses, np.diag([1.0, 1.0, -1.0])))
    assert flipped.level is Level.FAIL
    assert "along z; z is measured as -z" in flipped.sentence
    still = [attitude(k * S // 50, np.eye(3)) for k in range(300)]
    assert turning_check("gyro", still, still).level is Level.WARNING


def odometry(turn=None, back=1.0):
    turn = np.eye(3) if turn is None else turn
    made = []
    for pose in attitudes():
        t = pose.stamp_ns / S
        velocity = np.array([-2 * math.sin(t), 2 * math.cos(t), 0.6 * math.cos(2 * t)])
        made.append(
            DroneOdometry(
                stamp_ns=pose.stamp_ns,
                xyz_odom_m=np.array([2 * math.cos(t), 2 * math.sin(t), 0.3 * math.sin(2 * t)]),
                R_odom_drone=turn @ pose.R_odom_drone,
                velocity_drone_mps=back * (turn @ pose.R_odom_drone).T @ velocity,
                angular_velocity_drone_radps=pose.angular_velocity_drone_radps,
                pose_covariance=None,
                velocity_covariance=None,
                reset_counter=0,
                quality_percent=None,
            )
        )
    return made


def test_odometry_is_compared_with_the_attitude_and_with_itself():
    assert heading_check(attitudes(), odometry()).level is Level.OK
    turned = heading_check(attitudes(), odometry(turn=rotation_z(math.pi / 2)))
    assert turned.level is Level.FAIL
    assert "90 deg from ATTITUDE's" in turned.sentence
    assert heading_check([], odometry()).level is Level.WARNING
    assert velocity_check(odometry()).level is Level.OK
    assert velocity_check(odometry(back=-1.0)).level is Level.FAIL


def path(permutation=None, at=lambda t: np.zeros(3)):
    permutation = np.eye(3) if permutation is None else permutation
    fixes, positions = [], []
    for k in range(120):
        t = k / 20
        xyz = np.array([2 * math.cos(t), 2 * math.sin(t), 6 + math.sin(0.5 * t)])
        local = permutation @ (rotation_z(0.7) @ xyz + [3, 4, 0])
        fixes.append(fix(round(t * S), xyz - at(t)))
        positions.append(
            DroneLocalPosition(stamp_ns=round(t * S) + 10_000_000, xyz_odom_m=local, velocity_odom_mps=np.zeros(3))
        )
    return fixes, positions


def test_the_lidars_path_is_compared_with_the_autopilots():
    good = path_check(path()[0], [], path()[1])
    assert good.level is Level.OK
    assert "along x, y, z" in good.sentence
    fixes, positions = path(np.diag([1.0, 1.0, -1.0]))
    assert "z is measured as -z" in path_check(fixes, [], positions).sentence
    fixes, positions = path(np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, 1]]))
    assert path_check(fixes, [], positions).level is Level.FAIL
    assert path_check([], [], positions).level is Level.WARNING
    assert "120 LiDAR fixes, 0 with a position" in path_check(fixes, [], []).sentence


def test_a_vehicle_that_drives_needs_its_odometry():
    fixes, positions = path(at=lambda t: np.array([2.0 * t, 0, 0]))
    without = path_check(fixes, [], positions)
    assert without.level is Level.FAIL
    assert "was the vehicle parked" in without.sentence
    motions = [
        VehicleMotion(
            stamp_ns=f.stamp_ns,
            xyz_map_m=np.array([2.0 * f.stamp_ns / S, 0, 0]),
            R_map_vehicle=np.eye(3),
            covariance=None,
        )
        for f in fixes
    ]
    assert path_check(fixes, motions, positions).level is Level.OK


def test_without_messages_everything_is_reported_as_not_checked():
    found = list(motion_checks(Observations((), {}, live=True)))
    assert found
    assert {v.level for v in found} == {Level.WARNING}
    assert all("not checked" in v.sentence for v in found)


def held(roll=0.0, pitch=0.0, yaw=0.0, frame=None):
    """Rotated forth and back within a step; `frame`: the autopilot's body against the true one."""
    frame = np.eye(3) if frame is None else frame
    shares = np.sin(np.linspace(0, math.pi, 30))
    return [
        attitude(k * S // 50, rotation_from_rpy_deg((s * roll, s * pitch, 170 + s * yaw)) @ frame)
        for k, s in enumerate(shares)
    ]


TURNS = {"nose down": {"pitch": 30}, "right side down": {"roll": 30}, "turn left": {"yaw": 80}}


@pytest.mark.parametrize("step", [s for s in MOTIONS if s.measure], ids=lambda s: s.name)
def test_a_hand_motion_is_measured_with_its_sign(step):
    turn = TURNS[step.name]
    assert check_motion(step, held(**turn)).level is Level.OK
    opposite = check_motion(step, held(**{axis: -angle for axis, angle in turn.items()}))
    assert opposite.level is Level.FAIL
    assert "the opposite" in opposite.sentence
    assert "no such motion" in check_motion(step, held()).sentence
    assert check_motion(step, []).level is Level.FAIL
    other = next(s.name for s in MOTIONS if s is not step)
    assert f"'{other}'" in check_motion(step, held(**TURNS[other])).sentence


def test_an_autopilot_mounted_with_90_deg_yaw_is_found_by_hand_motions_only():
    nose, right_side = MOTIONS[0], MOTIONS[1]
    yaw_90 = rotation_z(math.pi / 2)
    assert "'right side down'" in check_motion(nose, held(pitch=30, frame=yaw_90)).sentence
    assert "'nose down'" in check_motion(right_side, held(roll=30, frame=yaw_90)).sentence
