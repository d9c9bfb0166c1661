"""The sensors behind the cues of a scenario.

Source: ours.
"""

from __future__ import annotations

from functools import partial

from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.cues.cue_sensors import CueSensors, DroneReceiver, Positions
from links.simulated.rig.scenario import Scenario
from links.simulated.world.flight import Flight
from links.simulated.world.flown_motion import FlownMotion
from links.simulated.world.path import Path
from links.simulated.world.suspension import SuspendedPath
from stages.geometry.frames import Array64


def cue_sensors(
    scenario: Scenario, vehicle: Path | SuspendedPath, drone: Path | Flight | FlownMotion | None
) -> CueSensors | None:
    """The vehicle's receiver and the ranging radios; None: the scenario has no cues."""
    if scenario.cues is None:
        return None
    poses, drones, heading_deg = vehicle.level_poses, _drones_of(scenario, drone), _heading_deg(scenario)
    return CueSensors(scenario.cues, poses, drones, heading_deg, scenario.start_ns, scenario.duration_s, scenario.seed)


def drone_receiver(scenario: Scenario, flight: Flight) -> DroneReceiver | None:
    """The drone's GNSS receiver and barometer; None: it has none."""
    cues = scenario.cues
    if cues is None or cues.drone is None:
        return None
    return DroneReceiver(
        cues.drone,
        cues.barometer,
        _drones_of(scenario, flight),
        -scenario.vehicle.camera_height_m,
        _heading_deg(scenario),
        scenario.duration_s,
        scenario.seed,
    )


def _heading_deg(scenario: Scenario) -> float:
    """Heading of the world's x axis, clockwise from north."""
    return (scenario.autopilot or AutopilotSettings()).heading_of_world_x_deg


def _drones_of(scenario: Scenario, first: Path | Flight | FlownMotion | None) -> tuple[Positions, ...]:
    """Positions of all drones, the first one as flown."""
    return () if first is None else tuple(partial(_at_m, m) for m in (first, *(o.path for o in scenario.other_drones)))


def _at_m(motion: Path | Flight | FlownMotion, time_s: Array64) -> Array64:
    return motion.at(time_s)[0]
