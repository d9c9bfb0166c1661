"""RecentPulses: the counts of all slices together equal the sum over the single slices."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stages.detect.isolation import MAX_SLICES, RecentPulses
from stages.kernels.detect.isolation import TALLY, count_sectors
from stages.kernels.detect.pulse_buffer import WINDOW_NS, count_sectors_all
from stages.kernels.sweep.pulses import cone_of
from stages.messages import SweptPulses

STEP_NS = 1_000_000
AROUND = (0.3, 0.4, 1.2, 2.5, 0.8)  # disc, inner, close, outer, depth [m]


def fan(rng: np.random.Generator, spread_rad: float, stamp_ns: int = 0) -> SweptPulses:
    """A slice of 5 to 60 pulses within `spread_rad` about some direction."""
    middle = rng.standard_normal(3)
    middle /= np.linalg.norm(middle)
    n = int(rng.integers(5, 60))
    off = rng.standard_normal((n, 3))
    directions = middle + np.tan(rng.uniform(0, spread_rad, n))[:, None] * off / np.linalg.norm(off, axis=1)[:, None]
    directions = (directions / np.linalg.norm(directions, axis=1)[:, None]).astype(np.float32)
    return SweptPulses(
        stamp_ns=stamp_ns,
        point_stamp_ns=np.full(n, stamp_ns, dtype=np.int64),
        direction_vehicle=directions,
        range_m=np.where(rng.random(n) < 0.4, 0.0, rng.uniform(1, 40, n)).astype(np.float32),
        laser=np.zeros(n, dtype=np.uint8),
        reflectivity=np.zeros(n, dtype=np.uint8),
        turntable_rad=0.0,
        origin_vehicle_m=tuple(rng.uniform(-0.3, 0.3, 3)),
    )


def add(recent: RecentPulses, pulses: SweptPulses) -> None:
    recent.add(pulses, *cone_of(pulses.direction_vehicle), pulses.stamp_ns)


def one_by_one(slices: list[SweptPulses], centre_m: np.ndarray) -> np.ndarray:
    tally = np.zeros(TALLY, dtype=np.int64)
    for s in slices:
        count_sectors(s.direction_vehicle, s.range_m, np.array(s.origin_vehicle_m), centre_m, *AROUND, tally)
    return tally.astype(float)


@pytest.mark.parametrize("spread_rad", [0.02, 0.3, 1.2])
def test_the_buffer_counts_as_the_sum_of_its_slices(spread_rad) -> None:
    rng = np.random.default_rng(int(1000 * spread_rad))
    found = 0.0
    for _ in range(60):
        recent, slices = RecentPulses(), []
        for k in range(int(rng.integers(1, 8))):
            pulses = fan(rng, spread_rad, k * STEP_NS)
            add(recent, pulses)
            slices.append(pulses)
        for slice_ in slices:  # a position some metres from one of its pulses, also at the edge of the search
            along = slice_.direction_vehicle[int(rng.integers(len(slice_.range_m)))].astype(float)
            centre_m = rng.uniform(1.5, 30.0) * along + rng.standard_normal(3) * rng.uniform(0.0, 3.0)
            counts = count_sectors_all(*recent.arrays, centre_m, *AROUND)
            np.testing.assert_array_equal(counts, one_by_one(slices, centre_m))
            found += counts.sum()
    assert found > 500


def test_slices_before_the_window_or_beyond_the_capacity_are_dropped() -> None:
    rng = np.random.default_rng(7)
    made = [fan(rng, 1.2) for _ in range(MAX_SLICES + 5)]
    centre_m = 8.0 * made[0].direction_vehicle[0].astype(float)
    late, many = RecentPulses(), RecentPulses()
    for k, pulses in enumerate(made):
        add(late, dataclasses.replace(pulses, stamp_ns=0 if k < 2 else WINDOW_NS + 1))
        add(many, pulses)
        if k == 4:
            np.testing.assert_array_equal(
                count_sectors_all(*late.arrays, centre_m, *AROUND), one_by_one(made[2:5], centre_m)
            )
    np.testing.assert_array_equal(
        count_sectors_all(*many.arrays, centre_m, *AROUND), one_by_one(made[-MAX_SLICES:], centre_m)
    )
