"""The two back ends: against each other, with late data, and after every error that GTSAM raises."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from stages.fuse.motion_model import Step
from stages.fuse.smoother import Smoother
from stages.geometry.frames import rotation_z
from stages.geometry.se3 import composed_covariance
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from tests.stages.fuse.ekf import Ekf

TENTH = 100_000_000
TILT = 0.2
UP = np.array([0.0, 0.0, 1.0])
P0 = np.diag([0.02**2] * 3 + [0.05**2] * 3)
STAYS = Step(np.eye(3), np.zeros(3), np.zeros((6, 6)), True, True)


def way(dx=0.3, turn=0.05, sigma=0.01) -> Step:
    return Step(rotation_z(turn), np.array([dx, 0.0, 0.0]), np.diag([0.002**2] * 3 + [sigma**2] * 3), True, True)


def started(back, steps=20):
    back.start(0, np.eye(3), np.zeros(3), P0)
    for k in range(1, steps + 1):
        back.extend(k * TENTH, way(), UP, TILT)
    return back


def true_pose(steps, dx=0.3, turn=0.05):
    R, x = np.eye(3), np.zeros(3)
    for _ in range(steps):
        x, R = x + R @ [dx, 0, 0], R @ rotation_z(turn)
    return R, x


@pytest.mark.parametrize("make", [lambda: Smoother(3.0), Ekf])
def test_a_chain_of_steps_is_their_product_and_its_covariance_theirs(make):
    back = make()
    back.start(0, np.eye(3), np.zeros(3), P0)
    P = P0
    for k in range(1, 11):
        back.extend(k * TENTH, way(), None, TILT)
        P = composed_covariance(P, way().R, way().t_m, way().covariance)
    R, x = true_pose(10)
    assert np.allclose(back.R_map_drone, R, atol=1e-6)
    assert np.allclose(back.xyz_map_m, x, atol=1e-6)
    assert np.allclose(back.covariance, P, rtol=0.02, atol=1e-7)


def test_smoother_and_filter_agree_on_valid_data():
    rng = np.random.default_rng(3)
    confirms = [Smoother(3.0), Ekf()]
    for back in confirms:
        back.start(0, np.eye(3), np.zeros(3), P0)
    for k in range(1, 60):
        R, x = true_pose(k)
        z, turned = x + rng.normal(0, 0.05, 3), R @ exp_rotation(rng.normal(0, 0.01, 3))
        for back in confirms:
            back.extend(k * TENTH, way(), UP, TILT)
            assert back.add_position(k * TENTH, STAYS, z, 0.05**2 * np.eye(3))
            assert back.add_rotation(k * TENTH, STAYS, turned, 0.01**2 * np.eye(3))
    a, b = confirms
    assert np.linalg.norm(a.xyz_map_m - b.xyz_map_m) < 0.01
    assert np.linalg.norm(log_rotation(a.R_map_drone.T @ b.R_map_drone)) < 0.002
    assert np.allclose(np.diag(a.covariance), np.diag(b.covariance), rtol=0.15)
    assert np.linalg.norm(a.xyz_map_m - true_pose(59)[1]) < 0.06


@pytest.mark.parametrize("make", [lambda: Smoother(3.0), Ekf])
def test_a_late_fix_moves_the_pose_at_its_own_time(make):
    """A fix of 0.5 s ago with an offset: the newest pose moves by the offset, not by the displacement since."""
    back = started(make())
    before = back.xyz_map_m.copy()
    key_ns, R, x = back.near(15 * TENTH)
    R_then, x_then = true_pose(15)
    if key_ns == 20 * TENTH:  # the filter keeps the newest pose alone
        step = Step(R.T @ R_then, R.T @ (x_then - x), np.zeros((6, 6)), True, True)
    else:
        assert key_ns == 15 * TENTH
        step = STAYS
    offset = np.array([0.02, -0.01, 0.03])
    assert back.add_position(key_ns, step, x_then + offset, 0.001**2 * np.eye(3))
    moved = back.xyz_map_m - before
    assert np.allclose(moved, offset, atol=0.015)
    assert moved @ offset > 0.5 * offset @ offset


def test_a_measurement_between_two_poses_is_referred_to_the_earlier_one():
    back = started(Smoother(3.0))
    assert back.near(15 * TENTH + 40_000_000)[0] == 15 * TENTH
    assert back.near(-5)[0] == 0
    assert back.near(99 * TENTH)[0] == 20 * TENTH


@pytest.mark.parametrize("make", [lambda: Smoother(3.0), Ekf])
def test_a_rotations_covariance_is_in_the_drones_axes_then(make):
    """The drone has turned by 90 deg since the chain's pose: the small variance about its x is about the y of the pose."""
    back = make()
    back.start(0, np.eye(3), np.zeros(3), P0)
    turned = Step(rotation_z(np.pi / 2), np.zeros(3), np.zeros((6, 6)), True, True)
    back.add_rotation(0, turned, rotation_z(np.pi / 2), np.diag([1e-4, 1.0, 1.0]) ** 2)
    sigma = np.sqrt(np.diag(back.covariance)[:3])
    assert sigma[1] == pytest.approx(1e-4, rel=0.01)
    assert sigma[0] == pytest.approx(0.02, rel=0.01)


def test_a_false_fix_has_a_reduced_weight():
    """Huber: a residual of ten sigmas acts like 1.345."""
    pulled = []
    for off in (0.5, 5.0):
        back = started(Ekf())
        before = back.xyz_map_m.copy()
        back.add_position(back.stamp_ns, STAYS, before + np.array([off, 0, 0]), 0.05**2 * np.eye(3))
        pulled.append(back.xyz_map_m[0] - before[0])
    assert pulled[1] < 2.0 * pulled[0]


def test_a_pose_outside_the_window_accepts_no_measurement():
    back = started(Smoother(3.0), steps=60)
    assert not back.add_position(2 * TENTH, STAYS, np.zeros(3), np.eye(3))
    assert back.recoveries == 0


@pytest.mark.parametrize("start_ns", [1_748_859_641_434_316_687, 1_748_859_641_434_316_801, 0, 97])
def test_every_pose_of_the_window_can_be_read_also_the_oldest(start_ns):
    """Stamps are 1.7e18 ns: as floats they have a resolution of 256 ns, and 30 times 0.1 s is not exactly 3 s."""
    back = Smoother(3.0)
    back.start(start_ns, np.eye(3), np.zeros(3), P0)
    for k in range(1, 120):
        back.extend(start_ns + k * TENTH, way(), UP, TILT)
        key_ns, _, xyz = back.near(start_ns)
        oldest = max(0, k - 29)
        assert key_ns == start_ns + oldest * TENTH
        assert np.allclose(xyz, true_pose(oldest)[1], atol=1e-3)
    assert back.recoveries == 0


@pytest.mark.parametrize(
    ("xyz", "covariance"),
    [
        (np.full(3, np.nan), np.eye(3)),
        (np.zeros(3), np.full((3, 3), np.nan)),
        (np.zeros(3), np.zeros((3, 3))),
        (np.zeros(3), -np.eye(3)),
    ],
)
def test_invalid_numbers_are_rejected(xyz, covariance):
    back = started(Smoother(3.0))
    assert not back.add_position(back.stamp_ns, STAYS, xyz, covariance)
    assert back.recoveries == 0


def _marginalised(back):
    back._keys.appendleft((2 * TENTH, 3))  # as if it were still in the window
    return back.add_position(2 * TENTH, STAYS, np.zeros(3), 0.01 * np.eye(3))


def _nan(back):
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    graph.add(gtsam.GPSFactor(X(back._number), np.full(3, np.nan), noise))
    return back._guarded(lambda: back._smoother.update(graph, gtsam.Values(), {}), *now(back))


def _indeterminate(back):
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(X(9999), gtsam.Pose3())
    graph.add(gtsam.GPSFactor(X(9999), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    return back._guarded(lambda: back._smoother.update(graph, values, {X(9999): 9.0}), *now(back))


def _twice(back):
    values = gtsam.Values()
    values.insert(X(back._number), gtsam.Pose3())
    return back._guarded(
        lambda: back._smoother.update(gtsam.NonlinearFactorGraph(), values, {X(back._number): 9.0}), *now(back)
    )


def _unknown(back):
    back._number += 7
    return back._guarded(lambda: None, *now(back))


def _unreadable(back):
    back._keys.appendleft((2 * TENTH, 3))
    return back.near(2 * TENTH)[0] != back.stamp_ns


def now(back):
    return back.R_map_drone, back.xyz_map_m, back.covariance


@pytest.mark.parametrize("spoil", [_marginalised, _nan, _indeterminate, _twice, _unknown, _unreadable])
def test_after_every_error_of_gtsam_it_restarts_at_the_last_valid_pose(spoil):
    back = started(Smoother(3.0), steps=40)
    R, xyz, P = (a.copy() for a in now(back))
    assert not spoil(back)
    assert back.recoveries == 1
    assert np.allclose(back.R_map_drone, R)
    assert np.allclose(back.xyz_map_m, xyz)
    assert np.allclose(back.covariance, P)
    for k in range(41, 60):
        back.extend(k * TENTH, way(), UP, TILT)
        assert back.add_position(k * TENTH, STAYS, true_pose(k)[1], 0.05**2 * np.eye(3))
    assert back.recoveries == 1
    assert np.linalg.norm(back.xyz_map_m - true_pose(59)[1]) < 0.03


def test_the_smoothers_list_of_factors_does_not_grow():
    back = started(Smoother(3.0), steps=50)
    before = back._smoother.getFactors().size()
    for k in range(51, 250):
        back.extend(k * TENTH, way(), UP, TILT)
        back.add_position(k * TENTH, STAYS, true_pose(k)[1], 0.05**2 * np.eye(3))
    assert back._smoother.getFactors().size() < before + 60
    assert len(back._keys) <= 31
