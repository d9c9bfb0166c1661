"""A heading from motion alone: any direction, within its sigma, and none from displacements of another object."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.heading.heading_bank import Heading, HeadingBank
from stages.heading.hypothesis_bank import BranchSettings, Displacement

S = 1_000_000_000
H = HeadingBank.HYPOTHESES


def window(way_m, heading_deg, start_s, drift_mps=(0.0, 0.0)) -> Displacement:
    """Displacement by odometry and by LiDAR over 1 s, turned by a heading."""
    a = math.radians(heading_deg)
    R = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    lidar = R @ np.asarray(way_m) + drift_mps
    start_ns = round(start_s * S) + S
    return Displacement(
        start_ns, start_ns + S, np.tile(lidar, (H, 1)), 0.05**2 * np.eye(2), np.asarray(way_m, float), 0.0, True
    )


def heading_of(heading_deg, windows, speed_mps=2.0, drift_mps=(0.0, 0.0)) -> Heading | None:
    """Heading of a drone that flies in circles of 8 s."""
    bank = HeadingBank(BranchSettings())
    for i in range(windows):
        turn = 2 * math.pi * i / 8
        bank.see(window(speed_mps * np.array([math.cos(turn), math.sin(turn)]), heading_deg, i, drift_mps))
    return bank.heading


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 121.0, -147.0])
@pytest.mark.parametrize("drift_mps", [(0.0, 0.0), (0.15, -0.1)])
def test_motion_in_all_directions_determines_any_heading_within_its_sigma_despite_drift(heading_deg, drift_mps):
    heading = heading_of(heading_deg, 16, drift_mps=drift_mps)
    assert heading is not None
    off = math.remainder(heading.turn_rad - math.radians(heading_deg), 2 * math.pi)
    assert abs(off) < 3.0 * heading.sigma_rad
    assert heading.sigma_rad < math.radians(3.0)


def test_little_motion_gives_no_heading_and_more_motion_a_smaller_sigma():
    assert heading_of(20.0, 2) is None
    assert heading_of(20.0, 12, speed_mps=0.3) is None
    assert heading_of(20.0, 24).sigma_rad < heading_of(20.0, 8).sigma_rad


def test_motion_of_another_object_gives_no_heading():
    bank, rng = HeadingBank(BranchSettings()), np.random.default_rng(4)
    for i in range(12):
        bank.see(window(rng.normal(0, 2, 2), rng.uniform(-180, 180), i))
        assert bank.heading is None
