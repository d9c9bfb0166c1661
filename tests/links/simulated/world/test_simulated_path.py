"""Paths and the attitude along them."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from links.simulated.kernels.motion import DRAG_PER_S, GRAVITY_MPS2
from links.simulated.world.path import Path, Waypoint, natural_spline


def _path(*points: tuple[float, float, float, float], yaw_deg: float = 0.0) -> Path:
    return Path(waypoints=tuple(Waypoint(t_s=t, xyz_m=(x, y, z), yaw_deg=yaw_deg) for t, x, y, z in points))


def test_the_spline_passes_its_knots_and_its_derivatives_are_consistent() -> None:
    knot_s, knots = np.array([0.0, 1.0, 2.5, 4.0]), np.array([[0.0, 1], [2, 0], [1, 5], [3, 3]])
    np.testing.assert_allclose(natural_spline(knot_s, knots)(knot_s)[0], knots, atol=1e-12)
    t, d = np.array([0.3, 1.7, 3.2]), 1e-5
    _, slope, curve = natural_spline(knot_s, knots)(t)
    before, after = natural_spline(knot_s, knots)(t - d), natural_spline(knot_s, knots)(t + d)
    np.testing.assert_allclose(slope, (after[0] - before[0]) / (2 * d), atol=1e-6)
    np.testing.assert_allclose(curve, (after[1] - before[1]) / (2 * d), atol=1e-6)
    np.testing.assert_allclose(natural_spline(knot_s, knots)(np.array([0.0, 4.0]))[2], 0.0, atol=1e-12)


def test_a_straight_path_is_flown_at_constant_speed() -> None:
    position, velocity, acceleration, _ = _path((0, 0, 0, 5), (1, 2, 0, 5), (3, 6, 0, 5)).at(np.array([0.5, 2.0]))
    np.testing.assert_allclose(position, [[1, 0, 5], [4, 0, 5]], atol=1e-12)
    np.testing.assert_allclose(velocity, [[2, 0, 0], [2, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(acceleration, 0.0, atol=1e-12)


def test_a_hovering_drone_is_level_and_a_flying_one_tilts_against_its_drag() -> None:
    hover, _ = _path((0, 1, 2, 3), yaw_deg=90.0).flying_poses(np.zeros(1))
    np.testing.assert_allclose(hover[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    rotation, _ = _path((0, 0, 0, 5), (4, 32, 0, 5)).flying_poses(np.array([2.0]))
    assert np.arctan2(rotation[0, 0, 2], rotation[0, 2, 2]) == pytest.approx(np.arctan2(8 * DRAG_PER_S, GRAVITY_MPS2))
    np.testing.assert_allclose(rotation[0].T @ rotation[0], np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation[0]) == pytest.approx(1.0)


def test_before_and_after_its_waypoints_it_is_static() -> None:
    position, velocity, _, _ = _path((1, 0, 0, 5), (2, 2, 0, 5)).at(np.array([0.0, 9.0]))
    np.testing.assert_allclose(position, [[0, 0, 5], [2, 0, 5]])
    np.testing.assert_allclose(velocity, 0.0)


def test_times_that_do_not_increase_are_rejected() -> None:
    with pytest.raises(ValidationError, match="t_s must increase"):
        _path((0, 0, 0, 1), (0, 1, 0, 1))


def test_a_closed_path_is_smooth_and_its_yaw_gains_whole_turns() -> None:
    corners = [(5, 0), (0, 5), (-5, 0), (0, -5)]
    points = tuple(Waypoint(t_s=2.0 + 4 * k, xyz_m=(*xy, 6), yaw_deg=90 * k) for k, xy in enumerate(corners))
    path = Path(waypoints=points, period_s=16.0)
    t = np.linspace(0.0, 16.0, 50)
    one, third = path.at(t), path.at(t + 32.0)
    for a, b in zip(one[:3], third[:3], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(third[3] - one[3], 4 * np.pi, atol=1e-9)
    np.testing.assert_allclose(path.at(np.array([p.t_s for p in points]))[0], [p.xyz_m for p in points], atol=1e-9)
    seam = path.at(np.array([18.0 - 1e-7, 18.0 + 1e-7]))
    for values in seam:
        np.testing.assert_allclose(values[0], values[1], atol=1e-5)
    still = Path(waypoints=points[:1], period_s=1.0).at(t)
    np.testing.assert_allclose(still[0], [[5, 0, 6]] * 50)


@pytest.mark.parametrize(
    ("period_s", "text"), [(14.0, "longer than the time from the first to the last"), (20.04, "a multiple of 0.1 s")]
)
def test_an_impossible_period_is_rejected(period_s: float, text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        Path(waypoints=tuple(Waypoint(t_s=t, xyz_m=(t, 0, 5)) for t in (0.0, 14.0)), period_s=period_s)
