"""Single false IMU samples are left out; vibration and real changes are not false."""

from __future__ import annotations

import numpy as np
import pytest

from stages.odometry.drone import InertialMotion
from stages.odometry.drone.imu_outliers import FalseSamples
from tests.stages.odometry.drone.made_imu import imu

LIFT = np.array([0.0, 0.0, 9.81])


def found(force: np.ndarray, rate: np.ndarray, hz: float = 50.0) -> np.ndarray:
    """Whether each sample is found to be false."""
    check = FalseSamples()
    return np.array([check.add(round(1e9 * i / hz), f, w) for i, (f, w) in enumerate(zip(force, rate, strict=True))])


@pytest.mark.parametrize("hz", [50.0, 10.0])
@pytest.mark.parametrize("vibration_mps2", [0.1, 1.0, 5.0])
def test_vibration_alone_is_not_false(hz: float, vibration_mps2: float):
    rng = np.random.default_rng(1)
    force = LIFT + rng.normal(0, vibration_mps2, (2000, 3))
    assert not found(force, rng.normal(0, 0.05 * vibration_mps2, (2000, 3)), hz).any()


def test_a_fifth_of_gross_errors_is_found_and_no_other_sample():
    rng = np.random.default_rng(2)
    force, rate = LIFT + rng.normal(0, 0.3, (2000, 3)), rng.normal(0, 0.02, (2000, 3))
    false = rng.random(2000) < 0.2
    force[false] += rng.normal(0, 10.0, (int(false.sum()), 3))
    made = found(force, rate)
    assert made[30:][false[30:]].mean() > 0.9
    assert made[~false].mean() < 0.01


def test_a_change_that_persists_is_real_from_its_third_sample_on():
    rng = np.random.default_rng(3)
    rate = rng.normal(0, 0.02, (200, 3))
    rate[100:, 0] += 4.0
    made = found(LIFT + rng.normal(0, 0.3, (200, 3)), rate)
    np.testing.assert_array_equal(np.flatnonzero(made), [100, 101])


def test_the_interval_spans_a_false_sample():
    stage, rng = InertialMotion(), np.random.default_rng(4)
    motions = []
    for i in range(200):
        far = 30.0 if i == 150 else 0.0
        motions.append(stage.on_imu(imu(20 * i, acceleration_drone_mps2=LIFT + far + rng.normal(0, 0.3, 3))))
    assert motions[150] is None
    after = motions[151]
    assert after is not None
    assert after.stamp_ns - after.start_ns == 40_000_000
    assert after.segment == 0
    assert np.linalg.norm(after.specific_force_drone_mps2 - LIFT) < 2.0
    assert stage.counters["false samples"] == 1
