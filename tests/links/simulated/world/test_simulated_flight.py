"""The flown path: near its reference, with an attitude of its own, and consistent states."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from links.simulated.kernels.motion import DRAG_PER_S, GRAVITY_MPS2
from links.simulated.world.flight import Flight, FlightSettings
from links.simulated.world.path import Path, Waypoint

HOVER = Path(waypoints=(Waypoint(t_s=0, xyz_m=(5, 3, 10), yaw_deg=90),))
DASH = Path(
    waypoints=tuple(Waypoint(t_s=t, xyz_m=(x, 0, 10)) for t, x in [(0, 0), (4, 0), (6, 8), (9, 32), (11, 40), (16, 40)])
)
CALM = FlightSettings(gust_mps=0.0)
TIMES = np.arange(0.0, 14.0, 0.005)


def _turns(R: np.ndarray) -> np.ndarray:
    """Turn rate (n-1, 3) of rotations (n, 3, 3), body axes, from neighbours."""
    step = np.einsum("nji,njk->nik", R[:-1], R[1:])
    return np.stack([step[:, 2, 1], step[:, 0, 2], step[:, 1, 0]], axis=1) / 0.005


def test_in_calm_air_a_hover_stays_and_is_level() -> None:
    R, p = Flight(HOVER, CALM, 14.0, 1).flying_poses(TIMES)
    np.testing.assert_allclose(p, np.tile([5.0, 3.0, 10.0], (len(TIMES), 1)), atol=1e-6)
    np.testing.assert_allclose(R, np.tile([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (len(TIMES), 1, 1)), atol=1e-6)


def test_a_steady_wind_tilts_the_drone_by_its_drag() -> None:
    flight = Flight(HOVER, CALM.model_copy(update={"wind_world_mps": (6.0, 0.0, 0.0)}), 40.0, 1)
    R, p = flight.flying_poses(np.array([39.0]))
    np.testing.assert_allclose(p[0], [5, 3, 10], atol=0.02)
    assert np.arctan2(-R[0, 0, 2], R[0, 2, 2]) == pytest.approx(np.arctan2(6 * DRAG_PER_S, GRAVITY_MPS2), rel=0.02)


def test_the_attitude_differs_from_that_of_the_path_and_the_position_is_near_it() -> None:
    flight = Flight(DASH, CALM, 14.0, 1)
    R, p = flight.flying_poses(TIMES)
    R_path, p_path = DASH.flying_poses(TIMES)
    assert np.linalg.norm(p - p_path, axis=1).max() < 0.5
    tilt, tilt_path = (np.degrees(np.arctan2(r[:, 0, 2], r[:, 2, 2])) for r in (R, R_path))
    assert 0.2 < np.sqrt(np.mean((tilt - tilt_path) ** 2)) < 3.0
    assert np.abs(tilt - tilt_path).max() > 1.0
    R_gusty, _ = Flight(DASH, FlightSettings(), 14.0, 1).flying_poses(TIMES)
    assert np.degrees(np.sqrt(np.mean((R_gusty - R_path) ** 2))) > 0.5


class Kick(Path):
    """From rest to 3 m/s^2 at once, towards its waypoint: no drone can tilt that fast."""

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        along, since = np.array(self.waypoints[0].xyz_m), np.maximum(time_s - 1.0, 0.0)[:, None]
        a = np.where(since > 0, 3.0, 0.0)
        return 0.5 * a * since**2 * along, a * since * along, a * along, np.zeros_like(time_s)


@pytest.mark.parametrize("along", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])  # pitches, rolls
def test_a_tilt_step_has_the_lag_of_both_loops(along: tuple[float, float, float]) -> None:
    R, _ = Flight(Kick(waypoints=(Waypoint(t_s=0, xyz_m=along),)), CALM, 3.0, 1).flying_poses(TIMES[:600])
    tilt = np.arctan2(R[:, :, 2] @ along, R[:, 2, 2])
    assert np.abs(tilt[:200]).max() < 1e-6
    half_s = TIMES[np.argmax(tilt > 0.5 * np.arctan2(3.0, GRAVITY_MPS2))] - 1.0
    assert 0.08 < half_s < 0.2  # 1/8 s of the attitude loop, 0.05 s of the rate loop: half at ln 2 of their sum


@pytest.mark.parametrize("settings", [CALM, FlightSettings(gust_mps=2.0, wind_world_mps=(4.0, -3.0, 0.0))])
def test_velocity_turn_rate_and_force_are_those_of_the_poses(settings: FlightSettings) -> None:
    flight = Flight(DASH, settings, 14.0, 2)
    R, p = flight.flying_poses(TIMES)
    _, v, a, yaw = flight.at(TIMES)
    rate, force = flight.imu(TIMES)
    np.testing.assert_allclose(np.diff(p, axis=0) / 0.005, 0.5 * (v[1:] + v[:-1]), atol=0.01)
    np.testing.assert_allclose(_turns(R), 0.5 * (rate[1:] + rate[:-1]), atol=0.03)
    np.testing.assert_allclose(np.diff(v, axis=0) / 0.005, 0.5 * (a[1:] + a[:-1]), atol=0.3)
    lifted = np.einsum("nij,nj->ni", R, force) - [0.0, 0.0, GRAVITY_MPS2]
    np.testing.assert_allclose(lifted, a, atol=1e-9)
    np.testing.assert_allclose(yaw, np.arctan2(R[:, 1, 0], R[:, 0, 0]))


def test_limits_of_rate_and_tilt_are_kept() -> None:
    hard = CALM.model_copy(update={"rate_limit_degps": 30.0, "tilt_limit_deg": 15.0, "yaw_rate_limit_degps": 20.0})
    spin = Path(waypoints=(*DASH.waypoints[:-1], Waypoint(t_s=16, xyz_m=(40, 0, 10), yaw_deg=300)))
    R, _ = Flight(spin, hard, 14.0, 1).flying_poses(TIMES)
    rate_degps = np.degrees(np.abs(_turns(R)))
    assert rate_degps[:, :2].max() < 31.0
    assert rate_degps[:, 2].max() < 20.5
    assert np.degrees(np.arccos(R[100:, 2, 2])).max() < 19.0  # the limit and a little overshoot


def test_gusts_move_it_more_when_stronger_and_differ_by_seed() -> None:
    def rms(gust: float, seed: int) -> float:
        p = Flight(HOVER, CALM.model_copy(update={"gust_mps": gust}), 14.0, seed).flying_poses(TIMES)[1]
        return float(np.sqrt(np.mean((p - [5, 3, 10]) ** 2)))

    assert 2.0 < rms(2.0, 1) / rms(0.5, 1) < 6.0
    assert rms(1.0, 1) == rms(1.0, 1)
    assert rms(1.0, 1) != rms(1.0, 2)


def test_outside_its_time_it_has_its_first_or_last_state() -> None:
    flight = Flight(DASH, CALM, 4.0, 1)
    p = flight.flying_poses(np.array([-5.0, 0.0, 5.0, 99.0]))[1]
    np.testing.assert_array_equal(p[0], p[1])
    np.testing.assert_array_equal(p[2], p[3])


def test_an_impossible_drone_is_rejected() -> None:
    for wrong in ({"rate_lag_s": 0.001}, {"tilt_limit_deg": 90.0}, {"gusts": 1.0}):
        with pytest.raises(ValidationError):
            FlightSettings.model_validate(wrong)


def test_all_laps_of_a_closed_path_are_flown_alike_without_a_jump() -> None:
    square = tuple(
        Waypoint(t_s=4.0 * k, xyz_m=(5 * x, 5 * y, 8), yaw_deg=90 * k)
        for k, (x, y) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)])
    )
    flight = Flight(Path(waypoints=square, period_s=16.0), FlightSettings(gust_mps=1.0), 1.0, 3)
    t = np.linspace(0.0, 15.99, 400)
    for now, later in zip(flight.flying_poses(t), flight.flying_poses(t + 48.0), strict=True):
        np.testing.assert_allclose(now, later, atol=1e-9)
    assert np.ptp(flight.flying_poses(t)[1][:, 0]) > 8.0
    near = np.arange(15.9, 16.1, 1 / 400)
    R, p = flight.flying_poses(near)
    v = flight.at(near)[1]
    np.testing.assert_allclose(np.diff(p, axis=0) * 400, (v[1:] + v[:-1]) / 2, atol=0.02)
    assert np.abs(np.diff(v, axis=0)).max() < 0.03
    assert np.abs(np.diff(R, axis=0)).max() < 0.02
