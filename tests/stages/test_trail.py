"""The vehicle's trail: between two poses, a little beyond the newest, and a vehicle that never tells."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry import rotation_from_rpy_deg, rotation_z
from stages.messages import VehicleMotion
from stages.trail import FURTHEST_NS, KEPT, VehicleTrail
from tests.stages.made import MS, START_NS


def motion(t_ns, xyz_m, R=None):
    return VehicleMotion(
        stamp_ns=START_NS + t_ns,
        xyz_start_m=np.asarray(xyz_m, dtype=np.float64),
        R_start_vehicle=np.eye(3) if R is None else R,
        covariance=None,
    )


def trail(*motions):
    made = VehicleTrail()
    for one in motions:
        made.add(one)
    return made


def test_a_vehicle_that_tells_nothing_stands_at_the_origin():
    R, t = trail().at(START_NS)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(t, np.zeros(3))
    assert not trail().known
    assert trail(motion(0, (1, 2, 3))).known


def test_places_between_two_poses_are_linear_in_time():
    made = trail(motion(0, (0, 0, 0)), motion(10 * MS, (1, 2, 3)), motion(20 * MS, (5, 2, 3)))
    np.testing.assert_allclose(made.at(START_NS + 5 * MS)[1], (0.5, 1.0, 1.5))
    np.testing.assert_allclose(made.at(START_NS + 10 * MS)[1], (1, 2, 3))
    np.testing.assert_allclose(made.at(START_NS + 15 * MS)[1], (3, 2, 3))


def test_turns_between_two_poses_are_rotations_half_way():
    about = rotation_from_rpy_deg((10.0, -20.0, 30.0))
    made = trail(motion(0, (0, 0, 0), about), motion(10 * MS, (0, 0, 0), about @ rotation_z(0.1)))
    R, _ = made.at(START_NS + 5 * MS)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R, about @ rotation_z(0.05), atol=1e-9)
    quarter, _ = made.at(START_NS + int(2.5 * MS))
    np.testing.assert_allclose(quarter, about @ rotation_z(0.025), atol=2e-5)


def test_beyond_the_newest_pose_it_drives_on_for_a_while_and_then_stands():
    made = trail(motion(0, (0, 0, 0)), motion(100 * MS, (1, 0, 0)))  # 10 m/s
    np.testing.assert_allclose(made.at(START_NS + 150 * MS)[1], (1.5, 0, 0))
    furthest = 1 + 10 * FURTHEST_NS / 1e9
    np.testing.assert_allclose(made.at(START_NS + 100 * MS + 10 * FURTHEST_NS)[1], (furthest, 0, 0))


def test_before_the_oldest_pose_it_stood_there():
    made = trail(motion(0, (1, 1, 1)), motion(100 * MS, (2, 1, 1)))
    np.testing.assert_allclose(made.at(START_NS - 50 * MS)[1], (1, 1, 1))
    np.testing.assert_allclose(trail(motion(0, (4, 5, 6))).at(START_NS + 999 * MS)[1], (4, 5, 6))


def test_a_pose_that_is_not_newer_is_ignored():
    made = trail(motion(0, (0, 0, 0)), motion(10 * MS, (1, 0, 0)), motion(10 * MS, (9, 9, 9)), motion(5 * MS, (9, 9, 9)))
    np.testing.assert_allclose(made.at(START_NS + 10 * MS)[1], (1, 0, 0))


def test_memory_is_bounded():
    made = trail(*(motion(i * MS, (i, 0, 0)) for i in range(3 * KEPT)))
    assert len(made._poses) == KEPT
    np.testing.assert_allclose(made.at(START_NS + (3 * KEPT - 2) * MS)[1], (3 * KEPT - 2, 0, 0))
