"""The velocity error against static surfaces, with pulses of each LiDAR model on its side in a courtyard or street."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.rig.scenario import RigLidar as SimulatedLidar  # an Ouster has the staggered beams of a unit
from stages.geometry.frames import rotation_from_rpy_deg
from stages.geometry.lidar_models import LIDAR_MODELS
from stages.geometry.rig_lidar import RigLidar
from stages.kernels.odometry.scan_residuals import scan_residuals
from stages.messages import SweptPulses
from stages.odometry.vehicle.lidar_consistency import LEAST_ESTIMATES, LidarConsistency
from stages.odometry.vehicle.static_scan import Fan, PosedSlice, StaticScan, VelocityError, revolution_of

REVOLUTION_S, SLICE_S = 0.1, 0.0025
R_TURNTABLE_LIDAR = rotation_from_rpy_deg((90.0, 0.0, 0.0))
WALLS = [(0, -20.0), (0, 20.0), (1, -8.0), (1, 8.0), (2, 12.0), (2, -1.8)]  # axis, coordinate [m]
ALONG_ONLY = [(1, -8.0), (1, 8.0), (2, 12.0), (2, -1.8)]  # a road between walls
FIELD = [(2, -1.8)]
STREET = [  # corners of boxes [m]: the ground, houses with set-backs on both sides and at the ends, a parked van
    ((-200, -200, -3), (200, 200, -1.8)),
    ((-60, 8, -1.8), (-12, 20, 14)),
    ((-9, 6, -1.8), (4, 20, 9)),
    ((6, 11, -1.8), (15, 20, 14)),
    ((18, 7, -1.8), (60, 20, 11)),
    ((-60, -20, -1.8), (-16, -7, 10)),
    ((-11, -20, -1.8), (1, -9, 13)),
    ((5, -20, -1.8), (13, -7, 8)),
    ((17, -20, -1.8), (60, -10, 15)),
    ((-40, -30, -1.8), (-22, 30, 12)),
    ((28, -30, -1.8), (40, 30, 12)),
    ((8, 3.5, -1.8), (13, 5.5, 0.8)),
]
S = 1_000_000_000


def cast(origin: np.ndarray, directions: np.ndarray, scene: list) -> np.ndarray:
    """Range (n,) to the nearest wall or box, along directions (n, 3) from origins (n, 3); 0: beyond 60 m."""
    nearest = np.full(len(directions), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for low, high in scene:
            if isinstance(low, int):  # a wall
                range_m = (high - origin[:, low]) / directions[:, low]
            else:
                entry, leave = ((np.array(corner) - origin) / directions for corner in (low, high))
                range_m = np.minimum(entry, leave).max(axis=1)
                range_m[range_m > np.maximum(entry, leave).min(axis=1)] = np.inf
            nearest = np.where((range_m > 0) & (range_m < nearest), range_m, nearest)
    return np.where(nearest < 60, nearest, 0.0)


def slices(
    speed_mps: float,
    seconds: float,
    scene: list,
    seed: int = 1,
    yaw_rad: float = 0.3,
    unit: RigLidar | None = None,
    turn_radps: float = 0.0,
):
    """(slice, positions of the vehicle at its ends) along x; the turntable is at `yaw_rad` and turns by `turn_radps`."""
    unit = unit or RigLidar()
    profile, rng = unit.profile, np.random.default_rng(seed)
    lasers, firings = profile.lasers, round(SLICE_S * S / sequence_ns(unit))
    fires_s = 1e-9 * np.tile(profile.firing_ns, firings)
    elevation, offset = np.tile(unit.elevation_rad, firings), np.tile(unit.azimuth_offset_rad, firings)
    delay_s = 1e-9 * np.tile(unit.azimuth_delay_ns, firings)
    bias_m = rng.normal(0, 0.01, lasers)
    for k in range(round(seconds / (firings * 1e-9 * sequence_ns(unit)))):
        at_s = np.repeat((k * firings + np.arange(firings)) * 1e-9 * sequence_ns(unit), lasers) + fires_s
        azimuth = 2 * np.pi * (at_s - delay_s) / REVOLUTION_S + offset
        level = np.cos(elevation)
        lidar = np.column_stack((level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)))
        c, s = np.cos(yaw_rad + turn_radps * at_s), np.sin(yaw_rad + turn_radps * at_s)
        x, y, z = (lidar @ R_TURNTABLE_LIDAR.T).T
        directions = np.column_stack((c * x - s * y, s * x + c * y, z))
        at_m = np.column_stack((speed_mps * at_s, np.zeros_like(at_s), np.zeros_like(at_s)))
        range_m = cast(at_m + np.array([0.0, 0.0, 0.35]), directions, scene)
        noise_m = np.tile(bias_m, firings) + rng.normal(0, 0.02, len(range_m))
        yield (
            SweptPulses(
                stamp_ns=round(S * at_s[0]),
                point_stamp_ns=np.rint(S * at_s).astype(np.int64),
                direction_vehicle=directions.astype(np.float32),
                range_m=np.where(range_m > 0, range_m + noise_m, 0.0).astype(np.float32),
                laser=np.tile(np.arange(lasers, dtype=np.uint8), firings),
                reflectivity=np.zeros(len(at_s), np.uint8),
                turntable_rad=yaw_rad + turn_radps * float(at_s.mean()),
                origin_vehicle_m=(0.0, 0.0, 0.35),
            ),
            (at_m[0], at_m[-1]),
        )


def sequence_ns(unit: RigLidar) -> int:
    """Time from one firing sequence to the next."""
    return round(REVOLUTION_S * S / unit.beams.columns) if unit.beams else unit.profile.sequence_ns


def errors(speed_mps: float, reported: float, scene=WALLS, seconds=1.2, **values) -> list[VelocityError]:
    """Velocity errors of an odometry that reports `reported` times the motion."""
    cast_slices = list(slices(speed_mps, seconds, scene, **values))
    return measured(cast_slices, lambda at_s, at_m: reported * at_m, values.get("unit"))


def measured(cast_slices, reported_m, unit: RigLidar | None = None) -> list[VelocityError]:
    """Velocity errors of an odometry that reports the position `reported_m(time [s], true position)`."""
    scan = StaticScan(unit or RigLidar())
    found = []
    for pulses, ends_m in cast_slices:
        ends_s = pulses.point_stamp_ns[[0, -1]] / S
        poses = [(np.eye(3), reported_m(at_s, at_m)) for at_s, at_m in zip(ends_s, ends_m, strict=True)]
        found.append(scan.add(pulses, *poses))
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


@pytest.mark.parametrize("speed_mps", [0.0, 5.0])
@pytest.mark.parametrize("model", LIDAR_MODELS)
def test_each_model_measures_the_error_in_a_street_within_its_sigma(model: str, speed_mps: float):
    """On a turntable that sweeps at 11.4 rpm."""
    unit = SimulatedLidar.model_validate({"model": model})
    cast_slices = list(slices(speed_mps, 0.45, STREET, yaw_rad=-0.3, unit=unit, turn_radps=1.2))
    for scale, error_mps in ((1.0, 0.0), (1.0, 0.5), (1.05, 0.0)):

        def reported_m(at_s: float, at_m: np.ndarray, scale: float = scale, error_mps: float = error_mps) -> np.ndarray:
            return scale * at_m + np.array([error_mps * at_s, 0.0, 0.0])

        found = measured(cast_slices, reported_m, unit)
        expected_mps = (scale - 1.0) * speed_mps + error_mps
        assert len(found) >= 2
        for e in found:
            assert abs(e.error_mps - expected_mps) < 3 * e.sigma_mps
            assert e.sigma_mps < 0.15


@pytest.mark.parametrize("model", LIDAR_MODELS)
def test_the_beam_to_a_point_passes_the_cell_of_this_point(model: str):
    unit = SimulatedLidar.model_validate({"model": model})
    fan, at_rest = Fan(unit), (np.eye(3), np.zeros(3))
    cast_slices = slices(0.0, REVOLUTION_S, STREET, unit=unit, turn_radps=1.2)
    revolution = revolution_of(fan, [PosedSlice(pulses, at_rest, at_rest) for pulses, _ in cast_slices], 2 * np.pi)
    rows = scan_residuals(revolution, revolution, fan.between_rad, 1, 3.5)
    assert len(rows) > 0.15 * revolution.range_m.size
    assert np.mean((rows[:, 0] == 0.0) & (rows[:, 4] == 0.0)) > 0.99, "distance and time"


@pytest.mark.parametrize("scene", [ALONG_ONLY, FIELD])
@pytest.mark.parametrize("model", LIDAR_MODELS)
def test_between_walls_along_the_road_and_in_a_field_nothing_is_measured(model: str, scene: list):
    unit = SimulatedLidar.model_validate({"model": model})
    assert errors(5.0, 0.0, scene, 0.33, unit=unit) == []


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
