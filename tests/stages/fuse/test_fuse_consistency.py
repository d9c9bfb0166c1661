"""Consistency of the covariance: NEES and coverage over flights whose errors are drawn with known statistics.

python -m pytest tests/stages/fuse/test_fuse_consistency.py -m slow -s     many flights, and memory over an hour
"""

from __future__ import annotations

import resource

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.fuse.settings import FuseErrors
from stages.messages import PoseState
from tests.stages.fuse.ekf import EkfFuse
from tests.stages.fuse.made_drone_flight import START_NS, Made, S, rms

CHI2_95 = {3: 7.815, 6: 12.592}


def flights(count, **how):
    """Flights of all kinds, in turn."""
    kinds = (
        {"speed_mps": 3.0, "radius_m": 12.0},
        {"speed_mps": 5.0, "radius_m": 20.0, "vehicle_mps": 4.0, "vehicle_dps": 8.0},
        {"straight": True, "speed_mps": 2.0},
        {"speed_mps": 1.0, "radius_m": 6.0, "turn_dps": 40.0},
    )
    return [Made(seed=seed, **{**kinds[seed % len(kinds)], **how}) for seed in range(count)]


def pooled(stage, made):
    """NEES of position and pose, and errors, of all poses of all flights that have a rotation."""
    nees3, nees6, error, angle = [], [], [], []
    for flight in made:
        poses = [pose for pose in flight.run(stage()) if pose.R_vehicle_drone is not None]
        seen = flight.judge(poses, after_s=4)
        nees3 += seen.nees3
        nees6 += seen.nees6
        error += seen.error_m
        angle += seen.angle_deg
    return np.array(nees3), np.array(nees6), np.array(error), np.array(angle)


def report(name, nees3, nees6, error, angle):
    inside = [100 * float((n < CHI2_95[d]).mean()) for n, d in ((nees3, 3), (nees6, 6))]
    print(  # noqa: T201
        f"\n{name}: RMSE {rms(error):.3f} m, {rms(angle):.2f} deg, max {angle.max():.1f} deg; NEES {nees3.mean():.2f} of 3, "
        f"{nees6.mean():.2f} of 6; inside 95 %: {inside[0]:.1f}, {inside[1]:.1f} %"
    )
    return inside


@pytest.mark.parametrize("stage", [Fuse, EkfFuse])
def test_the_covariance_is_consistent(stage):
    nees3, nees6, error, angle = pooled(stage, flights(4, until_s=8))
    assert nees3.mean() < 4
    assert nees6.mean() < 8
    assert (nees6 < CHI2_95[6]).mean() > 0.85
    assert rms(error) < 0.12
    assert angle.max() < 5


def test_without_inflation_correlated_errors_make_the_covariance_overconfident():
    """Vanishing points with an error of 1 deg for 1 s."""
    made = flights(4, until_s=8, rotation_sigma_deg=1.0, rotation_time_s=1.0)
    naive = FuseErrors(rotation_time_s=0.0, rotation_bias_share=0.0, fix_time_s=0.0, fix_bias_share=0.0)
    _, honest, _, _ = pooled(Fuse, made)
    _, proud, _, _ = pooled(lambda: Fuse(errors=naive), made)
    assert honest.mean() < 9
    assert proud.mean() > 2 * honest.mean()


@pytest.mark.parametrize("how", [{}, {"rotations": False, "autopilot": "none"}])
def test_a_reported_bias_of_the_fixes_does_not_average_out(how):
    """A reported bias is in the covariance; otherwise a fourth of the variance is assumed, which is too little."""
    mean = {}
    for reported in (True, False):
        made = flights(8, until_s=7, bias_m=0.12, bias_reported=reported, **how)
        nees = [flight.judge(flight.run(Fuse()), after_s=3).nees3 for flight in made]
        mean[reported] = np.mean([n for one in nees for n in one])
    assert 1.5 < mean[True] < 4.5
    assert mean[False] > 1.4 * mean[True]


def test_a_heading_by_motion_is_never_on_a_wrong_branch():
    made = [
        Made(seed=seed, rotations=False, until_s=8, radius_m=radius, speed_mps=speed, local_yaw_deg=37.0 * seed)
        for seed, (radius, speed) in enumerate([(5, 1), (5, 2), (12, 3), (25, 5), (0, 0), (3, 0.6)])
    ]
    *_, angle = pooled(Fuse, made)
    assert len(angle) > 250
    assert angle.max() < 15


@pytest.mark.slow
@pytest.mark.parametrize("stage", [Fuse, EkfFuse])
@pytest.mark.parametrize("rotations", [True, False])
def test_over_many_flights_coverage_is_near_95_percent(stage, rotations):
    inside = report(f"{stage.__name__}, rotations {rotations}", *pooled(stage, flights(32, rotations=rotations)))
    assert 92 < inside[0] <= 99.5
    assert 92 < inside[1] <= 99.9


@pytest.mark.slow
def test_three_seconds_without_lidar_over_many_flights():
    ends, nees = [], []
    for seed in range(40):
        made = Made(seed=seed, until_s=15.1, speed_mps=5.0, radius_m=25.0, gaps_s={"fix": (12.0, 15.0)}, clock_hz=100)
        poses = made.run(Fuse())
        end = [pose for pose in poses if pose.stamp_ns < START_NS + 15 * S][-1]
        assert end.state is PoseState.COASTING
        seen = made.judge([end])
        ends += seen.error_m
        nees += seen.nees3
    share = np.mean(np.array(ends) < 0.5)
    print(  # noqa: T201
        f"\nend of 3 s without LiDAR at 5 m/s: RMSE {rms(ends):.3f} m, p95 {np.percentile(ends, 95):.2f}, "
        f"below 0.5 m {100 * share:.0f} %, NEES {np.mean(nees):.2f} of 3"
    )
    assert share > 0.85
    assert np.mean(nees) < 4


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_wrong_branches_are_never_full_over_many_flights(share):
    """Streets that are RESOLVED and wrong from the start, or from some time on."""
    wrong = full = 0
    for seed in range(40):
        since = 0.0 if share == 0.05 else 1.0 + 7.0 * seed / 40
        made = Made(seed=seed, until_s=10, quarters=((since, 1 + seed % 3),), switches=bool(seed % 2))
        angles = made.judge(made.run(Fuse())).angle_deg
        wrong += sum(angle > 45 for angle in angles)
        full += len(angles)
    print(f"\n{full} poses with a rotation, {wrong} of them another quarter's")  # noqa: T201
    assert wrong == 0


@pytest.mark.slow
def test_memory_is_constant_over_an_hour():
    stage, made = Fuse(), Made(until_s=20.0, speed_mps=3.0, radius_m=12.0)
    events = made.events()
    peaks_mb = []
    for lap in range(180):  # of 20 s
        shift = lap * 20 * S
        for _, port, message in events:
            moved = {field: getattr(message, field) for field in type(message).__dataclass_fields__}
            moved["stamp_ns"] += shift
            list(getattr(stage, f"on_{port}")(type(message)(**moved)))
        peaks_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)  # GTSAM's included
    print(f"\npeak after 10 min {peaks_mb[29]:.1f} MB, after 60 min {peaks_mb[-1]:.1f} MB")  # noqa: T201
    assert peaks_mb[-1] < peaks_mb[29] + 5.0
