"""LiDAR packets and motion of the servo of a recorded flight, so that a live run needs no ray casting.

Ray casting takes about one core in real time. What a live run itself needs of a computer is measured with a recording
of the same flight: its packets are sent unchanged, with their recorded stamps, and the servo follows its recorded
positions, whatever it is commanded. The recording must have the same seed, start, scene, weather, vehicle, drones with
their motion, LiDAR and mount, and must not be shorter.

Source: ours.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flow.link import LinkError, Record
from links.recording import RecordingReader
from links.simulated.rig.image_cache import first_difference, flight_settings, recorded_scenario
from links.simulated.rig.scenario import Scenario
from links.simulated.sensors.servo import STEP_NS, Servo, ServoSettings
from stages.geometry.frames import Array64

PACKETS, SERVO, HITS = "/lidar/packets", "/servo/state", "/truth/hits"


class RecordedServo(Servo):
    """A servo that moves as recorded: `position_rad` (n,) in steps of 1 ms from the start of the flight on."""

    def __init__(self, settings: ServoSettings, position_rad: Array64) -> None:
        super().__init__(settings)
        self._recorded_rad, self._steps = position_rad, 0
        self.position_rad = self.goal_rad = float(position_rad[0])

    def step(self, dt_s: float) -> None:
        """Move to the recorded position, after the last one not at all."""
        before_rad = self.position_rad
        self._steps = min(self._steps + 1, len(self._recorded_rad) - 1)
        self.position_rad = float(self._recorded_rad[self._steps])
        self.velocity_radps = (self.position_rad - before_rad) / dt_s


class RecordedLidar:
    """A recording of a scenario's LiDAR. LinkError states why it is none."""

    def __init__(self, file: Path, scenario: Scenario) -> None:
        self._scenario = scenario
        with RecordingReader(file) as reader:
            recorded = recorded_scenario(reader)
            for topic in (PACKETS, SERVO):
                if topic not in reader.topics:
                    raise LinkError(f"{file} has nothing on {topic}: record the flight with its LiDAR")
        difference = first_difference(_lidar_settings(recorded), _lidar_settings(scenario))
        if difference is None and recorded.duration_s < scenario.duration_s:
            difference = "duration_s", f"{recorded.duration_s:g}", f"{scenario.duration_s:g}"
        if difference is not None:
            where, there, here = difference
            raise LinkError(
                f"{file} is of another flight: {where} is {there} in it, {here} now; record this one: grd simulate "
                f"SCENARIO -o FILE --duration {scenario.duration_s:g} --closed-loop CONFIG"
            )
        self._file = file
        self._records = self._read()
        self._next = next(self._records, None)

    def servo(self) -> RecordedServo:
        """The servo, at the start of the flight. Between readings its position is interpolated."""
        readings: list[tuple[int, float]] = []
        end_ns = round(1e9 * self._scenario.duration_s)
        with RecordingReader(self._file) as reader:
            for record in reader.records([SERVO]):
                since_ns = record.stamp_ns - self._scenario.start_ns
                readings.append((since_ns, float(json.loads(record.data)["position_rad"])))
                if since_ns > end_ns:
                    break
        since_start_ns, position_rad = np.array(sorted(readings)).T
        at_ns = np.arange(0, end_ns + 1, STEP_NS, dtype=np.float64)
        return RecordedServo(self._scenario.servo, np.interp(at_ns, since_start_ns, position_rad))

    def records(self, first_ns: int, until_ns: int) -> list[Record]:
        """Packets, and the pulses that a drone returned, with stamps from `first_ns` on and before `until_ns`.

        Times increase from call to call; what was recorded between two calls is lost, as on a cable.
        """
        records: list[Record] = []
        while self._next is not None and self._next.stamp_ns < until_ns:
            if self._next.stamp_ns >= first_ns:
                records.append(self._next)
            self._next = next(self._records, None)
        return records

    def _read(self) -> Iterator[Record]:
        with RecordingReader(self._file) as reader:
            yield from reader.records([PACKETS, HITS])


def _lidar_settings(scenario: Scenario) -> dict[str, Any]:
    """All settings that affect the packets, but the commands to the servo."""
    settings = scenario.model_dump(mode="json", include={"rig", "lidar_gaps_s"})
    lidar = scenario.lidar.of_model(scenario.rig.profile).model_dump(mode="json")
    return {**flight_settings(scenario), **settings, "lidar": lidar}
