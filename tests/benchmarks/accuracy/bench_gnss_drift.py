"""Drift and noise of a real GNSS receiver: position minus integrated Doppler velocity, of a logged flight.

python -m pytest tests/benchmarks/accuracy/bench_gnss_drift.py -s      needs ../shared/data/mavlink

The difference contains the errors of position and velocity: an upper bound of the drift of the position. The velocity
is that of the solution; of its delays by up to 0.2 s against the position the one with the smallest changes is taken.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

LOG = Path(__file__).resolve().parents[4] / "shared" / "data" / "mavlink" / "copter_dataflash_imu50.bin"
SPANS_S = (0.2, 1.0, 5.0, 10.0, 60.0)


def positions_and_velocities() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), positions north, east, up (n, 3) and velocities (n, 3) of the receiver's solutions in 3D."""
    from pymavlink import DFReader

    log, rows = DFReader.DFReader_binary(str(LOG)), []
    while (m := log.recv_match(type="GPS")) is not None:
        if m.Status >= 3:
            rows.append((1e-3 * m.TimeMS, m.Lat, m.Lng, m.Alt, m.Spd, math.radians(m.GCrs), -m.VZ))
    t, lat, lon, up, speed, course, climb = np.array(rows).T
    scale = math.radians(1.0) * 6_371_000.0
    east = (lon - lon[0]) * scale * math.cos(math.radians(lat[0]))
    velocity = np.column_stack([speed * np.cos(course), speed * np.sin(course), climb])
    return t, np.column_stack([(lat - lat[0]) * scale, east, up]), velocity


def changes_m(delay_s: float) -> np.ndarray:
    """(len(SPANS_S), 3) standard deviation of the change of the difference within each span."""
    t, position, velocity = positions_and_velocities()
    delayed = np.column_stack([np.interp(t, t + delay_s, velocity[:, k]) for k in range(3)])
    steps = 0.5 * (delayed[1:] + delayed[:-1]) * np.diff(t)[:, None]
    off = position - np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    spans = [max(1, round(s / 0.2)) for s in SPANS_S]
    return np.array([(off[k:] - off[:-k]).std(axis=0) for k in spans])


def test_drift_of_a_real_receiver():
    if not LOG.is_file():
        pytest.skip(f"needs {LOG}")
    best = min((changes_m(delay) for delay in (-0.2, -0.1, 0.0, 0.1, 0.2)), key=lambda c: float(c[1, :2].sum()))
    print("\nspan [s]: change north, east, up [m]; as a random walk [m/sqrt(s)]")  # noqa: T201
    for span, change in zip(SPANS_S, best, strict=True):
        print(f"{span:5.1f}: {np.round(change, 3)}  {np.round(change / math.sqrt(span), 3)}")  # noqa: T201
    assert best[0].max() < 0.03
    assert (best[1:, :2] / np.sqrt(SPANS_S[1:])[:, None]).max() < 0.13
