"""Motion of the drone per IMU interval: means, segments, noise, the vertical, and the autopilot while independent."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from flow.message import check_arrays
from stages.geometry.frames import rotation_z
from stages.messages import DroneMotion
from stages.odometry.drone import InertialMotion
from tests.stages.odometry.drone.made_imu import (
    R_odom_drone,
    attitude,
    imu,
    local_position,
    odometry,
    position,
    stamp,
    tilt,
    velocity,
)


def motion(stage: InertialMotion, at_ms: float, **changes) -> DroneMotion:
    made = stage.on_imu(imu(at_ms, **changes))
    assert made is not None
    return made


def test_an_interval_has_the_mean_of_its_two_samples():
    stage = InertialMotion()
    zeros = {"acceleration_drone_mps2": np.array([0.0, 1, 9]), "angular_velocity_drone_radps": np.zeros(3)}
    ones = {"acceleration_drone_mps2": np.array([2.0, 1, 10]), "angular_velocity_drone_radps": np.array([0.2, 0, -1])}
    assert stage.on_imu(imu(0, **zeros)) is None
    made = motion(stage, 20, **ones)
    check_arrays(made)
    assert (made.start_ns, made.stamp_ns, made.segment) == (stamp(0), stamp(20), 0)
    np.testing.assert_allclose(made.specific_force_drone_mps2, [1, 1, 9.5])
    np.testing.assert_allclose(made.angular_velocity_drone_radps, [0.1, 0, -0.5])
    assert (made.up_drone, made.autopilot) == (None, None)


def test_the_intervals_of_a_segment_follow_each_other_and_a_gap_begins_a_new_one():
    stage = InertialMotion(longest_gap_s=0.25)
    times = [0, 20, 41, 60, 300, 320, 570.1, 590, 610]  # gaps of 240 and 250.1 ms
    made = [m for t in times if (m := stage.on_imu(imu(t)))]
    assert [m.segment for m in made] == [0, 0, 0, 0, 0, 1, 1]
    for before, after in pairwise(made):
        assert (before.stamp_ns == after.start_ns) == (before.segment == after.segment)
    assert stage.counters["segments"] == 2


def test_repeated_and_late_samples_are_dropped_and_a_clock_that_was_set_back_begins_a_segment():
    stage = InertialMotion()
    stage.on_imu(imu(0))
    assert motion(stage, 20).segment == 0
    assert stage.on_imu(imu(20)) is None
    assert stage.on_imu(imu(15)) is None
    again = motion(stage, 40)
    assert (again.start_ns, again.segment) == (stamp(20), 0)
    assert stage.counters["repeated or late samples"] == 2
    assert stage.on_imu(imu(-60_000)) is None
    rebooted = motion(stage, -59_980)
    assert (rebooted.start_ns, rebooted.segment) == (stamp(-60_000), 1)


def test_the_density_is_the_sample_noise_times_the_root_of_the_interval():
    stage, rng = InertialMotion(), np.random.default_rng(1)
    for i in range(500):
        made = stage.on_imu(
            imu(
                20 * i,
                acceleration_drone_mps2=np.array([0, 0, 9.8]) + rng.normal(0, 0.5, 3),
                angular_velocity_drone_radps=rng.normal(0, 0.01, 3),
            )
        )
    assert made is not None
    np.testing.assert_allclose(made.specific_force_noise, 0.5 * np.sqrt(0.02), rtol=0.25)
    np.testing.assert_allclose(made.angular_velocity_noise, 0.01 * np.sqrt(0.02), rtol=0.25)


def test_the_noise_is_never_below_that_of_a_sensor_and_has_a_default_before_it_is_estimated():
    stage, still = InertialMotion(), {"angular_velocity_drone_radps": np.zeros(3)}
    stage.on_imu(imu(0, **still))
    np.testing.assert_allclose(motion(stage, 20, **still).specific_force_noise, 0.35 * np.sqrt(0.02))
    for i in range(2, 200):
        made = motion(stage, 20 * i, **still)
    assert made.specific_force_noise.tolist() == [0.004] * 3
    assert made.angular_velocity_noise.tolist() == [9e-5] * 3


@pytest.mark.parametrize(("hz", "tone_hz"), [(50, 51.2), (50, 98.4), (25, 101.0), (10, 90.9), (10, 81.5)])
def test_a_tone_of_the_rotors_that_is_aliased_to_slow_motion_is_noise_of_the_specific_force(hz: int, tone_hz: float):
    """0.3 m/s^2 RMS; all of it is between 0.75 and 2.5 Hz in the samples, which has the density 0.3 / sqrt(2 x 1.75)."""
    stage, rng = InertialMotion(), np.random.default_rng(3)
    for i in range(20 * hz):
        tone = 0.3 * np.sqrt(2) * np.sin(2 * np.pi * tone_hz * i / hz + np.array([0.0, 1.0, 2.0]))
        force = np.array([0, 0, 9.8]) + tone + rng.normal(0, 0.03, 3)
        made = stage.on_imu(imu(1000 * i / hz, acceleration_drone_mps2=force, angular_velocity_drone_radps=np.zeros(3)))
    assert made is not None
    assert made.specific_force_noise.min() > 0.6 * 0.3 / np.sqrt(3.5)
    assert made.specific_force_noise.max() < 1.6 * 0.3 / np.sqrt(3.5)
    assert made.angular_velocity_noise.max() < 0.001, "a turn rate at these frequencies is motion"


def test_a_fast_tone_of_the_rotors_averages_out():
    """0.3 m/s^2 RMS at 83 Hz, in samples at 50 Hz 17 Hz: as white noise it would have the density 0.042."""
    stage = InertialMotion()
    for i in range(1000):
        tone = 0.3 * np.sqrt(2) * np.sin(2 * np.pi * 83.0 * i / 50 + np.array([0.0, 1.0, 2.0]))
        made = stage.on_imu(imu(20 * i, acceleration_drone_mps2=np.array([0, 0, 9.8]) + tone))
    assert made is not None
    assert made.specific_force_noise.max() < 0.025


def test_a_turn_is_as_uncertain_as_the_scale_of_the_gyro_and_a_wobble_is_not():
    """A turn by 1.6 rad in 4 s, alone and back again, and a wobble of +-0.13 rad for 12 s."""
    rates = {
        "turn": np.where(np.arange(600) < 200, 0.4, 0.0),
        "back": np.where(np.arange(600) < 200, 0.4, np.where(np.arange(600) < 400, -0.4, 0.0)),
        "wobble": 0.4 * np.sin(2 * np.pi * 0.5 * 0.02 * np.arange(600)),
    }
    sigma_rad = {}
    for name, rate in rates.items():
        stage = InertialMotion(gyro_scale=0.015)
        made = [stage.on_imu(imu(20 * i, angular_velocity_drone_radps=np.array([0, 0, w]))) for i, w in enumerate(rate)]
        sigma_rad[name] = np.sqrt(sum(0.02 * m.angular_velocity_noise[2] ** 2 for m in made if m))
    assert sigma_rad["turn"] == pytest.approx(0.015 * 1.6, rel=0.15)
    assert sigma_rad["back"] == pytest.approx(sigma_rad["turn"], rel=0.15)
    assert sigma_rad["wobble"] < 0.5 * sigma_rad["turn"]


def test_up_is_the_autopilots_vertical_at_the_end_of_the_interval():
    stage = InertialMotion()
    stage.on_tilt(tilt(0))
    stage.on_imu(imu(0))
    up = motion(stage, 100).up_drone
    assert up is not None
    np.testing.assert_allclose(up, R_odom_drone(100).T @ [0, 0, 1], atol=1e-9)
    for at_ms in range(120, 400, 20):
        made = motion(stage, at_ms)
    assert made.up_drone is None, "the vertical is older than 0.25 s"


@pytest.mark.parametrize("source", ["messages", "odometry"])
def test_an_independent_autopilot_estimate_is_propagated_to_the_end_of_the_interval(source: str):
    stage = InertialMotion()
    for at_ms in (0, 80):
        if source == "odometry":
            stage.on_odometry(odometry(at_ms))
        else:
            stage.on_attitude(attitude(at_ms))
            stage.on_position(local_position(at_ms))
    stage.on_imu(imu(100))
    made = motion(stage, 120)
    check_arrays(made)
    assert made.autopilot is not None
    np.testing.assert_allclose(made.autopilot.R_odom_drone, R_odom_drone(120), atol=1e-9)
    np.testing.assert_allclose(made.autopilot.velocity_odom_mps, velocity(120), atol=1e-3)
    np.testing.assert_allclose(made.autopilot.xyz_odom_m, position(120), atol=1e-4)
    assert made.autopilot.odom_segment == 0


@pytest.mark.parametrize("tainted", ["attitude", "position", "odometry"])
def test_after_an_estimate_that_is_not_independent_there_is_none_but_up_remains(tainted: str):
    stage = InertialMotion()
    stage.on_attitude(attitude(0))
    stage.on_position(local_position(0))
    stage.on_imu(imu(0))
    assert motion(stage, 20).autopilot is not None
    if tainted == "odometry":
        stage.on_odometry(odometry(30, independent=False))
    else:
        stage.on_attitude(attitude(30, independent=tainted != "attitude"))
        stage.on_position(local_position(30, independent=tainted != "position"))
    stage.on_tilt(tilt(30))
    for at_ms in range(40, 260, 20):
        made = motion(stage, at_ms)
        assert made.autopilot is None
    assert made.up_drone is not None


def test_what_is_not_from_the_autopilots_estimate_does_not_depend_on_it():
    """Specific force, rate and noise are bit for bit those without any estimate; up has no yaw, position or velocity."""
    alone, wrong = InertialMotion(), InertialMotion()
    rng = np.random.default_rng(2)
    for i in range(200):
        at_ms = 20 * i
        R = rotation_z(rng.uniform(-3, 3)) @ R_odom_drone(at_ms)
        wrong.on_attitude(attitude(at_ms, independent=False, R=R))
        wrong.on_tilt(tilt(at_ms))
        wrong.on_position(local_position(at_ms, independent=False, jump_m=rng.normal(), jump_mps=rng.normal()))
        a, b = alone.on_imu(imu(at_ms)), wrong.on_imu(imu(at_ms))
        if a is None or b is None:
            continue
        assert (a.stamp_ns, a.start_ns, a.segment) == (b.stamp_ns, b.start_ns, b.segment)
        np.testing.assert_array_equal(a.specific_force_drone_mps2, b.specific_force_drone_mps2)
        np.testing.assert_array_equal(a.angular_velocity_drone_radps, b.angular_velocity_drone_radps)
        np.testing.assert_array_equal(a.specific_force_noise, b.specific_force_noise)
        assert b.autopilot is None
        assert b.up_drone is not None
        np.testing.assert_allclose(b.up_drone, R_odom_drone(at_ms).T @ [0, 0, 1], atol=1e-9)
