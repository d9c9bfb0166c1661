"""The simulated airframe and its IMU against formulas by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.simulated.autopilot.flight_stack.quadrotor import TICK_S, Quadrotor, butterworth, gain
from links.simulated.autopilot.flight_stack.settings import FlightStackSettings, ImuSettings, WindSettings
from links.simulated.kernels.airframe import low_pass_sample
from links.simulated.kernels.motion import DRAG_PER_S, GRAVITY_MPS2, STEP_S

STILL = WindSettings(gust_mps=0.0)
IDEAL = ImuSettings(
    gyro_bias_degps=0, accelerometer_bias_mps2=0, gyro_white_degps=0, accelerometer_white_mps2=0, vibration_mps2=0,
    vibration_degps=0, gyro_scale=0,
)  # fmt: skip
LEVEL = np.array([0.0, 0.0, GRAVITY_MPS2, 0.0, 0.0, 1.0])  # acceleration + g, yaw, yaw rate, motors run


def quadrotor(imu: ImuSettings = IDEAL, wind: WindSettings = STILL, height_m: float = 10.0, seed: int = 1) -> Quadrotor:
    settings = FlightStackSettings(imu=imu, wind=wind)
    return Quadrotor(settings, np.array([0.0, 0.0, height_m]), 0.0, 0.0, 60.0, seed)


def true_estimate(drone: Quadrotor) -> np.ndarray:
    """The estimate of a filter without errors."""
    return np.concatenate([drone.state[0:10], drone.gyro_bias, drone.accelerometer_bias])


def fly(drone: Quadrotor, duration_s: float, command: np.ndarray = LEVEL) -> np.ndarray:
    """Reported samples (n, 6)."""
    samples = [drone.fly(true_estimate(drone), command).samples for _ in range(round(duration_s / TICK_S))]
    return np.vstack(samples)


def test_in_still_air_it_hovers_and_measures_one_g() -> None:
    drone = quadrotor()
    samples = fly(drone, 3.0)
    np.testing.assert_allclose(drone.state[0:3], [0, 0, 10], atol=1e-9)
    np.testing.assert_allclose(samples[-1], [0, 0, 0, 0, 0, GRAVITY_MPS2], atol=1e-6)


def test_wind_carries_a_level_airframe_as_linear_drag_says() -> None:
    """v = wind (1 - exp(-drag t)); the accelerometer feels the drag alone, not the acceleration by gravity."""
    drone = quadrotor(wind=WindSettings(mean_world_mps=(3.0, 0.0, 0.0), gust_mps=0.0))
    samples = fly(drone, 4.0)
    speed = 3.0 * (1 - math.exp(-DRAG_PER_S * 4.0))
    assert drone.state[3] == pytest.approx(speed, rel=0.01)
    assert samples[-1, 3] == pytest.approx(DRAG_PER_S * (3.0 - speed), abs=0.03)


def test_a_wanted_acceleration_tilts_it_by_its_angle() -> None:
    """tan(tilt) = a / g: pitch about y, and the airframe accelerates forward by a less drag."""
    drone = quadrotor()
    command = LEVEL + np.array([2.0, 0, 0, 0, 0, 0])
    fly(drone, 1.0, command)
    R = drone.motion.flying_poses(np.array([drone.motion.until_s]))[0][0]
    assert math.atan2(R[0, 2], R[2, 2]) == pytest.approx(math.atan(2.0 / GRAVITY_MPS2), abs=0.005)
    before = drone.state[3]
    fly(drone, 0.1, command)
    assert (drone.state[3] - before) / 0.1 == pytest.approx(2.0 - DRAG_PER_S * before, abs=0.1)


def test_the_attitude_follows_the_estimate_not_the_truth() -> None:
    """With an estimate that is 5 deg wrong in roll, level by the estimate is 5 deg tilted: it drifts away by g tan 5."""
    drone = quadrotor()
    half = math.radians(2.5)
    for _ in range(100):
        estimate = true_estimate(drone)
        x, y, z, w = estimate[6:10]
        c, s = math.cos(half), math.sin(half)
        estimate[6:10] = (c * x + s * w, c * y - s * z, c * z + s * y, c * w - s * x)  # Rx(5 deg) R
        drone.fly(estimate, LEVEL)
    R = drone.motion.flying_poses(np.array([drone.motion.until_s]))[0][0]
    assert math.degrees(math.acos(R[2, 2])) == pytest.approx(5.0, abs=0.3)
    assert np.hypot(*drone.state[3:5]) == pytest.approx(GRAVITY_MPS2 * math.tan(math.radians(5)) * 0.85, rel=0.15)


def test_without_motors_it_falls_and_crashes_and_a_slow_touch_down_is_none() -> None:
    falling = quadrotor(height_m=5.0)
    fly(falling, 2.0, LEVEL * [1, 1, 1, 1, 1, 0])
    assert falling.crashed
    assert falling.grounded
    landing = quadrotor(height_m=1.0)
    for _ in range(600):
        error = -0.5 - landing.state[5]
        landing.fly(true_estimate(landing), LEVEL + np.array([0, 0, 5 * error, 0, 0, 0]))
    assert landing.grounded
    assert not landing.crashed
    np.testing.assert_allclose(landing.state[3:6], 0.0)


def test_the_low_pass_has_the_gain_of_a_butterworth() -> None:
    coefficients = butterworth(20.0, 400.0)
    for frequency_hz in (0.5, 20.0, 83.0):
        memory = np.zeros(2)
        t = np.arange(4000) / 400.0
        out = [low_pass_sample(x, memory, coefficients) for x in np.sin(2 * np.pi * frequency_hz * t)]
        assert np.std(out[2000:]) * math.sqrt(2) == pytest.approx(gain(20.0, frequency_hz, 400.0), rel=0.02)
    assert gain(20.0, 20.0, 400.0) == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize(
    ("vibration_mps2", "tones", "filter_hz"), [(0.3, 0.5, 20.0), (1.0, 1.0, 20.0), (1.0, 0.0, 60.0)]
)
def test_vibration_has_the_set_size_in_what_is_reported(vibration_mps2: float, tones: float, filter_hz: float) -> None:
    size = {"vibration_mps2": vibration_mps2, "vibration_degps": 0.5}
    imu = IDEAL.model_copy(update=size | {"tones": tones, "filter_hz": filter_hz})
    samples = fly(quadrotor(imu), 10.0)[400:]
    assert samples[:, 3:].std(axis=0) == pytest.approx([vibration_mps2] * 3, rel=0.1)
    assert np.degrees(samples[:, :3].std(axis=0)) == pytest.approx([0.5] * 3, rel=0.1)


def test_without_motors_there_is_no_vibration() -> None:
    imu = IDEAL.model_copy(update={"vibration_mps2": 1.0, "vibration_degps": 5.0})
    falling = fly(quadrotor(imu), 1.0, LEVEL * [1, 1, 1, 1, 1, 0])
    assert np.abs(falling[:, [0, 1, 2, 3, 4]]).max() < 1e-6


def test_vibration_aliases_into_a_50_hz_stream() -> None:
    """83 Hz at 97, 101, 99 and 103 % are tones of 80.5 to 85.5 Hz: sampled at 50 Hz they appear at 14.5 to 19.5 Hz.

    The other half of the variance is broadband up to the cut-off of the low-pass (20 Hz).
    """
    imu = IDEAL.model_copy(update={"vibration_mps2": 0.3, "rotor_hz": 83.0})
    slow = fly(quadrotor(imu), 21.0)[400 :: round(1 / STEP_S / 50), 5]
    power = np.abs(np.fft.rfft(slow - slow.mean())) ** 2
    frequency_hz = np.fft.rfftfreq(len(slow), 1 / 50)
    aliased = [abs(83.0 * share - 100.0) for share in (0.97, 1.01, 0.99, 1.03)]
    in_band = (frequency_hz > min(aliased) - 0.3) & (frequency_hz < max(aliased) + 0.3)
    assert 0.5 < power[in_band].sum() / power.sum() < 0.7
    assert 0.2 < power[frequency_hz < 12.0].sum() / power.sum() < 0.35


def test_each_seed_draws_its_rate_of_the_rotors() -> None:
    rates_hz = [strongest_hz(seed) for seed in (1, 1, 2, 3)]
    assert rates_hz[0] == rates_hz[1]
    assert len(set(rates_hz)) == 3
    assert all(65.0 * 0.96 < rate < 125.0 * 1.04 for rate in rates_hz)


def strongest_hz(seed: int) -> float:
    """Frequency of the strongest tone in the reported vertical acceleration."""
    shaken = fly(quadrotor(IDEAL.model_copy(update={"vibration_mps2": 0.3}), seed=seed), 6.0)[400:, 5]
    return float(np.fft.rfftfreq(len(shaken), STEP_S)[np.argmax(np.abs(np.fft.rfft(shaken - shaken.mean())))])


def test_the_gyro_has_a_scale_error_and_the_accelerometer_none() -> None:
    turning = np.array([0.0, 0.0, GRAVITY_MPS2, 2.5, 0.0, 1.0])
    ratio, force = list[float](), list[float]()
    for scale in (0.0, 0.05):
        drone = quadrotor(IDEAL.model_copy(update={"gyro_scale": scale}))
        samples = fly(drone, 1.0, turning)
        ratio.append(samples[-1, 2] / drone.state[12])
        force.append(samples[-1, 5])
    assert ratio[0] == pytest.approx(1.0, abs=2e-3)
    assert abs(ratio[1] - 1.0) > 0.01
    np.testing.assert_allclose(force, GRAVITY_MPS2, atol=1e-6)


def test_biases_are_in_the_samples() -> None:
    imu = ImuSettings(gyro_white_degps=0, accelerometer_white_mps2=0, vibration_mps2=0, vibration_degps=0)
    drone = quadrotor(imu)
    samples = fly(drone, 2.0)
    np.testing.assert_allclose(samples[-1, 0:3], drone.gyro_bias + drone.state[10:13], atol=1e-3)
    np.testing.assert_allclose(samples[-1, 3:6] - [0, 0, GRAVITY_MPS2], drone.accelerometer_bias, atol=0.02)
    assert np.abs(drone.gyro_bias).max() > 0.0


def test_a_look_ahead_of_the_airframe_is_an_error() -> None:
    drone = quadrotor()
    fly(drone, 0.1)
    drone.motion.flying_poses(np.array([0.1]))
    with pytest.raises(LookupError, match=r"has flown 0\.1"):
        drone.motion.flying_poses(np.array([0.2]))
