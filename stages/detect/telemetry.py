"""All that the drone says of its flight, by whichever messages its autopilot sends, as the detector asks for it.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable

import numpy as np

from stages.detect.candidate import START_SPEED_MPS, Candidate, Sighting
from stages.detect.flight import scatter_m
from stages.detect.motion_log_ratios import Heard, hear
from stages.detect.reacquire import met_again
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import DroneLocalPosition, DroneOdometry
from stages.odometry.drone.telemetry import DroneTelemetry

MOVES_MPS = 1.0
LOOKS_SINCE = 3  # that a way tells anything


class DroneWord:
    """Its local position and its odometry; where both speak the first is asked first."""

    def __init__(self) -> None:
        self._position, self._odometry = DroneTelemetry(), DroneTelemetry()
        self._both = (self._position, self._odometry)

    def add_position(self, position: DroneLocalPosition) -> None:
        """What its position filter tells."""
        self._position.add_position(position)

    def add_odometry(self, odometry: DroneOdometry) -> None:
        """The same from an autopilot that sends this."""
        self._odometry.add_odometry(odometry)

    def of(self, c: Candidate, motion_known: bool) -> Heard | None:
        """What it says for and against a candidate; None: nothing.

        Of one that was met again elsewhere its way since then counts alone where that is denied: two things that by
        chance lie as the drone flew, of which the second flies otherwise.
        """
        heard = self._of(c, 0, motion_known)
        if heard is None or not c.joined_at or c.hit_looks - c.joined_at < LOOKS_SINCE:
            return heard
        since = self._of(c, bisect_left(c.path_ns, c.joined_ns), motion_known)
        return since if since is not None and since.denied else heard

    def _of(self, c: Candidate, first: int, motion_known: bool) -> Heard | None:
        """The same of its sightings from number `first` on."""
        path_ns, path_m, heard = c.path_ns[first:], c.path_m[first:], None
        for told in self._both:
            heard = heard or hear(told, path_ns, path_m, 0.03 + scatter_m(c.range_m), motion_known)
        return heard

    def met_again(self, candidates: Iterable[Candidate], s: Sighting) -> tuple[Candidate, Array64] | None:
        """The candidate that a sighting elsewhere goes on with, and its velocity (3,); see `rejoin.py`."""
        for told in self._both:
            if met := met_again(candidates, s, told):
                return met
        return None

    def moves(self, stamp_ns: int) -> bool:
        """Whether it says that it flies: then it is not what stands where something stood."""
        speeds = [told.speed_mps(stamp_ns) for told in self._both]
        return any(speed is not None and math.hypot(*speed) > MOVES_MPS for speed in speeds)

    def usual_flight(self, trail: VehicleTrajectory, now_ns: int) -> tuple[Array64, float, float]:
        """How a drone flies now (3,), one sigma on each axis: as fast as it says; else it comes along with the vehicle.

        And the level speed that it says it has, 0 when it is silent.
        """
        speeds = [told.speed_mps(now_ns) for told in self._both]
        for speed in speeds:
            if speed is not None:
                return np.array([0.0, 0.0, speed[1]]), 0.3 + 0.7 * speed[0], speed[0]
        return trail.velocity_mps(now_ns), START_SPEED_MPS / 2, 0.0
