"""Errors of what the fusion receives in recorded flights, from which its constants were taken.

    GRD_FLIGHTS='out/cells/*.mcap' python -m pytest tests/benchmarks/accuracy/bench_measured_errors.py -s

LiDAR positions: variance about their mean over the reported one, its correlation in time, and the variance of the mean
over that of the reported bias (stages/fuse/settings.py). Matches of both cameras: the constants of the softmax that
maximise the likelihood of the true matches (stages/align/spectra.py), with flights that have cameras, as made by

    grd matrix out/cells --only '*-20m-orbit-driving' --only '*-20m-cross-parked' --odometry --autopilot --cameras 5
"""

from __future__ import annotations

import functools
import glob
import math
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from stages.align.joint_align import JointAlignSettings
from stages.align.pairing import Pairing
from stages.align.spectra import level_lines, overlap, peaks, quarter_difference, spectrum
from tests.stages.fuse.flown import RecordedFlight, recorded_inputs

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
FLIGHTS = sorted(glob.glob(os.environ.get("GRD_FLIGHTS", "")))
LAGS_S = (0.1, 0.2, 0.3, 0.5, 1.0)
RIGHT_RAD, APART_RAD, STRAIGHT_RAD = math.radians(3.0), math.radians(4.0), math.radians(0.25)
pytestmark = pytest.mark.skipif(not FLIGHTS, reason="set GRD_FLIGHTS to recordings of flights with truth")


@functools.cache
def flight(recording: str, consumer: str) -> RecordedFlight:
    return recorded_inputs(Path(recording), CONFIGS / "vision.yaml", consumer)


def fix_errors(flown: RecordedFlight) -> tuple[float, float, list[float]] | None:
    """Variance over the reported one, of the mean over that of the bias, and correlations at LAGS_S."""
    fixes = [m for _, port, m in flown.events if port == "fix" and flown.truth(m.stamp_ns) is not None]
    fixes = [m for m in fixes if np.linalg.norm(m.xyz_vehicle_m - flown.truth(m.stamp_ns)[1]) < 1.0]
    if len(fixes) < 30 or fixes[0].bias_covariance_m2 is None:
        return None
    error = np.array([m.xyz_vehicle_m - flown.truth(m.stamp_ns)[1] for m in fixes])
    bias = np.array([m.bias_covariance_m2 for m in fixes])
    white, mean = np.array([m.covariance_m2 for m in fixes]) - bias, error.mean(axis=0)
    off, t = error - mean, np.array([m.stamp_ns for m in fixes]) * 1e-9
    varying = float(np.mean([e @ np.linalg.solve(C, e) for e, C in zip(off, white, strict=True)])) / 3
    constant = float(mean @ np.linalg.solve(bias.mean(axis=0), mean)) / 3
    apart_s, products = t[None, :] - t[:, None], off @ off.T
    power = float(np.mean(np.sum(off**2, axis=1)))
    return varying, constant, [float(np.mean(products[np.abs(apart_s - lag) < 0.03])) / power for lag in LAGS_S]


def test_errors_of_lidar_positions():
    found = [one for name in FLIGHTS if (one := fix_errors(flight(name, "fuse"))) is not None]
    assert found
    varying, bias = np.mean([one[0] for one in found]), np.mean([one[1] for one in found])
    correlation = np.mean([one[2] for one in found], axis=0)
    at = ", ".join(f"{value:.2f} at {lag:g} s" for value, lag in zip(correlation, LAGS_S, strict=True))
    print(f"\n{len(found)} flights: variance {varying:.2f} of the reported, bias {bias:.2f}; correlation {at}")  # noqa: T201
    assert 0.2 < varying < 2.0


def matches(flown: RecordedFlight) -> list[tuple[np.ndarray, int]]:
    """For each pair of images: likeness of each match, and which is right; -1: none."""
    settings, out = JointAlignSettings(), []
    pairing, pairs = Pairing(round(1e9 * settings.max_apart_s)), []
    for _, port, message in flown.events:
        if port in ("vehicle", "drone"):
            pairs += pairing.vehicle(message) if port == "vehicle" else pairing.drone(message)
    for pair in pairs:
        lines = [None if seen is None else level_lines(seen, STRAIGHT_RAD) for seen in pair]
        true = flown.truth(pair[1].stamp_ns)
        if true is None or any(one is None or len(one.weight) < settings.min_lines for one in lines):
            continue
        found = peaks(overlap(*(spectrum(one) for one in lines)), APART_RAD)
        level = lines[0].R_carrier_level.T @ true[0] @ lines[1].R_carrier_level
        off = [abs(quarter_difference(math.atan2(level[1, 0], level[0, 0]) - top.yaw_rad)) for top in found]
        right = int(np.argmin(off)) if off and min(off) < RIGHT_RAD else -1
        if found:
            out.append((np.array([top.likeness for top in found]), right))
    return out


def test_probabilities_of_the_matches_of_both_cameras():
    pairs = [pair for name in FLIGHTS for pair in matches(flight(name, "align"))]
    if len(pairs) < 20:
        pytest.skip("fewer than 20 pairs of images in these flights")

    def cost(x: np.ndarray) -> float:
        total = 0.0
        for likeness, right in pairs:
            score = x[0] * np.append(likeness, x[1])
            total -= score[right] - np.logaddexp.reduce(score)
        return total / len(pairs)

    weight, none = minimize(cost, (5.0, 0.4), method="Nelder-Mead").x
    print(f"\n{len(pairs)} pairs: LIKENESS_WEIGHT {weight:.1f}, NONE_LIKENESS {none:.2f}")  # noqa: T201
    assert weight > 1.0
