"""What of an external position ArduPilot's EKF3 takes: its noise with and without GPS, the height, yaw resets, counts."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.autopilot.flight_stack.estimation.ekf2 import Ekf2
from links.simulated.autopilot.flight_stack.estimation.ekf3 import LEAST_POSITION_NOISE_M, Ekf3
from links.simulated.autopilot.flight_stack.estimation.observations import External
from links.simulated.autopilot.flight_stack.estimation.source_rules import SOURCE_SETS
from links.simulated.autopilot.flight_stack.sensors import GpsFix
from links.simulated.autopilot.flight_stack.settings import GpsSettings
from links.simulated.autopilot.flight_stack.telemetry import imu_counts

MS = 1_000_000
SIGMA_M = 0.2
AT_REST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.80665]) * 0.01


def fly(core: Ekf3, seconds: float, height_m: float | None = None, gps: bool = False, begin_ms: int = 0) -> int:
    """Ticks at rest with external poses at 50 Hz and GPS at 5 Hz; returns the time [ms]."""
    now_ms = begin_ms
    for now_ms in range(begin_ms + 10, begin_ms + round(1000 * seconds), 10):
        if gps and now_ms % 200 == 0:
            core.write_gps(GpsFix(now_ms * MS, np.zeros(3), np.zeros(3)))
        if height_m is not None and now_ms % 20 == 0:
            core.write_external(
                External(now_ms * MS, np.array([0.0, 0.0, height_m]), 0.0, None, SIGMA_M, 0.1, reset=False)
            )
        if now_ms % 100 == 0:
            core.write_baro(now_ms * MS, 0.0)
            core.write_compass(now_ms * MS, 0.0)
        core.step(now_ms * MS, AT_REST)
    return now_ms


def core_of(*sets: str, reported_m: float = 0.8, cls: type[Ekf3] = Ekf3) -> Ekf3:
    return cls(tuple(SOURCE_SETS[name] for name in sets), 0, GpsSettings(reported_m=reported_m), 0.0)


@pytest.mark.parametrize(
    ("cls", "gps", "reported_m", "sigma_m"),
    [
        (Ekf3, False, 0.8, SIGMA_M),
        (Ekf3, True, 0.8, 0.8),
        (Ekf3, True, 0.1, LEAST_POSITION_NOISE_M),
        (Ekf3, True, 3.0, 3.0),
        (Ekf2, True, 3.0, SIGMA_M),
    ],
)
def test_with_gps_an_external_position_has_the_noise_of_gps(
    cls: type[Ekf3], gps: bool, reported_m: float, sigma_m: float
) -> None:
    """In a steady state the variance of the position grows with that of the measurement."""
    core, same = (core_of("external_position", reported_m=reported_m, cls=cls) for _ in range(2))
    fly(core, 20.0, 0.0, gps)
    assert core.aiding
    pose = External(0, np.zeros(3), 0.0, None, SIGMA_M, 0.1, reset=False)
    assert core._external_variance_m2(pose) == pytest.approx(sigma_m**2)
    fly(same, 20.0, 0.0, gps=False)
    looser = core.lane.P[0, 0] / same.lane.P[0, 0]
    assert looser == pytest.approx(1.0, rel=0.01) if sigma_m == SIGMA_M else looser > 1.5


def test_aiding_that_begins_with_an_external_position_takes_its_height() -> None:
    """The barometer is the source of the height, and pulls it back."""
    core = core_of("external_position")
    now_ms = fly(core, 1.0)
    assert abs(core.lane.x[2]) < 0.2
    now_ms = fly(core, 1.0, 5.0, begin_ms=now_ms)
    assert core.aiding
    assert core.lane.x[2] > 3.0
    fly(core, 60.0, 5.0, begin_ms=now_ms)
    assert abs(core.lane.x[2]) < 1.0


@pytest.mark.parametrize(("source", "resets"), [("gps", True), ("external_position", False)])
def test_a_yaw_reset_is_made_with_gps_only(source: str, resets: bool) -> None:
    core = core_of(source)
    now_ms = fly(core, 2.0, 0.0, gps=True)
    core.lane.resets.clear()
    core.request_yaw_reset()
    fly(core, 0.5, 0.0, gps=True, begin_ms=now_ms)
    assert bool(core.lane.resets) == resets


def test_counts_are_truncated() -> None:
    sample = np.array([0.0019, -0.0019, 0.0, 0.0, 0.0, 9.80665 * 1.0009])
    assert imu_counts(sample) == [0, 0, -1000, 1, 1, 0]
