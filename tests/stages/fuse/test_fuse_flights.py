"""Flights by IMU over seeds: when the heading is decided, errors and their consistency, gaps, CPU time.

python -m pytest -m slow -n 0 tests/stages/fuse/test_fuse_flights.py -s     tables, about 15 min
SEEDS=50 before it                                                                      more flights a line
"""

from __future__ import annotations

import math
import os

import numpy as np
import pytest

from tests.stages.fuse.imu_flights import ImuFlight
from tests.stages.fuse.judged import HEADER, fly, rms, row

SEEDS = int(os.environ.get("SEEDS", "10"))
VARIANTS = {
    "IMU 50 Hz": {},
    "IMU 25 Hz": {"imu_hz": 25},
    "IMU 10 Hz": {"imu_hz": 10},
    "vib. 1.0": {"vibration_mps2": 1.0},
    "driving": {"vehicle_mps": 5.0},
    "odometry": {"odometry": True},
    "compass 30": {"odometry": True, "compass_deg": 30.0},
    "cameras": {"rotations": True, "images": True},
    "VP only": {"rotations": True},
    "no IMU": {"imu_hz": 0, "rotations": True, "images": True},
}
FLIGHTS = ("orbit", "square", "manoeuvre", "fast")


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_no_heading_is_decided_wrong(name):
    print(f"\n{HEADER}")  # noqa: T201
    for kind in FLIGHTS:
        flown = [fly(ImuFlight(kind=kind, seed=seed, until_s=40.0, **VARIANTS[name])) for seed in range(SEEDS)]
        print(row(name, kind, flown), flush=True)  # noqa: T201
        assert not any(f.wrong for f in flown), (name, kind)
        error = np.concatenate([f.error_m for f in flown])
        assert np.percentile(error, 95) <= (0.25 if name != "no IMU" else 0.35)
        if kind in ("square", "manoeuvre", "fast") and name not in ("no IMU",):
            assert np.median([f.decided_s for f in flown]) <= 10.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["IMU 50 Hz", "vib. 1.0", "cameras"])
def test_the_covariance_is_honest_in_a_gap_without_lidar_positions(name):
    gaps = {1: (15.0, 16.0), 2: (19.0, 21.0), 5: (25.0, 30.0)}
    print("\nvariant    flight    | gap [s]: error RMS / sigma of the position (3 axes) [m], NEES (3)")  # noqa: T201
    for kind in ("square", "manoeuvre"):
        flown = [
            fly(ImuFlight(kind=kind, seed=s, until_s=33.0, gaps_s=tuple(gaps.values()), **VARIANTS[name]))
            for s in range(SEEDS)
        ]
        for length, (_, end_s) in gaps.items():
            at = [(f, int(np.searchsorted(f.at_s, end_s)) - 1) for f in flown]
            near = [(f, k) for f, k in at if abs(f.at_s[k] - end_s) < 0.05]
            if not near:
                print(f"{name:10s} {kind:9s} | {length}: LOST before its end in all")  # noqa: T201
                continue
            error = rms(np.array([f.error_m[k] for f, k in near]))
            sigma = math.sqrt(3 * np.mean([f.sigma_m[k] ** 2 for f, k in near]))
            nees = float(np.mean([f.nees_position[k] for f, k in near]))
            print(f"{name:10s} {kind:9s} | {length}: {error:.2f} / {sigma:.2f}, {nees:.1f} ({len(near)} flights)")  # noqa: T201
            assert nees < 3.0 + 4.0 * math.sqrt(6.0 / len(near)), (name, kind, length)
