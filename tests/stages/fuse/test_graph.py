"""The fixed-lag smoother: against the truth, with late and false data, and after every error that GTSAM raises."""

from __future__ import annotations

import dataclasses
import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from stages.fuse.estimator import Estimator
from stages.fuse.graph import InertialGraph
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import rotation_z
from stages.geometry.trajectory import VehicleTrajectory
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_state import GRAVITY_MPS2, POSITION, THETA, VELOCITY, InertialState
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import DroneMotion
from tests.stages.fuse.fuse_inputs import rotation
from tests.stages.fuse.imu_flights import ImuFlight, ns, seconds

SIGMAS = np.array([0.02] * 3 + [0.05] * 3 + [0.1] * 3 + [0.12] * 3 + [0.005] * 3)
STEP_S, SIGMA_M = 0.125, 0.05
FIX_M2 = SIGMA_M**2 * np.eye(3)


@pytest.fixture(scope="module")
def flight():
    return ImuFlight(kind="fast", seed=2, until_s=30.0, stamp_s=0.0, vibration_mps2=0.1)


@pytest.fixture(scope="module")
def imu(flight):
    buffer = ImuBuffer()
    for _, port, message in flight.events():
        if port == "drone_motion" and 0.5 < seconds(message.stamp_ns) < 20.5:
            buffer.add(message)
    return buffer


def true_state(flight, t) -> InertialState:
    R, xyz_m, v = flight.truth(t)
    return InertialState(R[None], xyz_m[None], v[None], np.zeros((1, 6)), np.diag(SIGMAS**2)[None])


def started(flight, imu, until_s=4.0, lag_s=2.0) -> InertialGraph:
    """A graph that has run from 1 s to a time with exact positions."""
    graph = InertialGraph(imu, lag_s)
    graph.start(ns(1.0), true_state(flight, 1.0))
    go_on(graph, flight, until_s)
    return graph


def go_on(graph, flight, until_s):
    """Add positions up to a time."""
    for t in np.arange(seconds(graph.stamp_ns) + STEP_S, until_s + 1e-6, STEP_S):
        assert add(graph, t, flight.truth(t)[1])


def add(graph, t, xyz_m, covariance_m2=FIX_M2) -> bool:
    return graph.add_position(ns(t), xyz_m, covariance_m2, graph.at(ns(t)))


def errors(graph, flight) -> tuple[float, float]:
    """Distance [m] and angle [deg] from the truth."""
    R, xyz_m, _ = flight.truth(seconds(graph.stamp_ns))
    turn = math.degrees(float(np.linalg.norm(log_rotation(graph.state.R[0].T @ R))))
    return float(np.linalg.norm(graph.state.xyz_m[0] - xyz_m)), turn


def rotation_nees(graph, flight) -> float:
    turn = log_rotation(graph.state.R[0].T @ flight.truth(seconds(graph.stamp_ns))[0])
    return float(turn @ np.linalg.solve(graph.state.covariance[0, THETA, THETA], turn))


def test_it_starts_with_the_joint_covariance_of_the_state(flight, imu):
    """Also its correlations: they come back from GTSAM in the axes of InertialState."""
    state = true_state(flight, 1.0)
    state.covariance[0, POSITION, VELOCITY] = 0.002 * np.eye(3)
    state.covariance[0, VELOCITY, POSITION] = 0.002 * np.eye(3)
    state.covariance[0, 3, 3] = 0.2**2  # along x of map
    graph = InertialGraph(imu, 2.0)
    graph.start(ns(1.0), state)
    assert graph._flush()
    assert np.allclose(graph.state.covariance[0], state.covariance[0], atol=1e-7)
    assert np.allclose(graph.state.R[0], state.R[0])


def test_positions_and_the_imu_keep_position_velocity_and_rotation(flight, imu):
    graph = started(flight, imu, 9.0)
    off_m, off_deg = errors(graph, flight)
    assert off_m < 0.05
    assert off_deg < 2.0
    assert np.linalg.norm(graph.state.velocity_mps[0] - flight.truth(9.0)[2]) < 0.15
    assert rotation_nees(graph, flight) < 16.3
    assert graph.recoveries == 0


def test_a_state_between_keys_is_propagated_by_the_imu(flight, imu):
    graph = started(flight, imu)
    later = graph.at(ns(4.3))
    assert np.linalg.norm(later.xyz_m[0] - flight.truth(4.3)[1]) < 0.1
    assert np.trace(later.covariance[0, POSITION, POSITION]) > np.trace(graph.state.covariance[0, POSITION, POSITION])


def test_a_false_position_has_a_reduced_weight(flight, imu):
    """Huber: a residual of 40 sigmas acts like 1.345 sigmas; without, it would move 40 times as far as one."""
    moved_m = []
    for off_m in (SIGMA_M, 40 * SIGMA_M):
        graph = started(flight, imu)
        t = 4.0 + STEP_S
        predicted = graph.at(ns(t)).xyz_m[0]
        add(graph, t, predicted + np.array([off_m, 0.0, 0.0]))
        moved_m.append(float(graph.state.xyz_m[0, 0] - predicted[0]))
    assert moved_m[0] > 0.2 * SIGMA_M
    assert moved_m[1] < 5.0 * moved_m[0]


def test_two_positions_of_one_time_are_one_key(flight, imu):
    graph = started(flight, imu)
    number, before = graph._number, np.trace(graph.state.covariance[0, POSITION, POSITION])
    assert graph.add_position(ns(4.0), flight.truth(4.0)[1], FIX_M2, graph.state)
    assert graph._number == number
    assert np.trace(graph.state.covariance[0, POSITION, POSITION]) < before


def test_without_positions_keys_follow_each_other_at_200_ms(flight, imu):
    graph = started(flight, imu)
    number = graph._number
    graph.advance(ns(5.0))
    assert graph._number == number + 5
    assert graph.stamp_ns == ns(5.0)


@pytest.mark.parametrize("when", ["position", "rotation"])
@pytest.mark.parametrize(
    ("value", "covariance"),
    [(np.nan, np.eye(3)), (0.0, np.full((3, 3), np.nan)), (0.0, np.zeros((3, 3))), (0.0, -np.eye(3))],
)
def test_invalid_numbers_are_rejected(flight, imu, when, value, covariance):
    graph = started(flight, imu, 2.0)
    if when == "position":
        assert not add(graph, 2.0 + STEP_S, np.full(3, value), covariance)
    else:
        assert not graph.add_rotation(np.eye(3) + value, covariance)
    assert graph.recoveries == 0
    assert graph.stamp_ns == ns(2.0)


def test_an_invalid_start_does_not_run(flight, imu):
    state = true_state(flight, 1.0)
    state.covariance[0] = -np.eye(15)
    graph = InertialGraph(imu, 2.0)
    graph.start(ns(1.0), state)
    assert not graph.running
    assert graph.recoveries == 1


def test_a_gap_of_the_imu_restarts_it_at_the_propagated_state(flight):
    buffer = ImuBuffer()
    for _, port, message in flight.events():
        if port == "drone_motion" and not 3.0 < seconds(message.stamp_ns) < 3.6 and seconds(message.stamp_ns) > 0.5:
            buffer.add(message)
    graph = started(flight, buffer, 8.0)
    assert graph.running
    assert graph.recoveries == 0
    assert errors(graph, flight)[0] < 0.1
    assert rotation_nees(graph, flight) < 16.3  # turned by 25 deg in the gap: the covariance states it


# errors of GTSAM


def _nan(graph):
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.GPSFactor(X(graph._number), np.full(3, np.nan), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    return graph._guarded(factors, gtsam.Values(), {}, graph.state)


def _indeterminate(graph):
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(X(9999), gtsam.Pose3())
    factors.add(gtsam.GPSFactor(X(9999), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    return graph._guarded(factors, values, {X(9999): 9.0}, graph.state)


def _twice(graph):
    values = gtsam.Values()
    values.insert(X(graph._number), gtsam.Pose3())
    return graph._guarded(gtsam.NonlinearFactorGraph(), values, {X(graph._number): 9.0}, graph.state)


def _unknown(graph):
    graph._number += 7
    return graph._flush()


def _far(graph):
    """The estimate itself is finite and useless."""
    for _ in range(3):
        graph._pending.append(
            lambda n: gtsam.GPSFactor(X(n), np.full(3, 1e9), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))
        )
    return graph._flush()


@pytest.mark.parametrize("spoil", [_nan, _indeterminate, _twice, _unknown, _far])
def test_after_every_error_of_gtsam_it_restarts_at_the_last_valid_state(flight, imu, spoil):
    graph = started(flight, imu)
    graph.add_vertical(graph.state.R[0, 2], 0.03)  # pending: dropped with the smoother
    R, xyz_m, P = (a.copy() for a in (graph.state.R, graph.state.xyz_m, graph.state.covariance))
    assert not spoil(graph)
    assert graph.recoveries == 1
    assert graph.running
    assert np.allclose(graph.state.R, R)
    assert np.allclose(graph.state.xyz_m, xyz_m)
    assert np.allclose(graph.state.covariance, P)
    go_on(graph, flight, 6.0)
    assert graph.recoveries == 1
    assert errors(graph, flight)[0] < 0.05


def test_its_lists_of_factors_and_keys_do_not_grow(flight, imu):
    graph = started(flight, imu, 6.0)
    before = graph._smoother.getFactors().size()
    go_on(graph, flight, 18.0)
    assert graph._smoother.getFactors().size() < before + 12
    assert graph._smoother.calculateEstimate().size() <= 3 * (2.0 / STEP_S + 2)
    assert graph.recoveries == 0


# a rotation by vanishing points that is older than the newest key


def spinning(rate_radps, late_s, yaw_off_rad, sigma_rad):
    """A drone that spins on the spot; a rotation of `late_s` ago, with one sigma for each axis of the drone then.

    Returns the graph's error in drone axes [rad] and its sigmas, after the next key.
    """
    estimator = Estimator(FuseErrors(rotation_bias_share=0.0), VehicleTrajectory(joined=False), 2.0)
    for k in range(100):
        estimator.add_motion(
            DroneMotion(
                stamp_ns=ns(1.0 + 0.02 * (k + 1)),
                start_ns=ns(1.0 + 0.02 * k),
                segment=0,
                specific_force_drone_mps2=-GRAVITY_MPS2,
                angular_velocity_drone_radps=np.array([0.0, 0.0, rate_radps]),
                specific_force_noise=np.full(3, 0.05),
                angular_velocity_noise=np.full(3, 1e-3),
                up_drone=None,
                autopilot=None,
            ),
            fixed=True,
        )
    P = np.diag(np.array([0.05] * 3 + [0.05] * 3 + [0.1] * 3 + [0.1] * 3 + [1e-3] * 3) ** 2)
    yaw_rad = rate_radps * 1.5  # at 2.5 s
    start = InertialState(
        rotation_z(yaw_rad + yaw_off_rad)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), P[None]
    )
    estimator._cameras_confirmed = True
    estimator.graph.start(ns(2.5), start)
    message = rotation(2.5 - late_s, rotation_z(yaw_rad - rate_radps * late_s))
    estimator.add(dataclasses.replace(message, covariances_rad2=np.diag(sigma_rad**2)[None]))
    estimator.pass_time(ns(2.8))
    estimator.graph.advance(ns(2.75))
    state = estimator.graph.state
    assert estimator.graph.stamp_ns == ns(2.7)
    assert estimator.graph.recoveries == 0
    assert estimator.rotation_ns == ns(2.5 - late_s)
    turn = log_rotation(state.R[0].T @ rotation_z(rate_radps * 1.7))
    return turn, np.sqrt(np.diag(state.covariance[0, THETA, THETA]))


@pytest.mark.parametrize("late_s", [0.0, 0.25, 0.5])
def test_a_late_rotation_is_turned_by_the_gyroscope_to_the_newest_key(late_s):
    """At 1 rad/s a rotation of 0.25 s ago is 14 deg behind."""
    turn, _ = spinning(1.0, late_s, math.radians(2.0), np.full(3, 0.005))
    assert np.abs(turn).max() < math.radians(0.1)


def test_the_covariance_of_a_late_rotation_is_in_the_drone_s_axes_then():
    """The drone has turned by 90 deg since: the axis that was x, measured well, is now -y."""
    _, sigma = spinning(math.pi, 0.5, 0.0, np.array([1e-3, 0.5, 0.5]))
    since_rad = 0.2 * math.pi  # turned from the rotation's key to the next one
    assert sigma[:2] == pytest.approx(0.05 * np.array([math.cos(since_rad), math.sin(since_rad)]), rel=0.05)
