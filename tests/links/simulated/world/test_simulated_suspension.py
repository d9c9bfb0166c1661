"""A vehicle on its suspension: signs by hand, rest, roughness, repeatability."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.world.path import Path, Waypoint
from links.simulated.world.suspension import SuspendedPath, SuspensionSettings, oscillate

SMOOTH = SuspensionSettings(roughness_deg=0.0)
TIMES = np.arange(0.0, 6.0, 0.01)


class Steady(Path):
    """Constant acceleration from rest, heading along world y."""

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        a, t = np.array(self.waypoints[0].xyz_m), time_s[:, None]
        return 0.5 * a * t**2, a * t, a + 0 * t, np.full_like(time_s, np.pi / 2)


def _steady(*acceleration: float) -> np.ndarray:
    path = Steady(waypoints=(Waypoint(t_s=0, xyz_m=(acceleration[0], acceleration[1], 0.0)),))
    return SuspendedPath(path, SMOOTH, 6.0, 1).level_poses(np.array([5.0]))[0][0]


def test_accelerating_lifts_the_nose_and_braking_lowers_it() -> None:
    for a in (2.0, -3.0):
        nose = _steady(0.0, a) @ [1, 0, 0]
        assert np.degrees(np.arcsin(nose[2])) == pytest.approx(0.45 * a, rel=1e-3)
        assert nose[1] > 0.99


def test_in_a_left_turn_the_left_side_rises() -> None:
    left = _steady(-2.0, 0.0) @ [0, 1, 0]  # heading along y, left is -x
    assert np.degrees(np.arcsin(left[2])) == pytest.approx(0.9, rel=1e-3)


def test_a_parked_vehicle_is_level_whatever_the_road() -> None:
    parked = Path(waypoints=(Waypoint(t_s=0, xyz_m=(1, 2, 0), yaw_deg=30),))
    for got, expected in zip(
        SuspendedPath(parked, SuspensionSettings(), 6.0, 1).level_poses(TIMES), parked.level_poses(TIMES), strict=True
    ):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_the_suspension_overshoots_and_settles() -> None:
    angle = oscillate(np.vstack([np.zeros((1, 1)), np.ones((2399, 1))]), 2 * np.pi * 1.3, 0.35)[:, 0]
    assert angle.max() == pytest.approx(1 + np.exp(-np.pi * 0.35 / np.sqrt(1 - 0.35**2)), abs=0.02)
    assert angle[-1] == pytest.approx(1.0, abs=1e-3)


def test_the_road_shakes_a_moving_vehicle_and_its_camera() -> None:
    drive = Path(waypoints=tuple(Waypoint(t_s=t, xyz_m=(8 * t, 0, 0)) for t in (0, 10, 20)))
    R, p = SuspendedPath(drive, SuspensionSettings(), 20.0, 1).level_poses(np.arange(0, 20, 0.01))
    roll = np.degrees(np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    assert 0.1 < roll.std() < 0.6
    np.testing.assert_allclose(p[:, 1], 1.3 * R[:, 1, 2], atol=1e-9)
    same, other = (SuspendedPath(drive, SuspensionSettings(), 20.0, seed).level_poses(TIMES)[0] for seed in (1, 2))
    np.testing.assert_array_equal(same, SuspendedPath(drive, SuspensionSettings(), 20.0, 1).level_poses(TIMES)[0])
    assert np.abs(same - other).max() > 1e-3
