"""The vehicle's odometry missing, late or false: every position is transformed by it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.fuse.motion_model import Motions
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import rotation_z
from stages.messages import PoseState, VehicleMotion
from tests.stages.fuse.flown import late, outliers, without
from tests.stages.fuse.made_drone_flight import Made, ns, rms
from tests.stages.fuse.test_fuse_flight import wrong

FULL, COASTING = PoseState.FULL, PoseState.COASTING
DRIVES = {"vehicle_mps": 6.0, "vehicle_dps": 4.0}


def fused(made, fault):
    stage, poses = Fuse(), []
    for _, port, message in fault(made.events()):
        poses += getattr(stage, f"on_{port}")(message)
    return poses


def drive(t, x=0.0, yaw=0.0):
    return VehicleMotion(
        stamp_ns=ns(t), xyz_map_m=np.array([6.0 * t + x, 0.0, 0.0]), R_map_vehicle=rotation_z(yaw), covariance=None
    )


@pytest.mark.parametrize("seed", range(3))
def test_20_percent_of_false_vehicle_poses_have_no_effect(seed):
    made = Made(seed=seed, **DRIVES)
    seen = made.judge(fused(made, outliers(("motion",), 0.2, seed)), after_s=4)
    assert set(seen.states) == {FULL}
    assert seen.rmse_m() < 0.15
    assert max(seen.angle_deg) < 3


def test_after_missing_poses_a_false_one_is_still_rejected():
    """Visual odometry has five poses per second: the gaps are long, but the possible motion in them is bounded."""
    for off in (drive(1.6, x=2.0), drive(1.6, yaw=0.7)):
        motions = Motions(FuseErrors(), parked=False)
        for t in (0.2, 0.4, 0.6, 0.8, 1.0):
            motions.add_vehicle_motion(drive(t))
        motions.add_vehicle_motion(off)
        np.testing.assert_allclose(motions.vehicle.at(ns(1.2))[1], (7.2, 0.0, 0.0), atol=1e-6)
        motions.add_vehicle_motion(drive(1.65))
        np.testing.assert_allclose(motions.vehicle.at(ns(1.65))[1], (9.9, 0.0, 0.0), atol=1e-6)


def test_late_vehicle_motion_increases_the_covariance_but_not_the_error():
    made = Made(until_s=15, **DRIVES)
    on_time, behind = (made.judge(fused(made, late(("motion",), by_s)), after_s=4) for by_s in (0.0, 0.3))
    assert np.mean(np.array(behind.nees3) < 7.81) > 0.9
    assert rms(behind.sigma_m) > 1.5 * rms(on_time.sigma_m)
    assert behind.rmse_m() < 0.5


def test_missing_vehicle_motion_ends_full_until_it_returns():
    made = Made(until_s=16, **DRIVES)
    poses = fused(made, without(("motion",), 6.0, 9.0))
    states = [(p.stamp_ns, p.state) for p in poses]
    assert not any(state in (FULL, COASTING) for at, state in states if ns(6.8) < at < ns(8.9))
    assert states[-1][1] is FULL
    seen = made.judge(poses, after_s=4)
    assert np.mean(np.array(seen.nees3) < 7.81) > 0.9
    assert max(seen.error_m) < 2.0


@pytest.mark.parametrize("seed", range(3))
def test_the_direction_over_ground_is_not_used_without_vehicle_motion(seed):
    """Its camera measures the direction over ground; relative to a vehicle at 6 m/s it may be at rest."""
    made = Made(until_s=11, seed=seed, images=True, vehicle_mps=6.0)
    poses = fused(made, without(("motion",), 6.0, 10.0))
    seen = made.judge([p for p in poses if ns(7.0) < p.stamp_ns < ns(9.9)])
    assert len(seen.error_m) > 90
    assert max(seen.error_m) < 0.5
    assert np.mean(np.array(seen.nees3) < 7.81) > 0.9


def test_one_jumping_pose_is_rejected_and_three_consistent_ones_are_a_new_map_frame():
    motions = Motions(FuseErrors(), parked=False)
    assert motions.add_vehicle_motion(drive(0.0))
    assert not any(motions.add_vehicle_motion(drive(0.02 * i)) for i in range(1, 20))
    assert not motions.add_vehicle_motion(drive(0.40, x=3.0))
    assert not motions.add_vehicle_motion(drive(0.42))
    assert motions.vehicle.at(ns(0.42))[1][0] == pytest.approx(6.0 * 0.42)
    assert not motions.add_vehicle_motion(drive(0.44, x=3.0, yaw=0.5))
    assert not motions.add_vehicle_motion(drive(0.46, x=3.0, yaw=0.5))
    assert motions.add_vehicle_motion(drive(0.47, x=3.0, yaw=0.5))
    assert not motions.add_vehicle_motion(drive(0.48, x=3.0, yaw=0.5))
    R, t = motions.vehicle.at(ns(0.48))
    assert t[0] == pytest.approx(6.0 * 0.48 + 3.0)
    assert math.atan2(R[1, 0], R[0, 0]) == pytest.approx(0.5)


def jumped(from_s, deg=115.0, hz=50, silent_s=0.0):
    """Events with another map frame from a time on, optionally after a gap."""
    R = rotation_z(math.radians(deg))

    def fault(events):
        for at_ns, port, message in events:
            if port == "motion" and message.stamp_ns >= ns(from_s):
                xyz_m = R @ message.xyz_map_m + np.array([200.0, 0.0, 0.0])
                message = dataclasses.replace(message, xyz_map_m=xyz_m, R_map_vehicle=R @ message.R_map_vehicle)
            left_out = round((message.stamp_ns - ns(0)) / 2e7) % (50 // hz) or ns(0) <= message.stamp_ns - round(
                from_s * 1e9
            ) < ns(silent_s)
            if port != "motion" or not left_out:
                yield at_ns, port, message

    return fault


@pytest.mark.parametrize(("hz", "silent_s"), [(50, 0.0), (5, 0.0), (50, 1.5)])
@pytest.mark.parametrize("vehicle_mps", [0.0, 6.0, 15.0])
def test_a_jump_of_the_map_frame_drops_the_rotation_but_not_the_position(vehicle_mps, hz, silent_s):
    made = Made(until_s=13, vehicle_mps=vehicle_mps, vehicle_dps=4.0)
    poses = fused(made, jumped(8.0, hz=hz, silent_s=silent_s))
    assert not wrong(made, poses)
    seen = made.judge([p for p in poses if p.xyz_vehicle_m is not None], after_s=5)
    off, sigma = np.array(seen.error_m), np.array(seen.sigma_m)
    assert np.mean(off > 0.5 + 3.0 * sigma) < 0.01
    assert poses[-1].state is FULL


@pytest.mark.parametrize("deg", [90.0, 180.0, 60.0])
def test_a_jump_of_the_map_frame_while_the_drone_is_lost_drops_the_heading(deg):
    made = Made(until_s=20, vehicle_mps=6.0, gaps_s={"fix": (5.0, 15.0), "rotation": (5.0, 30.0)})
    poses = fused(made, jumped(14.0, deg))
    assert any(p.state is PoseState.LOST for p in poses if p.stamp_ns > ns(13.0))
    assert not wrong(made, poses)


def test_odometry_in_large_map_coordinates_works():
    made, far_m = Made(until_s=10, **DRIVES), np.array([5e5, 5.2e6, 100.0])
    stage, poses = Fuse(), []
    for _, port, message in made.events():
        if port == "motion":
            message = dataclasses.replace(message, xyz_map_m=message.xyz_map_m + far_m)
        poses += getattr(stage, f"on_{port}")(message)
    assert stage.recoveries == 0
    near, far = (made.judge(p, after_s=4) for p in (made.run(Fuse()), poses))
    assert far.rmse_m() == pytest.approx(near.rmse_m(), rel=0.01)


def test_beyond_its_newest_pose_a_vehicle_may_have_braked_and_turned():
    """a dt^2 / 2 each way, alpha dt^2 / 2 across; from 0.3 s on, where the trajectory ends, its whole displacement."""
    motions, place = Motions(FuseErrors(), parked=False), np.array([3.0, 4.0, 12.0])
    for i in range(5):
        motions.add_vehicle_motion(drive(0.02 * i))
    assert not motions.vehicle_covariance_m2(ns(0.06), place)[0].any()
    shift_m, yaw_rad = 0.5 * 2.0 * 0.2**2, 0.5 * 0.2 * 0.2**2
    across = np.array([-4.0, 3.0, 0.0])
    covariance, yaw_rad2, lever = motions.vehicle_covariance_m2(ns(0.28), place)
    assert np.allclose(lever, across)
    assert yaw_rad2 == pytest.approx(yaw_rad**2)
    assert np.allclose(covariance, shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(across, across))
    later, _, _ = motions.vehicle_covariance_m2(ns(0.48), place)
    assert math.sqrt(later[2, 2]) == pytest.approx(0.5 * 2.0 * 0.4**2 + 6.0 * 0.1)


def test_late_visual_odometry_of_the_vehicle_keeps_full():
    """Five times a second and 0.3 s late: its newest pose is up to half a second old."""
    made = Made(until_s=15, **DRIVES)
    rare = [e for e in made.events() if e[1] != "motion" or round((e[2].stamp_ns - ns(0)) / 2e7) % 10 == 0]
    stage, poses = Fuse(), []
    for _, port, message in late(("motion",), 0.3)(rare):
        poses += getattr(stage, f"on_{port}")(message)
    seen = made.judge(poses, after_s=5)
    assert set(seen.states) <= {FULL, COASTING}
    assert np.mean(np.array(seen.nees3) < 7.81) > 0.9


def test_a_fix_waits_for_late_vehicle_motion_but_not_for_missing_one():
    motions = Motions(FuseErrors(), parked=False)
    motions.add_vehicle_motion(drive(0.0))
    assert motions.must_wait(ns(0.3), ns(0.35))
    assert not motions.must_wait(ns(0.15), ns(0.35))
    assert not motions.must_wait(ns(0.3), ns(0.7))
    assert not motions.must_wait(ns(0.75), ns(0.8))
