"""FixLog returns the fixes that were appended."""

from __future__ import annotations

import numpy as np

from flow.message import array_fields, check_arrays
from links.runs.fix_log import FixLog
from stages.messages import DroneFix, MeanShiftResult


def made(k: int, velocity: bool) -> DroneFix:
    rng = np.random.default_rng(k)
    return DroneFix(
        stamp_ns=1_748_773_230_123_456_789 + k,
        xyz_vehicle_m=rng.normal(size=3),
        covariance_m2=rng.normal(size=(3, 3)),
        hits=3 + k,
        mean_shift=MeanShiftResult(iterations=k, shift_m=0.1 * k) if k < 4 else None,
        track_id=2,
        velocity_vehicle_mps=rng.normal(size=3) if velocity else None,
    )


def test_every_fix_round_trips_to_the_last_bit():
    given = [made(k, velocity=k % 2 == 0) for k in range(5)]
    log = FixLog()
    assert not log
    for fix in given:
        log.append(fix)
    assert len(log) == len(list(log)) == 5
    assert [fix.stamp_ns for fix in log[1::2]] == [given[1].stamp_ns, given[3].stamp_ns]
    for fix, same in zip(given, log, strict=True):
        check_arrays(same)
        for name, _, _ in array_fields(DroneFix):
            np.testing.assert_array_equal(getattr(fix, name), getattr(same, name))
        numbers = [(f.stamp_ns, f.hits, f.track_id) for f in (fix, same)]
        assert numbers[0] == numbers[1]
        assert (fix.mean_shift is None) == (same.mean_shift is None)
        if fix.mean_shift is not None and same.mean_shift is not None:
            assert same.mean_shift.iterations == fix.mean_shift.iterations
            assert same.mean_shift.shift_m == fix.mean_shift.shift_m
        assert (fix.velocity_vehicle_mps is None) == (same.velocity_vehicle_mps is None)
        if fix.velocity_vehicle_mps is not None:
            np.testing.assert_array_equal(fix.velocity_vehicle_mps, same.velocity_vehicle_mps)
    assert log[-1].hits == given[-1].hits
