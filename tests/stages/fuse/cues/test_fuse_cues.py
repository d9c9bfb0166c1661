"""Cues in gaps of the LiDAR: what they add, and that wrong ones do not move the pose.

python -m pytest -m slow -n 0 tests/stages/fuse/cues -s          the tables, SEEDS=10 flights a line
"""

from __future__ import annotations

import math
import os

import numpy as np
import pytest

from stages.fuse import Fuse
from tests.stages.fuse.cue_flights import (
    GnssErrors,
    altitude,
    another_drone,
    formation_until,
    gnss,
    hovering,
    together,
    uwb,
)
from tests.stages.fuse.fuse_inputs import Fault, late, without
from tests.stages.fuse.imu_flights import ImuFlight, seconds
from tests.stages.fuse.judged import CHI2_95, Flown
from tests.stages.fuse.judged import fly as judged_fly

SEEDS = int(os.environ.get("SEEDS", "4"))
GAP = (16.0, 21.0)
GAPS = ((15.0, 16.0), (19.0, 21.0), (25.0, 30.0))
ALL = frozenset({"gnss", "uwb", "altitude"})


def fly(made: ImuFlight, stage: Fuse | None = None, fault: Fault = list) -> Flown:
    """Run a flight with all kinds of cues."""
    return judged_fly(made, stage or Fuse(cue_sources=ALL), fault)


def flight(seed: int = 0, **how) -> ImuFlight:
    return ImuFlight(kind="manoeuvre", seed=seed, until_s=22.0, gaps_s=(GAP,), **how)


@pytest.fixture(scope="module")
def without_cues() -> dict[int, Flown]:
    return {seed: fly(flight(seed)) for seed in (0, 1)}


def at_end(flown: Flown, end_s: float = GAP[1]) -> tuple[float, float, float]:
    """Error, sigma (3 axes) and NEES of the last pose of a gap; inf, inf, 0 where it is LOST."""
    k = int(np.searchsorted(flown.at_s, end_s)) - 1
    if abs(flown.at_s[k] - end_s) > 0.05:
        return math.inf, math.inf, 0.0
    return flown.error_m[k], math.sqrt(3.0) * flown.sigma_m[k], flown.nees_position[k]


def is_used(flown: Flown) -> bool:
    return any(factor.used for factor in flown.cues)


def is_reported(flown: Flown) -> bool:
    return any(factor.contradicts for factor in flown.cues)


def same(a: Flown, b: Flown) -> bool:
    return np.array_equal(a.error_m, b.error_m) and np.array_equal(a.sigma_m, b.sigma_m)


def test_gnss_bounds_the_drift_in_a_gap(without_cues):
    for seed, alone in without_cues.items():
        flown = fly(flight(seed), fault=gnss(flight(seed)))
        error, sigma, nees = at_end(flown)
        assert sigma < 0.8 * at_end(alone)[1]
        assert error < max(at_end(alone)[0], 1.0)
        assert nees < 16.3
        assert not is_reported(flown)


def test_the_bias_is_published_once_it_is_known():
    made = flight(1)
    last = [f for f in fly(made, fault=gnss(made)).cues if f.used and seconds(f.stamp_ns) < GAP[0]][-1]
    assert last.source == "gnss"
    assert last.bias_sigma_m < 0.6
    assert last.offset_m == pytest.approx(float(np.linalg.norm(last.bias_m)), abs=2.0)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda f: gnss(f, offset_m=(30.0, 0.0, 0.0)),
        lambda f: gnss(f, of=another_drone(f)),
        lambda f: gnss(f, of=hovering(f)),
        lambda f: uwb(f, offset_m=30.0),
    ],
    ids=["gnss 30 m off", "gnss of another drone", "gnss of one that hovers", "uwb 30 m off"],
)
def test_a_wrong_cue_moves_neither_pose_nor_covariance(wrong, without_cues):
    made = flight(1)
    flown = fly(made, fault=wrong(made))
    assert same(flown, without_cues[1])
    assert is_reported(flown)


def test_an_altitude_30_m_off_changes_nothing(without_cues):
    made = flight(1)
    assert same(fly(made, fault=altitude(made, offset_m=30.0)), without_cues[1])


def test_only_the_named_cues_are_used(without_cues):
    made = flight(1)
    flown = judged_fly(made, Fuse(), uwb(made))
    assert same(flown, without_cues[1])
    assert not flown.cues


def test_a_wrong_cue_beside_a_true_one_changes_nothing():
    made = flight(1)
    true = fly(made, fault=gnss(made))
    both = fly(made, fault=together(gnss(made), uwb(made, offset_m=30.0)))
    assert same(both, true)


def test_a_cue_of_a_drone_that_leaves_the_formation_in_a_gap_is_taken_out(without_cues):
    made = flight(1)
    flown = fly(made, fault=gnss(made, of=formation_until(made, 17.0, 2.0)))
    assert is_used(flown)
    assert is_reported(flown)
    error, sigma, _ = at_end(flown)
    alone_m, alone_sigma, _ = at_end(without_cues[1])
    assert error < alone_m + 0.1
    assert sigma > 0.95 * alone_sigma


def test_a_lidar_position_that_agrees_with_the_imu_alone_takes_a_wrong_cue_out():
    made = flight(1)
    near = gnss(made, of=formation_until(made, 18.5, 1.0))
    flown = fly(made, fault=near)
    after = [error for t, error in zip(flown.at_s, flown.error_m, strict=True) if t > GAP[1] + 0.6]
    assert max(after) < 0.4


def test_a_hovering_drone_gets_no_help_from_a_cue_that_may_be_another_ones():
    made = ImuFlight(kind="hover", seed=1, until_s=16.0, wind_mps=0.0)
    assert not is_used(fly(made, fault=gnss(made, of=hovering(made))))


def test_reflections_of_the_ranging_do_not_distrust_it():
    made = flight(0)
    flown = fly(made, fault=uwb(made, reflected=0.1))
    assert is_used(flown)
    assert not is_reported(flown)


def test_cues_that_arrive_too_late_are_not_used(without_cues):
    made = flight(1)
    assert not is_used(fly(made, fault=lambda events: late(("cue",), 1.8)(list(gnss(made)(events)))))


def test_without_an_imu_or_vehicle_motion_cues_are_not_used():
    made = flight(1)
    for port in ("drone_motion", "motion"):
        fault = together(gnss(made), without((port,)))
        assert not is_used(fly(made, fault=fault))


def test_after_a_break_of_the_imu_the_bias_is_estimated_again():
    made = flight(1)
    flown = fly(made, fault=together(gnss(made), without(("drone_motion",), 13.0, 13.3)))
    assert is_used(flown)
    known = [s for s in flown.cues if 13.5 < seconds(s.stamp_ns) < 14.5]
    assert all(np.isfinite(s.bias_m).all() for s in known)
    assert at_end(flown)[0] < 3.0


def test_cues_that_are_not_of_their_kind_are_counted():
    made, stage = flight(1), Fuse()

    def fault(events):
        for at, port, message in gnss(made)(events):
            if port == "cue":
                object.__setattr__(message, "value_m", message.value_m[:2])
            yield at, port, message

    flown = fly(made, stage, lambda events: list(fault(events)))
    assert not flown.cues
    assert stage.counters.rejected["cue: not of its kind"] > 50


# tables

VARIANTS = {
    "none": lambda f: list,
    "gnss": gnss,
    "uwb": uwb,
    "gnss, uwb": lambda f: together(gnss(f), uwb(f)),
    "gnss, walk x 3": lambda f: gnss(f, GnssErrors(walk=0.38)),
    "gnss, reflections 2 m": lambda f: gnss(f, GnssErrors(jumps_m=2.0)),
    "gnss, latency + 0.1 s": lambda f: gnss(f, GnssErrors(latency_s=0.1)),
}
WRONG = {
    "30 m off": lambda f: gnss(f, offset_m=(30.0, 0.0, 0.0)),
    "another drone": lambda f: gnss(f, of=another_drone(f)),
    "one that hovers": lambda f: gnss(f, of=hovering(f)),
    "leaves at 1 m/s": lambda f: gnss(f, of=formation_until(f, 26.0, 1.0)),
    "leaves at 3 m/s": lambda f: gnss(f, of=formation_until(f, 26.0, 3.0)),
    "true, uwb of another": lambda f: together(gnss(f), uwb(f, of=another_drone(f))),
}
HEADER = "cue | flight | after 1, 2, 5 s: error RMS / sigma [m] (NEES) | in 95 % in gaps [%] | LOST | used, reported"


def line(name: str, kind: str, cues, **how) -> tuple[str, list[Flown]]:
    """A line of the table, and its flights."""
    made = [ImuFlight(kind=kind, seed=s, until_s=33.0, gaps_s=GAPS, **how) for s in range(SEEDS)]
    flown = [fly(f, fault=cues(f)) for f in made]
    cells, lost = [], 0
    for _, end_s in GAPS:
        ends = [e for f in flown if math.isfinite((e := at_end(f, end_s))[0])]
        lost += len(flown) - len(ends)
        if not ends:
            cells.append("LOST")
            continue
        error, sigma, nees = np.array(ends).T
        cells.append(f"{np.sqrt(np.mean(error**2)):.2f} / {np.sqrt(np.mean(sigma**2)):.2f} ({nees.mean():.1f})")
    inside = 100 * np.mean([n < CHI2_95 for f in flown for n in nees_in_gaps(f)])
    used, reported = sum(map(is_used, flown)), sum(map(is_reported, flown))
    cpu = np.mean([f.cpu_ms for f in flown])
    return f"{name} | {kind} | {', '.join(cells)} | {inside:.0f} | {lost} | {used}, {reported} | {cpu:.0f} ms/s", flown


def nees_in_gaps(flown: Flown) -> list[float]:
    return [
        nees for t, nees in zip(flown.at_s, flown.nees_position, strict=True) if any(a + 0.35 < t < b for a, b in GAPS)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("vibration_mps2", [0.3, 1.0])
@pytest.mark.parametrize("name", VARIANTS)
def test_cues_are_honest_in_gaps(name, vibration_mps2):
    print(f"\n{HEADER}, vibration {vibration_mps2} m/s2")  # noqa: T201
    for kind in ("manoeuvre", "square"):
        text, flown = line(name, kind, VARIANTS[name], vibration_mps2=vibration_mps2)
        print(text, flush=True)  # noqa: T201
        inside = np.mean([n < CHI2_95 for f in flown for n in nees_in_gaps(f)])
        assert inside > 0.85, (name, kind)


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_wrong_cues_do_not_move_the_pose(name):
    print(f"\n{HEADER}")  # noqa: T201
    text, flown = line(name, "manoeuvre", WRONG[name])
    print(text, flush=True)  # noqa: T201
    assert np.mean([n < CHI2_95 for f in flown for n in nees_in_gaps(f)]) > 0.8
    if name != "true, uwb of another":
        assert all(map(is_reported, flown))
