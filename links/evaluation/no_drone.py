"""Runs without a drone, all of a configuration together: how often was one invented, and how sure is that?

Source: ours. One invented drone is a track's outputs without a silence of more than a second, however many they are.
The bound is that of a Poisson process, 95 % one-sided: inventions do not come in pairs, outputs do.
"""

from __future__ import annotations

from dataclasses import dataclass

from links.evaluation.compare import by_config
from links.evaluation.judged import Evaluation, minutes
from links.evaluation.statistics import poisson_upper


@dataclass(frozen=True, slots=True)
class Alarms:
    """The drone-free runs of one configuration."""

    config: str
    runs: int
    hours: float
    outputs: int
    invented: int
    detections: int  # accepted candidates
    by_recording: dict[str, int]  # drones invented, where there were any

    @property
    def per_h(self) -> float:
        """Drones invented per hour."""
        return self.invented / self.hours

    @property
    def upper_per_h(self) -> float:
        """What the rate stays below with 95 % confidence."""
        return poisson_upper(self.invented) / self.hours


def alarms(evaluations: list[Evaluation]) -> list[Alarms]:
    """One row for each configuration; runs whose length is not known are left out."""
    rows: list[Alarms] = []
    for config, several in by_config(evaluations).items():
        runs = [(e, e.span_ns) for e in several if e.run.no_drone and e.span_ns is not None]
        if not runs:
            continue
        invented: dict[str, int] = {}
        for e, _ in runs:
            count = int(e.values["invented_drones"].value or 0)
            if count:
                invented[e.run.recording] = invented.get(e.run.recording, 0) + count
        rows.append(
            Alarms(
                config,
                len(runs),
                sum(minutes(span) for _, span in runs) / 60,
                sum(len(e.output.poses) for e, _ in runs),
                sum(invented.values()),
                sum(len(sweep.accepted_xyz_m) for e, _ in runs for sweep in e.run.sweeps or ()),
                invented,
            )
        )
    return rows
