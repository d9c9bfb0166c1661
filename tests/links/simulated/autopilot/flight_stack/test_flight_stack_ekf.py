"""The error-state EKF of the simulated autopilot against formulas by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.simulated.autopilot.flight_stack.estimation.lane import Lane
from links.simulated.autopilot.flight_stack.estimation.observations import ObservationBuffer
from links.simulated.autopilot.flight_stack.estimation.source_rules import EKF3
from links.simulated.kernels.airframe import turn
from links.simulated.kernels.ekf import fuse, predict, reset_yaw, yaw_and_jacobian
from links.simulated.kernels.motion import GRAVITY_MPS2

DT = 0.01
NOISE = np.zeros(4)


def level(yaw_rad: float = 0.0) -> np.ndarray:
    x = np.zeros(16)
    x[8:10] = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)
    return x


def test_a_constant_acceleration_gives_its_parabola() -> None:
    """1 m/s^2 forward at yaw 90 deg for 2 s: 2 m and 2 m/s along y."""
    x, P = level(math.pi / 2), np.eye(15) * 1e-6
    for _ in range(200):
        predict(x, P, np.array([0, 0, 0, 1.0, 0, GRAVITY_MPS2]) * DT, DT, NOISE)
    np.testing.assert_allclose(x[0:3], [0, 2.0, 0], atol=1e-9)
    np.testing.assert_allclose(x[3:6], [0, 2.0, 0], atol=1e-9)


def test_a_turn_turns_and_biases_are_removed() -> None:
    x, P = level(), np.eye(15) * 1e-6
    x[10:13], x[13:16] = (0.1, -0.2, 0.3), (0.5, 0.4, -0.3)
    moved = np.array([0.1, -0.2, 0.3 + math.radians(30), 0.5, 0.4, GRAVITY_MPS2 - 0.3]) * DT
    for _ in range(100):
        predict(x, P, moved, DT, NOISE)
    assert yaw_and_jacobian(x, np.zeros(15)) == pytest.approx(math.radians(30), abs=1e-9)
    np.testing.assert_allclose(x[3:6], 0.0, atol=1e-9)


def test_an_unknown_velocity_widens_the_position_by_its_integral() -> None:
    """P_p(t) = P_p + P_v t^2, and a tilt error widens the velocity by (g t)^2."""
    x, P = level(), np.zeros((15, 15))
    P[3, 3], P[7, 7] = 0.04, math.radians(1) ** 2
    for _ in range(100):
        predict(x, P, np.array([0, 0, 0, 0, 0, GRAVITY_MPS2]) * DT, DT, NOISE)
    tilt = (GRAVITY_MPS2 * math.radians(1)) ** 2
    assert P[3, 3] == pytest.approx(0.04 + tilt, rel=1e-6)
    assert P[0, 0] == pytest.approx(0.04 + tilt / 4, rel=0.02)


def test_a_scalar_update_is_that_of_a_kalman_filter() -> None:
    """P = 4, R = 1: gain 0.8; the error falls to a fifth, the variance to 0.8."""
    x, P = level(), np.eye(15)
    P[0, 0] = 4.0
    H = np.zeros(15)
    H[0] = 1.0
    fuse(x, P, H, 1.0 - x[0], 1.0)
    assert x[0] == pytest.approx(0.8)
    assert P[0, 0] == pytest.approx(0.8)
    assert P[1, 1] == pytest.approx(1.0)


def test_the_jacobian_of_the_yaw_is_its_derivative() -> None:
    x, H = level(0.4), np.zeros(15)
    turn(x[6:10], 0.3, -0.2, 0.1)
    yaw = yaw_and_jacobian(x, H)
    for axis in range(3):
        moved = x.copy()
        step = np.zeros(3)
        step[axis] = 1e-6
        turn(moved[6:10], *step)
        assert (yaw_and_jacobian(moved, np.zeros(15)) - yaw) / 1e-6 == pytest.approx(H[6 + axis], abs=1e-5)


def test_a_yaw_reset_keeps_the_tilt_and_takes_the_yaw() -> None:
    x, P = level(0.4), np.eye(15)
    turn(x[6:10], 0.3, -0.2, 0.0)
    z_before = 1 - 2 * (x[6] ** 2 + x[7] ** 2)
    change = reset_yaw(x, P, 2.0, 0.01)
    assert yaw_and_jacobian(x, np.zeros(15)) == pytest.approx(2.0)
    assert 1 - 2 * (x[6] ** 2 + x[7] ** 2) == pytest.approx(z_before)
    assert change != 0.0
    assert P[8, 8] == pytest.approx(0.01)
    assert np.count_nonzero(P[6:9, 0:6]) == 0


def test_the_horizon_is_behind_and_the_output_is_now() -> None:
    """At 1 m/s the horizon is 0.24 m behind the output."""
    lane = Lane(EKF3, np.zeros(3), 0.0)
    lane.x[3] = 1.0
    for k in range(100):
        lane.advance((k + 1) * 10_000_000, np.array([0, 0, 0, 0, 0, GRAVITY_MPS2]) * DT)
    assert lane.horizon_ns == 760_000_000
    assert lane.x[0] == pytest.approx(0.76)
    assert lane.output()[0] == pytest.approx(1.0)


def test_the_test_ratio_is_the_innovation_over_the_gate() -> None:
    lane = Lane(EKF3, np.zeros(3), 0.0)
    lane.P[0, 0] = lane.P[1, 1] = 0.5
    ratio = lane.ratio(slice(0, 2), np.array([3.0, 4.0]), 0.5, 5.0)
    assert ratio == pytest.approx(25.0 / (25.0 * 2.0))


def test_the_buffer_gives_the_newest_observation_that_the_horizon_has_reached() -> None:
    buffer: ObservationBuffer[str] = ObservationBuffer()
    for time_ns, name in ((30, "c"), (10, "a"), (20, "b")):
        buffer.push(time_ns, name)
    assert buffer.recall(25) == "b"
    assert buffer.recall(25) is None
    assert buffer.recall(200_000_000) is None  # too old
