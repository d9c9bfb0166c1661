"""The velocity error against static walls, with pulses of a VLP-16 on its side in a courtyard."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.messages import SweptPulses
from stages.odometry.vehicle.lidar_consistency import LEAST_ESTIMATES, LidarConsistency
from stages.odometry.vehicle.static_scan import StaticScan, VelocityError

FIRING_S, REVOLUTION_S, FIRINGS = 55.296e-6, 0.1, 24
ELEVATION = np.radians(np.arange(-15.0, 16.0, 2.0))
WALLS = [(0, -20.0), (0, 20.0), (1, -8.0), (1, 8.0), (2, 12.0), (2, -1.8)]  # axis, coordinate [m]
ALONG_ONLY = [(1, -8.0), (1, 8.0), (2, 12.0), (2, -1.8)]  # a road between walls
S = 1_000_000_000


def cast(origin: np.ndarray, directions: np.ndarray, walls: list[tuple[int, float]]) -> np.ndarray:
    """Range to the nearest wall."""
    nearest = np.full(len(directions), np.inf)
    for axis, at_m in walls:
        with np.errstate(divide="ignore"):
            range_m = (at_m - origin[axis]) / directions[:, axis]
        nearest = np.where((range_m > 0) & (range_m < nearest), range_m, nearest)
    return np.where(nearest < 100, nearest, 0.0)


def slices(
    speed_mps: float,
    seconds: float,
    walls: list[tuple[int, float]],
    seed: int = 1,
    yaw_rad: float = 0.3,
    beams: np.ndarray = ELEVATION,
):
    """(slice, positions of the vehicle at its ends) along x; the fan's plane has the yaw `yaw_rad` against the motion."""
    lasers = len(beams)
    rng = np.random.default_rng(seed)
    for k in range(int(seconds / (FIRINGS * FIRING_S))):
        at_s = np.repeat((k * FIRINGS + np.arange(FIRINGS)) * FIRING_S, lasers)
        azimuth, elevation = 2 * np.pi * at_s / REVOLUTION_S, np.tile(beams, FIRINGS)
        fan = np.column_stack((np.cos(azimuth) * np.cos(elevation), np.sin(elevation), np.sin(azimuth)))
        fan[:, 2] *= np.cos(elevation)
        directions = fan @ rotation_z(yaw_rad).T
        origin = np.array([0.0, 0.0, 0.35])
        ends = tuple(np.array([speed_mps * t, 0.0, 0.0]) for t in (at_s[0], at_s[-1]))
        range_m = np.zeros(len(at_s))
        for row, t in enumerate(at_s[::lasers]):
            at = slice(lasers * row, lasers * row + lasers)
            range_m[at] = cast(origin + np.array([speed_mps * t, 0.0, 0.0]), directions[at], walls)
        range_m = np.where(range_m > 0, range_m + rng.normal(0, 0.02, len(range_m)), 0.0)
        yield (
            SweptPulses(
                stamp_ns=round(S * at_s[0]),
                point_stamp_ns=np.rint(S * at_s).astype(np.int64),
                direction_vehicle=directions.astype(np.float32),
                range_m=range_m.astype(np.float32),
                laser=np.tile(np.arange(lasers, dtype=np.uint8), FIRINGS),
                reflectivity=np.zeros(len(at_s), np.uint8),
                turntable_rad=0.0,
                origin_vehicle_m=(0.0, 0.0, 0.35),
            ),
            ends,
        )


def errors(speed_mps: float, reported: float, walls=WALLS, **scene) -> list[VelocityError]:
    """Velocity errors of an odometry that reports `reported` times the motion."""
    scan = StaticScan()
    found = [
        scan.add(pulses, *((np.eye(3), reported * at_m) for at_m in ends_m))
        for pulses, ends_m in slices(speed_mps, 1.2, walls, **scene)
    ]
    return [error for error in found if error is not None]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, -0.6, np.pi])
@pytest.mark.parametrize(
    ("speed_mps", "reported", "error_mps"), [(5.0, 1.0, 0.0), (5.0, 0.0, -5.0), (5.0, 1.1, 0.5), (-3.0, 0.0, 3.0)]
)
def test_the_error_of_the_reported_velocity_is_measured(
    speed_mps: float, reported: float, error_mps: float, yaw_rad: float
):
    found = errors(speed_mps, reported, yaw_rad=yaw_rad)
    assert len(found) >= 5
    np.testing.assert_allclose([e.error_mps for e in found], error_mps, atol=0.25)
    assert np.mean([e.error_mps for e in found]) == pytest.approx(error_mps, abs=0.12)
    assert found[-1].speed_mps == pytest.approx(abs(reported * speed_mps), abs=0.2)


def test_a_parked_vehicle_has_no_error():
    found = errors(0.0, 1.0)
    assert len(found) >= 5
    assert max(abs(e.error_mps) for e in found) < 0.25


def test_between_walls_along_the_road_nothing_is_measured():
    assert errors(5.0, 0.0, walls=ALONG_ONLY) == []


@pytest.mark.parametrize("beams_deg", [np.arange(-15.0, 16.0, 2.0) / 1.5, np.linspace(-16.0, 15.0, 32)])
def test_with_other_beams_nothing_is_measured(beams_deg: np.ndarray):
    """Puck Hi-Res and XT32."""
    assert errors(5.0, 0.0, beams=np.radians(beams_deg)) == []


def made(values: list[float], period_s: float = 0.1, speed_mps: float = 5.0) -> list[VelocityError]:
    return [VelocityError(round(i * period_s * S), value, 0.1, speed_mps) for i, value in enumerate(values)]


def contradicted(found: list[VelocityError]) -> tuple[int | None, bool]:
    """(index of the estimate that contradicted the motion, state at the end)."""
    consistency, at = LidarConsistency(), None
    for i, error in enumerate(found):
        if consistency.add(error) and at is None:
            at = i
    return at, consistency.contradicted


def test_two_gross_errors_in_succession_contradict_and_a_single_one_does_not():
    assert contradicted(made([0.0, -5.0, -5.0])) == (2, True)
    assert contradicted(made([0.0, -5.0, 0.1, 0.0] * 10)) == (None, False)
    assert contradicted(made([-5.0, 5.0] * 3)) == (None, False), "of different signs"
    assert contradicted(made([-5.0, -5.0], period_s=1.0)) == (None, False), "too far apart"


def test_a_small_error_of_constant_size_contradicts_and_an_ordinary_scale_error_does_not():
    rng = np.random.default_rng(1)
    at, state = contradicted(made(list(0.4 + 0.1 * rng.standard_normal(40))))
    assert at is not None
    assert at >= LEAST_ESTIMATES - 1
    assert state
    assert contradicted(made(list(0.1 + 0.2 * rng.standard_normal(400)))) == (None, False)
    fast = made(list(0.6 + 0.2 * rng.standard_normal(400)), speed_mps=30.0)
    assert contradicted(fast) == (None, False), "2 % of 30 m/s"


def test_the_motion_is_confirmed_again_by_several_good_estimates():
    at, state = contradicted(made([-5.0, -5.0] + [0.02] * (LEAST_ESTIMATES - 1)))
    assert (at, state) == (1, True)
    assert contradicted(made([-5.0, -5.0] + [0.02] * LEAST_ESTIMATES)) == (1, False)
