"""The vehicle's odometry gone, late or false: it carries every position from the vehicle's frame and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.fuse.motions import Motions
from stages.fuse.settings import FuseErrors
from stages.geometry import rotation_z
from stages.messages import PoseState, VehicleMotion
from tests.stages.fuse.flown import late, spoilt, without
from tests.stages.fuse.made_drone_flight import Made, ns, rms

FULL, COASTING = PoseState.FULL, PoseState.COASTING
DRIVES = {"vehicle_mps": 6.0, "vehicle_dps": 4.0}


def told(made, fault):
    stage, poses = Fuse(), []
    for _, port, message in fault(made.events()):
        poses += getattr(stage, f"on_{port}")(message)
    return poses


def drive(t, x=0.0, yaw=0.0):
    return VehicleMotion(
        stamp_ns=ns(t), xyz_start_m=np.array([6.0 * t + x, 0.0, 0.0]), R_start_vehicle=rotation_z(yaw), covariance=None
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_false_vehicle_poses_does_nothing(seed):
    made = Made(seed=seed, **DRIVES)
    seen = made.judge(told(made, spoilt(("motion",), 0.2, seed)), after_s=4)
    assert set(seen.states) == {FULL}
    assert seen.rmse_m() < 0.15
    assert max(seen.angle_deg) < 3


def test_after_words_that_were_left_out_a_false_one_is_still_no_way_a_vehicle_drives():
    """By pictures it tells its motion five times a second: the gap is long, and what it may have done in it is not."""
    for off in (drive(1.6, x=2.0), drive(1.6, yaw=0.7)):
        motions = Motions(FuseErrors(), parked=False)
        for t in (0.2, 0.4, 0.6, 0.8, 1.0):
            motions.hear_vehicle(drive(t))
        motions.hear_vehicle(off)
        np.testing.assert_allclose(motions.vehicle.at(ns(1.2))[1], (7.2, 0.0, 0.0), atol=1e-6)
        motions.hear_vehicle(drive(1.65))
        np.testing.assert_allclose(motions.vehicle.at(ns(1.65))[1], (9.9, 0.0, 0.0), atol=1e-6)


def test_a_late_vehicle_makes_the_relative_pose_less_sure_and_not_false():
    made = Made(until_s=15, **DRIVES)
    on_time, behind = (made.judge(told(made, late(("motion",), by_s)), after_s=4) for by_s in (0.0, 0.3))
    assert np.mean(np.array(behind.nees3) < 7.81) > 0.9
    assert rms(behind.sigma_m) > 1.5 * rms(on_time.sigma_m)
    assert behind.rmse_m() < 0.5


def test_a_vehicle_that_falls_silent_ends_full_and_is_taken_up_again():
    made = Made(until_s=16, **DRIVES)
    poses = told(made, without(("motion",), 6.0, 9.0))
    states = [(p.stamp_ns, p.state) for p in poses]
    assert not any(state in (FULL, COASTING) for at, state in states if ns(6.8) < at < ns(8.9))
    assert states[-1][1] is FULL
    seen = made.judge(poses, after_s=4)
    assert np.mean(np.array(seen.nees3) < 7.81) > 0.9
    assert max(seen.error_m) < 2.0


def test_one_pose_that_jumps_is_left_out_and_three_that_agree_are_a_new_start_frame():
    motions = Motions(FuseErrors(), parked=False)
    assert motions.hear_vehicle(drive(0.0))
    assert not any(motions.hear_vehicle(drive(0.02 * i)) for i in range(1, 20))
    assert not motions.hear_vehicle(drive(0.40, x=3.0))
    assert not motions.hear_vehicle(drive(0.42))
    assert motions.vehicle.at(ns(0.42))[1][0] == pytest.approx(6.0 * 0.42)
    assert not motions.hear_vehicle(drive(0.44, x=3.0, yaw=0.5))
    assert not motions.hear_vehicle(drive(0.46, x=3.0, yaw=0.5))
    assert motions.hear_vehicle(drive(0.47, x=3.0, yaw=0.5))
    assert not motions.hear_vehicle(drive(0.48, x=3.0, yaw=0.5))
    R, t = motions.vehicle.at(ns(0.48))
    assert t[0] == pytest.approx(6.0 * 0.48 + 3.0)
    assert math.atan2(R[1, 0], R[0, 0]) == pytest.approx(0.5)


def test_beyond_its_newest_word_a_vehicle_may_have_braked_and_turned():
    """a dt^2 / 2 each way, alpha dt^2 / 2 across; from 0.3 s on, where the trail ends, all its way."""
    motions, place = Motions(FuseErrors(), parked=False), np.array([3.0, 4.0, 12.0])
    for i in range(5):
        motions.hear_vehicle(drive(0.02 * i))
    assert not motions.vehicle_ahead_m2(ns(0.06), place)[0].any()
    shift_m, yaw_rad = 0.5 * 2.0 * 0.2**2, 0.5 * 0.2 * 0.2**2
    across = np.array([-4.0, 3.0, 0.0])
    covariance, yaw_rad2, lever = motions.vehicle_ahead_m2(ns(0.28), place)
    assert np.allclose(lever, across)
    assert yaw_rad2 == pytest.approx(yaw_rad**2)
    assert np.allclose(covariance, shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(across, across))
    later, _, _ = motions.vehicle_ahead_m2(ns(0.48), place)
    assert math.sqrt(later[2, 2]) == pytest.approx(0.5 * 2.0 * 0.4**2 + 6.0 * 0.1)


def test_a_vehicle_told_by_pictures_and_late_keeps_full():
    """Five times a second and 0.3 s late: its newest word is up to half a second old."""
    made = Made(until_s=15, **DRIVES)
    rare = [e for e in made.events() if e[1] != "motion" or round((e[2].stamp_ns - ns(0)) / 2e7) % 10 == 0]
    stage, poses = Fuse(), []
    for _, port, message in late(("motion",), 0.3)(rare):
        poses += getattr(stage, f"on_{port}")(message)
    seen = made.judge(poses, after_s=5)
    assert set(seen.states) <= {FULL, COASTING}
    assert np.mean(np.array(seen.nees3) < 7.81) > 0.9


def test_a_fix_waits_for_a_vehicle_that_is_late_and_not_for_one_that_is_gone():
    motions = Motions(FuseErrors(), parked=False)
    motions.hear_vehicle(drive(0.0))
    assert motions.must_wait(ns(0.3), ns(0.35))
    assert not motions.must_wait(ns(0.15), ns(0.35))
    assert not motions.must_wait(ns(0.3), ns(0.7))
    assert not motions.must_wait(ns(0.75), ns(0.8))
