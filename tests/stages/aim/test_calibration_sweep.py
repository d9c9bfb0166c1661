"""The sweep for `grd calibrate`: both directions, alternately slow and fast."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from stages.aim import CalibrationSweep
from stages.calibration.result import Travel
from stages.geometry.frames import LidarMount
from stages.messages import ServoGoal, ServoState

STEP_S = 0.004
MAX_RPM = 55.0


def driven(stage: CalibrationSweep, seconds: float, *, from_deg: float, limits_deg=(0.0, 180.0), turns=True):
    """Positions [deg] of a servo that follows the goals within its limits, and the goals."""
    position, goal, goals, positions = math.radians(from_deg), None, [], []
    low, high = map(math.radians, limits_deg)
    for k in range(round(seconds / STEP_S)):
        stamp_ns = round(k * STEP_S * 1e9)
        new_goal = stage.on_servo(
            ServoState(stamp_ns=stamp_ns, position_rad=position, velocity_radps=0.0, goal_rad=0.0, error=0)
        )
        if new_goal is not None:
            goal = new_goal
            goals.append(new_goal)
        if goal is not None and turns:
            step = min(goal.speed_radps, MAX_RPM * math.tau / 60) * STEP_S
            to = min(max(goal.position_rad, low), high)
            position += math.copysign(min(step, abs(to - position)), to - position)
        positions.append(math.degrees(position))
    return positions, goals


def rpm(goal: ServoGoal) -> float:
    return goal.speed_radps * 60 / math.tau


@pytest.mark.parametrize("from_deg", [0.0, 77.0, 180.0, -12.0])
def test_it_sweeps_forth_and_back_at_each_speed_in_turn(from_deg):
    positions, goals = driven(CalibrationSweep(mount=LidarMount()), 20.0, from_deg=from_deg)
    ends = [round(math.degrees(g.position_rad)) for g in goals]
    assert set(ends[1:]) == {0, 180}
    assert all(a != b for a, b in pairwise(ends))
    assert [round(rpm(g), 1) for g in goals[:8]] == [11.4, 11.4, 45, 45, 11.4, 11.4, 45, 45][: len(goals)]
    assert len(goals) >= 6
    assert min(positions[1000:]) < 0.6
    assert max(positions) > 179.4


def test_the_sweep_satisfies_the_calibrations_requirements():
    positions, _ = driven(CalibrationSweep(mount=LidarMount()), 20.0, from_deg=20.0)
    rad = np.radians(positions)
    travel = Travel.of(rad, np.gradient(rad, STEP_S))
    assert travel.both_ways
    assert travel.two_speeds
    assert travel.angle_rad > math.radians(170)


def test_a_servo_that_stalls_before_an_end_reverses_and_one_that_does_not_move_gets_new_goals():
    positions, goals = driven(CalibrationSweep(mount=LidarMount()), 20.0, from_deg=60.0, limits_deg=(20.0, 150.0))
    assert min(positions[2000:]) == pytest.approx(20.0)
    assert max(positions) == pytest.approx(150.0)
    assert len(goals) >= 6
    _, goals = driven(CalibrationSweep(mount=LidarMount()), 3.0, from_deg=60.0, turns=False)
    assert len(goals) >= 5


def test_a_lidar_that_does_not_turn_gets_no_goal_and_impossible_settings_are_rejected():
    assert driven(CalibrationSweep(mount=LidarMount(turns=False)), 1.0, from_deg=0.0)[1] == []
    for wrong in ({"travel_deg": (90.0, 90.0)}, {"speeds_rpm": ()}, {"speeds_rpm": (0.0,)}):
        with pytest.raises(ValidationError):
            CalibrationSweep(**{"mount": LidarMount(), **wrong})
