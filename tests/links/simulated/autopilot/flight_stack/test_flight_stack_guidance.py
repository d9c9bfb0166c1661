"""Targets of the plan: following the vehicle by its odometry."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.autopilot.flight_stack.guidance import FlightTarget, Guidance, SurveyFrame
from links.simulated.autopilot.flight_stack.quadrotor import TICK_S
from links.simulated.autopilot.flight_stack.settings import Follow
from links.simulated.world.path import Path, Waypoint

VEHICLE = Path(
    waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, 0)), Waypoint(t_s=5, xyz_m=(0, 0, 0)), Waypoint(t_s=45, xyz_m=(200, 0, 0)))
)
START_M = np.array([4.0, 1.0, 10.0])
FRAME = SurveyFrame(np.pi / 2, np.zeros(3))  # the world's x axis is the frame's y axis


def followed(drift_m_per_s: float, until_s: float) -> FlightTarget:
    drift = lambda time_s: np.array([drift_m_per_s * max(time_s - 10.0, 0.0), 0.0, 0.0])  # noqa: E731
    guidance = Guidance(VEHICLE, VEHICLE, FlightTarget(START_M.copy()), drift)
    guidance.begin(Follow(for_s=60.0), 5.0)
    return fly(guidance, 5.0, until_s, FRAME)


def fly(guidance: Guidance, from_s: float, until_s: float, frame: SurveyFrame) -> FlightTarget:
    for tick in range(round(from_s / TICK_S), round(until_s / TICK_S)):
        guidance.update((tick + 1) * TICK_S, frame)
    return guidance.target


def test_follow_keeps_its_offset_from_the_vehicle_and_has_its_velocity() -> None:
    target = followed(0.0, 25.0)
    moved_m = VEHICLE.at(np.array([25.0]))[0][0, 0]
    assert moved_m > 60.0
    assert target.xyz_m == pytest.approx(START_M + np.array([0.0, moved_m, 0.0]))
    assert target.velocity_mps == pytest.approx([0.0, VEHICLE.at(np.array([25.0]))[1][0, 0], 0.0], abs=1e-9)


def test_follow_takes_the_vehicles_position_from_its_odometry() -> None:
    true, drifted = followed(0.0, 25.0), followed(0.25, 25.0)
    assert drifted.xyz_m - true.xyz_m == pytest.approx([0.0, 0.25 * 15.0, 0.0])
    assert drifted.velocity_mps - true.velocity_mps == pytest.approx([0.0, 0.25, 0.0])


def test_follow_goes_on_from_the_shifted_target_when_the_axes_of_the_estimate_turn() -> None:
    guidance = Guidance(VEHICLE, VEHICLE, FlightTarget(START_M.copy()), lambda _: np.zeros(3))
    guidance.begin(Follow(for_s=60.0), 5.0)
    before_m = fly(guidance, 5.0, 25.0, FRAME).xyz_m.copy()
    jump_m = np.array([-30.0, 8.0, 0.0])
    guidance.shift(jump_m, -np.pi / 2)
    target = fly(guidance, 25.0, 26.0, SurveyFrame(0.0, np.zeros(3)))
    moved_m = np.diff(VEHICLE.at(np.array([25.0, 26.0]))[0][:, 0])[0]
    assert target.xyz_m == pytest.approx(before_m + jump_m + [moved_m, 0.0, 0.0])
