"""The bank of yaw hypotheses and its parts: preintegration, prediction, updates, mixture."""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import rotation_z
from stages.heading import bank_measurements as measure
from stages.heading.inertial_bank import MOST, NEAR_RAD, START_GYRO_BIAS, InertialBank, level, moments, start
from stages.heading.inertial_state import GRAVITY_MPS2, ImuIntervals, InertialState, exp_rotations, predict
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.kernels.heading.preintegration import preintegrate
from stages.messages import GyroBias

UP = np.array([0.0, 0.0, 1.0])
REST = -GRAVITY_MPS2


def intervals(n=10, step_s=0.02, force=REST, rate=(0.0, 0.0, 0.0)):
    return ImuIntervals(
        np.full(n, step_s),
        np.tile(force, (n, 1)),
        np.tile(np.array(rate), (n, 1)),
        np.full((n, 3), 0.04),
        np.full((n, 3), 1e-3),
    )


def one(R=None, bias=None, sigma=0.1):
    bias = np.zeros(6) if bias is None else bias
    R = np.eye(3) if R is None else R
    return InertialState(
        R[None], np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), bias[None], sigma**2 * np.eye(15)[None]
    )


def test_a_drone_at_rest_and_level_keeps_its_velocity():
    after = predict(one(rotation_z(1.0)), intervals(), np.ones(1))
    assert np.allclose(after.velocity_mps, [[1.0, 0.0, 0.0]])
    assert np.allclose(after.xyz_m, [[0.2, 0.0, 0.0]])


def test_a_forward_force_accelerates_along_the_hypothesis_s_own_yaw():
    after = predict(one(rotation_z(0.5 * math.pi)), intervals(force=REST + np.array([2.0, 0, 0])), np.ones(1))
    assert np.allclose(after.velocity_mps, [[1.0, 0.4, 0.0]])
    assert np.allclose(after.xyz_m[0, 1], 0.5 * 2.0 * 0.2**2)


def test_derivatives_by_the_biases_are_those_of_finite_differences():
    rng = np.random.default_rng(1)
    step, force, rate = np.full(8, 0.02), rng.normal(0, 1, (8, 3)) + REST, rng.normal(0, 0.7, (8, 3))
    noise = np.zeros((8, 3))
    base = preintegrate(step, force, rate, noise, noise, np.zeros((2, 3)))
    for k in range(6):
        bias = np.zeros(6)
        bias[k] = 1e-5
        moved = preintegrate(step, force, rate, noise, noise, bias.reshape(2, 3))
        numeric = np.concatenate([log_rotation(base[0].T @ moved[0]), moved[1] - base[1], moved[2] - base[2]]) / 1e-5
        assert np.allclose(base[3][:, k], numeric, atol=1e-4)


def test_the_predicted_covariance_is_that_of_sampled_states():
    rng = np.random.default_rng(2)
    R = rotation_z(0.7) @ exp_rotation(np.array([0.1, -0.2, 0.0]))
    imu = intervals(n=12, force=REST + np.array([1.0, -0.5, 0.2]), rate=(0.2, -0.1, 0.3))
    state = one(R, sigma=0.02)
    quiet = ImuIntervals(imu.step_s, imu.force_mps2, imu.rate_radps, 0 * imu.force_noise, 0 * imu.rate_noise)
    after = predict(state, quiet, np.ones(1))
    n = 4000
    samples = state.rows(np.zeros(n, dtype=np.intp)).moved(0.02 * rng.standard_normal((n, 15)))
    moved = predict(samples, quiet, np.full(n, 1.0 / n))
    one_of_all = moments(
        InertialState(moved.R, moved.xyz_m, moved.velocity_mps, moved.bias, 0 * moved.covariance), np.full(n, 1 / n)
    )
    ratio = np.diag(one_of_all.covariance[0])[:9] / np.diag(after.covariance[0])[:9]
    assert np.all(np.abs(ratio - 1.0) < 0.1)


def test_the_noise_of_each_axis_is_turned_with_the_drone():
    """Noise of the force along the drone's x axis alone, at a yaw of 90 deg: the velocity's error is along y."""
    imu, n = intervals(n=10, step_s=0.02), 10
    noise = np.tile([0.2, 0.0, 0.0], (n, 1))
    state = InertialState(
        rotation_z(0.5 * math.pi)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), np.zeros((1, 15, 15))
    )
    moved = predict(state, ImuIntervals(imu.step_s, imu.force_mps2, imu.rate_radps, noise, 0.0 * noise), np.ones(1))
    assert np.allclose(np.diag(moved.covariance[0])[6:9], [0.0, 0.2**2 * 0.2, 0.0], atol=1e-12)


def test_a_measured_gyro_bias_about_the_vertical_leaves_the_other_axes_open():
    bank = start(np.zeros(3), 0.01 * np.eye(3), None, UP)
    measure.add_vertical_gyro_bias(bank, GyroBias(up_drone=UP, bias_radps=0.003, sigma_radps=1e-4))
    assert np.allclose(bank.state.bias[:, 3:], [0.0, 0.0, 0.003], atol=2e-5)
    sigma = np.sqrt(np.diagonal(bank.state.covariance[:, 12:, 12:], axis1=1, axis2=2))
    assert np.allclose(sigma[:, 2], 1e-4, rtol=2.0)  # larger by the outlier share
    assert np.allclose(sigma[:, :2], START_GYRO_BIAS)


def test_hypotheses_surround_the_circle_and_are_level():
    tilted = exp_rotation(np.array([0.2, -0.1, 0.0])).T @ UP
    bank = start(np.zeros(3), 0.01 * np.eye(3), None, tilted)
    assert np.allclose(level(tilted) @ tilted, UP)
    assert np.allclose(bank.state.R @ tilted, UP)
    assert np.allclose(
        np.sort(np.remainder(bank.state.yaw_rad, 2 * math.pi)), 2 * math.pi / 12 * np.arange(12), atol=0.02
    )
    assert bank.yaws.best(NEAR_RAD)[1] < 0.3


def test_an_update_moves_towards_the_measurement_and_an_outlier_does_not():
    bank = start(np.zeros(3), 0.04 * np.eye(3), None, UP)
    assert measure.add_position(bank, np.array([0.1, 0.0, 0.0]), 0.04 * np.eye(3)) > 0.9
    assert np.allclose(bank.state.xyz_m[:, 0], 0.05, atol=0.005)
    before = bank.state.xyz_m.copy()
    assert measure.add_position(bank, np.array([4.0, 0.0, 0.0]), 0.04 * np.eye(3)) < 0.01
    assert np.allclose(bank.state.xyz_m, before, atol=0.05)


def test_one_measurement_excludes_no_hypothesis():
    bank = start(np.zeros(3), 1e-4 * np.eye(3), None, UP)
    bank.state.xyz_m[6:] += 100.0
    measure.add_position(bank, np.zeros(3), 1e-4 * np.eye(3))
    assert bank.weight[6:].sum() > 1e-9


def test_a_direction_of_flight_selects_the_yaw():
    bank = start(np.zeros(3), 0.01 * np.eye(3), (np.array([3.0, 0.0, 0.0]), 0.2), UP)
    true = rotation_z(2.0)
    for _ in range(6):
        measure.add_direction(bank, true.T @ np.array([1.0, 0.0, 0.0]), 0.05, 0.1)
    best, near = bank.yaws.best(NEAR_RAD)
    assert abs(math.remainder(bank.state.yaw_rad[best] - 2.0, 2 * math.pi)) < 0.1
    assert near > 0.99


def test_a_vertical_levels_every_hypothesis():
    bank = start(np.zeros(3), 0.01 * np.eye(3), None, UP)
    tilted = exp_rotation(np.array([0.03, 0.0, 0.0])).T @ UP
    for _ in range(20):
        measure.add_vertical(bank, tilted, math.radians(2.0))
    assert np.allclose(bank.state.R @ tilted, UP, atol=0.01)


def test_hypotheses_that_agree_are_merged_with_their_moments():
    state = one(sigma=0.1).rows(np.zeros(2, dtype=np.intp)).moved(np.array([[0.0] * 15, [0.0, 0.0, 0.02] + [0.0] * 12]))
    bank = InertialBank(state, np.zeros(2))
    bank.tidy()
    assert len(bank.state) == 1
    assert math.isclose(bank.state.yaw_rad[0], 0.01, abs_tol=1e-3)
    assert bank.state.yaw_variance_rad2[0] > 0.1**2


def test_a_trace_of_other_yaws_does_not_widen_the_yaw_that_is_known():
    """0.0004 round the circle have a standard deviation of 2 deg about it."""
    bank = start(np.zeros(3), np.eye(3), None, UP, (0.4, math.radians(4.5), 0.9996))
    bank.tidy()
    best = int(np.argmax(bank.weight))
    assert math.isclose(bank.state.yaw_rad[best], 0.4, abs_tol=1e-3)
    assert math.degrees(math.sqrt(bank.state.yaw_variance_rad2[best])) < 4.51
    assert math.isclose(bank.weight.sum(), 1.0)


def test_of_too_many_hypotheses_those_are_merged_that_lose_least():
    """Improbable ones, although the probable ones are nearer to each other."""
    yaws = np.r_[0.0, 0.1, np.radians(np.arange(40, 320, 9))]
    turned = np.column_stack([np.zeros((len(yaws), 2)), yaws, np.zeros((len(yaws), 12))])
    bank = InertialBank(
        one(sigma=0.02).rows(np.zeros(len(yaws), dtype=np.intp)).moved(turned), np.r_[0.0, 0.0, np.full(32, -9.0)]
    )
    bank.tidy()
    assert len(bank.state) == MOST
    probable = bank.weight > 0.1
    assert np.allclose(np.sort(bank.state.yaw_rad[probable]), [0.0, 0.1], atol=1e-6)
    assert np.allclose(bank.state.yaw_variance_rad2[probable], 0.02**2)


def test_a_wide_hypothesis_is_split_without_a_change_of_its_moments():
    state = one(sigma=0.1)
    state.covariance[0, 2, 2] = 0.5**2
    bank = InertialBank(state, np.zeros(1))
    bank.tidy()
    assert len(bank.state) > 1
    assert np.all(np.sqrt(bank.state.yaw_variance_rad2) < 0.4)
    spread = bank.weight @ (bank.state.yaw_variance_rad2 + bank.state.yaw_rad**2)
    assert math.isclose(spread, 0.25, rel_tol=0.05)


def test_the_exponential_of_many_is_that_of_each():
    phi = np.random.default_rng(3).normal(0, 1, (5, 3))
    assert np.allclose(exp_rotations(phi), [exp_rotation(v) for v in phi])
