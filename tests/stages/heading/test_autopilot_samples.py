"""Verticals and odometry of the autopilot at the time of a measurement."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.autopilot_samples import KEPT, NEAR_NS, AutopilotSamples
from stages.messages import AutopilotMotion, DroneMotion

MS = 1_000_000
V = np.array([2.0, -1.0, 0.5])


def motion(at_ms, up=(0.0, 0.0, 1.0), own=True, segment=3):
    t = at_ms * 1e-3
    odometry = AutopilotMotion(xyz_odom_m=t * V, R_odom_drone=rotation_z(t), velocity_odom_mps=V, odom_segment=segment)
    return DroneMotion(
        stamp_ns=at_ms * MS,
        start_ns=(at_ms - 20) * MS,
        segment=0,
        specific_force_drone_mps2=np.array([0.0, 0.0, 9.8]),
        angular_velocity_drone_radps=np.zeros(3),
        specific_force_noise=np.full(3, 0.01),
        angular_velocity_noise=np.full(3, 0.001),
        up_drone=None if up is None else np.array(up),
        autopilot=odometry if own else None,
    )


def samples(*motions):
    out = AutopilotSamples()
    for one in motions:
        out.add(one)
    return out


def test_without_samples_nothing_is_known():
    assert AutopilotSamples().up_drone(0) is None
    assert AutopilotSamples().odometry(0) is None


def test_the_nearest_sample_gives_the_vertical():
    kept = samples(motion(1000, (0.1, 0.0, 0.99)), motion(1100, (0.2, 0.0, 0.98)))
    assert kept.up_drone(1040 * MS)[0] == 0.1
    assert kept.up_drone(1060 * MS)[0] == 0.2


@pytest.mark.parametrize("off_ms", [-60, 0, 90])
def test_the_position_is_propagated_to_the_time_by_the_velocity(off_ms):
    sample = samples(motion(1000)).odometry((1000 + off_ms) * MS)
    assert np.allclose(sample.xyz_odom_m, (1.0 + 1e-3 * off_ms) * V)
    assert np.allclose(sample.R_odom_drone, rotation_z(1.0))
    assert sample.segment == 3


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_sample_too_far_in_time_is_not_used(sign):
    kept, at_ns = samples(motion(1000)), 1000 * MS
    assert kept.odometry(at_ns + sign * NEAR_NS) is not None
    assert kept.odometry(at_ns + sign * (NEAR_NS + MS)) is None
    assert kept.up_drone(at_ns + sign * (NEAR_NS + MS)) is None


def test_the_vertical_stays_when_the_odometry_is_no_longer_independent():
    kept = samples(motion(1000), motion(1020, own=False))
    assert kept.up_drone(1020 * MS) is not None
    assert kept.odometry(1020 * MS) is None


def test_a_motion_without_either_is_not_kept():
    kept = samples(motion(1000), motion(1020, up=None, own=False))
    assert kept.odometry(1020 * MS) is not None  # by the sample before
    for k in range(3 * KEPT):
        kept.add(motion(1040 + 20 * k))
    assert len(kept._motions) == KEPT
