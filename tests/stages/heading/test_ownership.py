"""Whether the followed object is the drone; and the yaw by the autopilot's odometry with a compass that may be wrong."""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import rotation_z
from stages.heading.inertial_bank import NEAR_RAD, YawMixture
from stages.heading.odometry_heading import OdometryHeading
from stages.heading.ownership import Ownership, log_evidence

S = 1_000_000_000
NOISE = 0.1**2 * np.eye(3)


def followed(off_sigma_m: float, manoeuvre_m: float, count: int = 60) -> Ownership:
    """An object on a winding path; the IMU predicts it with an error."""
    rng, ownership = np.random.default_rng(1), Ownership()
    for k in range(count):
        t = 0.1 * k
        z = np.array([manoeuvre_m * math.sin(1.5 * t), manoeuvre_m * math.cos(1.1 * t), 20.0]) + rng.normal(0, 0.1, 3)
        off = rng.normal(0, math.hypot(0.1, off_sigma_m), 3)
        ownership.add(round(t * S), z, NOISE, log_evidence(off, NOISE + 0.03**2 * np.eye(3)))
    return ownership


def test_a_motion_that_the_imu_predicts_is_the_drone_s():
    assert followed(0.03, 2.0).certain
    assert not followed(0.03, 2.0).denied


def test_a_motion_that_the_imu_does_not_predict_is_another_object_s():
    ownership = followed(0.5, 2.0)
    assert ownership.denied
    assert ownership.excluded


def test_after_another_object_more_evidence_is_needed():
    ownership = Ownership()
    before = ownership.log_ratio
    ownership.restart(suspect=True)
    assert ownership.log_ratio < before
    assert not ownership.cleared


def test_without_a_prediction_nothing_is_concluded():
    ownership = Ownership()
    before = ownership.log_ratio
    for k in range(20):
        ownership.add(k * S // 10, np.array([0.1 * k, 0.0, 20.0]), NOISE, None)
    assert ownership.log_ratio == before


def odometry_heading(speed_mps: float = 2.0) -> OdometryHeading:
    heading, rng = OdometryHeading(math.radians(7.0), 0.03), np.random.default_rng(2)
    for k in range(25):
        t = 0.1 * k
        z = np.array([speed_mps * t, 0.3 * t**2, 20.0])
        heading.add(round(t * S), z + rng.normal(0, 0.05, 3), 0.05**2, rotation_z(-0.8) @ z, 0)
    return heading


def test_the_yaw_by_odometry_is_that_of_the_frame_and_the_attitude():
    evidence = odometry_heading().evidence(round(2.4 * S), rotation_z(-0.8 + 0.5))
    assert evidence is not None
    assert abs(evidence.yaw_rad - 0.5) < math.radians(5.0)


def test_evidence_never_exceeds_the_share_of_wrong_compasses():
    evidence = odometry_heading().evidence(round(2.4 * S), rotation_z(-0.3))
    assert evidence is not None
    sharp = YawMixture(np.array([evidence.yaw_rad, evidence.yaw_rad + 2.0]), np.full(2, 1e-6), np.full(2, 0.5))
    after = evidence.applied(sharp)
    here, far = after.weight[::2].sum(), after.weight[1::2].sum()
    density = math.sqrt(2 * math.pi) / evidence.sigma_rad  # of the right yaw, relative to a uniform one
    assert math.isclose(far / here, 0.03 / (0.97 * density + 0.03), rel_tol=1e-3)


def test_evidence_narrows_a_yaw_that_is_not_known_and_keeps_the_wrong_compass_as_a_hypothesis():
    evidence = odometry_heading().evidence(round(2.4 * S), rotation_z(-0.3))
    assert evidence is not None
    wide = YawMixture(2 * math.pi / 12 * np.arange(12), np.full(12, math.radians(18.0) ** 2), np.full(12, 1 / 12))
    after = evidence.applied(wide)
    best, near = after.best(NEAR_RAD)
    assert abs(math.remainder(after.yaw_rad[best] - evidence.yaw_rad, 2 * math.pi)) < math.radians(5.0)
    assert 0.93 < near < 0.999


def test_a_drone_that_hardly_moves_gives_no_yaw_by_odometry():
    slow = OdometryHeading(math.radians(7.0), 0.03)
    for k in range(20):
        slow.add(k * S // 10, np.array([0.01 * k, 0.0, 20.0]), 0.05**2, np.array([0.01 * k, 0.0, 20.0]), 0)
    assert slow.evidence(19 * S // 10, np.eye(3)) is None


def test_displacements_of_different_length_are_of_two_motions():
    heading = OdometryHeading(math.radians(7.0), 0.03)
    for k in range(25):
        heading.add(k * S // 10, np.array([0.4 * k, 0.0, 20.0]), 0.05**2, np.array([0.2 * k, 0.0, 20.0]), 0)
    assert heading.evidence(24 * S // 10, np.eye(3)) is None


def test_a_new_segment_of_the_odometry_starts_over():
    heading = odometry_heading()
    heading.add(round(2.5 * S), np.zeros(3), 0.05**2, np.zeros(3), 1)
    assert heading.evidence(round(2.5 * S), np.eye(3)) is None
