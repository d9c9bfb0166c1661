"""A heading from motion alone, and what the lock makes of it where streets run at many angles."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.align.branches import BranchSettings, Displacement, Heading, HeadingBank
from stages.align.lock import YawLock
from stages.align.reckoning import Reckoned
from stages.align.spectra import spectrum
from tests.stages.align.test_spectra import lines_at

S = 1_000_000_000
H = HeadingBank.HYPOTHESES


def window(way_m, heading_deg, start_s, drift_mps=(0.0, 0.0)) -> Displacement:
    """The odometry's way and, 1 s on, the LiDAR's, turned by a heading."""
    a = math.radians(heading_deg)
    R = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    lidar = R @ np.asarray(way_m) + drift_mps
    start_ns = round(start_s * S) + S
    return Displacement(
        start_ns, start_ns + S, np.tile(lidar, (H, 1)), 0.05**2 * np.eye(2), np.asarray(way_m, float), 0.0, True
    )


def told(heading_deg, windows, speed_mps=2.0, drift_mps=(0.0, 0.0)) -> Heading | None:
    """Of a drone that flies round in circles of 8 s."""
    bank = HeadingBank(BranchSettings())
    for i in range(windows):
        turn = 2 * math.pi * i / 8
        bank.see(window(speed_mps * np.array([math.cos(turn), math.sin(turn)]), heading_deg, i, drift_mps))
    return bank.heading


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 121.0, -147.0])
@pytest.mark.parametrize("drift_mps", [(0.0, 0.0), (0.15, -0.1)])
def test_ways_in_all_directions_tell_any_heading_within_its_sigma_though_the_odometry_drifts(heading_deg, drift_mps):
    heading = told(heading_deg, 16, drift_mps=drift_mps)
    assert heading is not None
    off = math.remainder(heading.turn_rad - math.radians(heading_deg), 2 * math.pi)
    assert abs(off) < 3.0 * heading.sigma_rad
    assert heading.sigma_rad < math.radians(3.0)


def test_little_motion_tells_none_and_more_tells_it_better():
    assert told(20.0, 2) is None
    assert told(20.0, 12, speed_mps=0.3) is None
    assert told(20.0, 24).sigma_rad < told(20.0, 8).sigma_rad


def test_ways_that_are_not_the_drones_tell_none():
    bank, rng = HeadingBank(BranchSettings()), np.random.default_rng(4)
    for i in range(12):
        bank.see(window(rng.normal(0, 2, 2), rng.uniform(-180, 180), i))
        assert bank.heading is None


def seen(*azimuths_deg):
    return spectrum(lines_at(np.array(azimuths_deg, dtype=float)))


VEHICLE, DRONE = seen(0, 90, 0), seen(-20, 70, 14, 14, 41, 41)  # one street in common: no picture says which
AT = Reckoned(S, 0.0, 0.0, math.radians(0.1) ** 2)


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("street_deg", [20.0, -14.0, -41.0])
def test_motion_says_which_of_many_streets_both_cameras_see_and_which_way_round(street_deg, quarters):
    lock = YawLock()
    assert lock.choose(VEHICLE, DRONE, AT, 0.0).yaw_rad is None
    true_rad = math.radians(street_deg + 90 * quarters)
    match = lock.choose(VEHICLE, DRONE, AT, 0.0, Heading(true_rad + math.radians(3.0), math.radians(2.0)))
    assert match.yaw_rad is not None
    assert math.remainder(match.yaw_rad - true_rad, 2 * math.pi) == pytest.approx(0.0, abs=math.radians(0.3))


def test_where_motion_says_there_is_no_match_none_is_taken():
    nowhere = Heading(math.radians(3.0), math.radians(1.5))
    match = YawLock().choose(VEHICLE, DRONE, AT, 0.0, nowhere)
    assert match.yaw_rad is None
    assert "no match where the drone's motion says" in match.reason
    square = YawLock().choose(seen(0, 90), seen(-20, 70), AT, 0.0, nowhere)
    assert square.reason == "the lines match best elsewhere than the drone's motion says"


def test_a_match_that_motion_denies_is_let_go_up_to_quarter_turns():
    lock = YawLock()
    match = lock.choose(seen(0, 90), seen(-20, 70), AT, 0.0)
    lock.accept(match.yaw_rad, math.radians(0.2), AT)
    sigma = math.radians(2.0)
    assert not lock.denied(None)
    assert not lock.denied(Heading(math.radians(20 + 180 + 8), sigma))
    assert lock.denied(Heading(math.radians(20 - 90 + 14), sigma))
    lock.let_go()
    assert lock.offset_rad is None
    assert not lock.denied(Heading(0.0, sigma))
    again = lock.choose(seen(0, 90), seen(-20, 70), dataclasses.replace(AT, stamp_ns=2 * S), 0.0)
    assert math.degrees(again.yaw_rad) == pytest.approx(20.0, abs=0.2)
