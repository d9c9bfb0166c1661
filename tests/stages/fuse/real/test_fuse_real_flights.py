"""Flights of real drones through the stages of configs/estimate.yaml: heading, errors and gaps, as tables.

    python -m pytest -m slow -n 0 tests/stages/fuse/real/test_fuse_real_flights.py -s     about 15 min of one core

The yaw is compared with a batch over the whole flight by GPS and the other IMU; that of two IMUs differs by 1.3 deg RMS
(pixhawk_log.py), and the autopilot's own yaw (compass) by 4 deg from both. The column `wrong` counts headings that were
decided once and are more than 20 deg off at any time, also while their sigma is too large for a pose.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.stages.fuse.judged import HEADER, Flown, fly, rms, row
from tests.stages.fuse.real.pixhawk_log import LOG, degrees_between, latency_s, pixhawk_log, reference, yaw_rad
from tests.stages.fuse.real.real_flights import TRACKS, PixhawkFlight, TrackFlight, tracks

pytestmark = pytest.mark.slow
WINDOWS = 40
GAPS_S = {1: (30.0, 31.0), 2: (38.0, 40.0), 5: (50.0, 55.0)}
WRONG_DEG = 10.0


@pytest.fixture(autouse=True)
def _data():
    if not LOG.exists() or not TRACKS.exists():
        pytest.skip("needs ../shared/data/mavlink/copter_dataflash_imu50.bin and ../shared/data/drone_traj")


def test_the_references_of_both_imus_agree_and_gps_is_late():
    first, second = reference("IMU"), reference("IMU2")
    off = degrees_between(yaw_rad(first.R_odom_drone), yaw_rad(second.R_odom_drone))
    times, R = pixhawk_log().attitude
    inside = (times > first.time_s[0]) & (times < first.time_s[-1])
    by_batch = yaw_rad(first.R_odom_drone[np.searchsorted(first.time_s, times[inside])])
    compass = degrees_between(by_batch, yaw_rad(R[inside]))
    print(f"\nlatency {latency_s():.2f} s; yaw IMU - IMU2 {off.mean():.1f} +- {off.std():.1f} deg; ", end="")  # noqa: T201
    print(f"IMU - autopilot {compass.mean():.1f} +- {compass.std():.1f} deg")  # noqa: T201
    assert 0.15 < latency_s() < 0.4
    assert np.sqrt(np.mean(off**2)) < 2.5
    assert np.sqrt(np.mean(compass**2)) < 6.0


def test_the_heading_of_a_real_flight_is_right_within_its_sigma():
    """Windows of 60 s from all parts of the flight; each with its own IMU, kind of path, yaw of map and noise."""
    flown: dict[str, list[Flown]] = {}
    for k, start_s in enumerate(np.linspace(15.0, 262.0, WINDOWS)):
        imu, by_gps = ("IMU", "IMU2")[k % 2], k // 2 % 2 == 0
        flight = PixhawkFlight(float(start_s), seed=k, gaps_s=tuple(GAPS_S.values()), imu=imu, by_gps=by_gps)
        name = f"{imu}, {'GPS' if by_gps else 'GPS + ' + ('IMU2', 'IMU')[k % 2]}"
        flown.setdefault(name, []).append(fly(flight))
        print(f"{start_s:5.0f} s {row(imu, 'pixhawk', flown[name][-1:])}", flush=True)  # noqa: T201
    everything = [one for part in flown.values() for one in part]
    print(f"\n{HEADER}")  # noqa: T201
    for name, part in flown.items():
        print(f"{name}: {row('', '', part)}")  # noqa: T201
    report(everything)
    assert yaw_nees(everything) < 1.2
    assert wrong_share(everything) < 0.02  # goal 0; 10 deg is two sigma at the limit of 5 deg


def test_the_heading_is_right_with_the_autopilots_own_motion():
    flown = [
        fly(PixhawkFlight(float(start_s), seed=k, until_s=20.0, imu="IMU", by_gps=False, independent=True))
        for k, start_s in enumerate(np.linspace(18.0, 262.0, 14))
    ]
    print(f"\n{HEADER}\n{row('odometry', 'pixhawk', flown)}")  # noqa: T201
    assert wrong_share(flown) == 0.0


@pytest.mark.parametrize("vibration_mps2", [0.3, 1.0])
def test_the_heading_on_real_tracks_is_right_within_its_sigma(vibration_mps2: float):
    print(f"\n{HEADER}")  # noqa: T201
    everything: list[Flown] = []
    for name in tracks():
        starts = np.linspace(*TrackFlight.span_s(name), 6)
        flights = [
            TrackFlight(float(s), seed=k, track=name, vibration_mps2=vibration_mps2, gaps_s=tuple(GAPS_S.values()))
            for k, s in enumerate(starts)
        ]
        flown = [fly(flight) for flight in flights]
        print(f"{name}: {row(f'vib. {vibration_mps2}', '', flown)}", flush=True)  # noqa: T201
        everything += flown
    report(everything)
    assert yaw_nees(everything) < 1.0
    assert wrong_share(everything) < 0.01


def yaw_nees(flown: list[Flown]) -> float:
    """Mean of the squared yaw error over its variance, of published rotations."""
    yaw, sigma = (np.concatenate([getattr(one, part) for one in flown]) for part in ("yaw_deg", "yaw_sigma_deg"))
    return float(np.mean((yaw / sigma) ** 2))


def wrong_share(flown: list[Flown]) -> float:
    """Share of the published rotations that are more than 10 deg off."""
    return float(np.mean(np.abs(np.concatenate([one.yaw_deg for one in flown])) > WRONG_DEG))


def report(flown: list[Flown]) -> None:
    """All together: shares of the time, wrong yaws, errors over time and at the end of gaps."""
    yaw = np.concatenate([one.yaw_deg for one in flown])
    full = np.concatenate([one.full for one in flown])
    at_s = np.concatenate([np.array(one.at_s)[np.array(one.full, dtype=bool)] for one in flown])
    print(  # noqa: T201
        f"all: {row('', '', flown)}\n{100 * full.mean():.0f} % with a rotation; {100 * np.mean(np.abs(yaw) > WRONG_DEG):.1f} % "
        f"of these more than 10 deg off, in {sum(bool(np.any(np.abs(one.yaw_deg) > WRONG_DEG)) for one in flown)} of {len(flown)} flights"
    )
    sigma_deg, poses = np.concatenate([one.yaw_sigma_deg for one in flown]), sum(len(one.at_s) for one in flown)
    for limit_deg in (4.0, 3.5):
        kept = yaw[sigma_deg <= limit_deg]
        text = (
            f"{100 * len(kept) / poses:.0f} % with a rotation; {100 * np.mean(np.abs(kept) > WRONG_DEG):.1f} % of these"
        )
        print(f"  with a limit of {limit_deg} deg: {text}")  # noqa: T201
    for a in range(0, 60, 10):
        inside = (at_s >= a) & (at_s < a + 10)
        if inside.any():
            print(f"  {a:2d} to {a + 10} s: yaw RMS {rms(yaw[inside]):.1f} deg")  # noqa: T201
    for length, (_, end_s) in GAPS_S.items():
        at = [(one, int(np.searchsorted(one.at_s, end_s)) - 1) for one in flown]
        near = [(one, k) for one, k in at if k >= 0 and abs(one.at_s[k] - end_s) < 0.05]
        if near:
            error = rms(np.array([one.error_m[k] for one, k in near]))
            sigma = math.sqrt(3 * np.mean([one.sigma_m[k] ** 2 for one, k in near]))
            nees = np.mean([one.nees_position[k] for one, k in near])
            print(f"  gap of {length} s: {error:.2f} m at {sigma:.2f} m, NEES (3) {nees:.1f}, {len(near)} flights")  # noqa: T201
