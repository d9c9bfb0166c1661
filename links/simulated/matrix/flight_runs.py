"""Flies scenarios in closed loop, several seeds each, and keeps the outcome of each flight as a small file.

An outcome is kept when it was flown with the same settings of scenario and configuration, so the command can be
interrupted and repeated. The recording of a flight is not kept: `grd simulate` with the same scenario, settings,
configuration and seed makes it.

Source: ours.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from flow.config_error import ConfigError
from flow.jobs import Workers, run_all
from flow.link import LinkError
from flow.ports import RunError
from links.runs.request import RunRequest
from links.simulated.rig.closed_loop import ClosedLoop, loop_metadata
from links.simulated.rig.flight_in_the_loop import check_loop
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import load_scenario


@dataclass(frozen=True)
class FlightTask:
    """One flight."""

    scenario: Path
    sets: tuple[str, ...]  # changed settings of the scenario
    config: Path
    seed: int
    folder: Path

    @property
    def file(self) -> Path:
        """Where its outcome is kept."""
        return self.folder / f"{self.scenario.stem}-s{self.seed}.json"


@dataclass(frozen=True)
class FlightResult:
    """The outcome of a flight, or why there is none."""

    scenario: str
    seed: int
    outcome: dict[str, Any] | None  # fields of `Outcome`
    error: str = ""  # the scene of this seed does not allow the flight, or a stage failed
    kept: bool = False

    def __str__(self) -> str:
        where = f"{self.scenario} seed {self.seed}"
        return f"{where}: {self.error or (self.outcome or {}).get('text', '')}"


def fly_all(
    scenarios: Sequence[Path],
    sets: Sequence[str],
    config: Path,
    seeds: range,
    folder: Path,
    workers: Workers,
    progress: Callable[[float, float], None],
) -> list[FlightResult]:
    """Fly each scenario with each seed, seed by seed. ConfigError, LinkError for a scenario or the configuration."""
    for scenario in scenarios:  # errors in files before the first flight
        loaded = load_scenario(scenario, sets)
        if loaded.autopilot is None or loaded.autopilot.flight_stack is None:
            raise LinkError(f"{scenario}: no autopilot in the loop, set autopilot.flight_stack")
        check_loop(RunRequest(config).graph(loaded.rig_yaml(), f"{scenario} (rig)"), loaded)
    tasks = [FlightTask(s, tuple(sets), config, seed, folder) for seed, s in product(seeds, scenarios)]
    folder.mkdir(parents=True, exist_ok=True)
    return run_all(fly, tasks, workers, lambda shares: progress(float(sum(shares)), len(tasks)))


def fly(task: FlightTask, progress: Callable[[float], None]) -> FlightResult:
    """Fly one task, or take its outcome from the file."""
    name = task.scenario.stem
    scenario = load_scenario(task.scenario, task.sets).changed(seed=task.seed)
    graph = RunRequest(task.config).graph(scenario.rig_yaml(), f"{name} (rig)")
    metadata = loop_metadata(task.config, graph)
    made = hashlib.blake2b(f"{scenario.as_yaml()}{metadata}".encode(), digest_size=16).hexdigest()
    if (kept := _kept(task.file, made)) is not None:
        return FlightResult(name, task.seed, kept, kept=True)
    try:
        loop = ClosedLoop(graph, scenario.closed_loop, metadata)
        simulation = Simulation(scenario, loop=loop, record_truth=False)
        assert simulation.flight is not None
        for count, record in enumerate(simulation.records()):
            if count % 1000 == 0:
                progress(min(1.0, (record.arrival_ns - scenario.start_ns) * 1e-9 / scenario.duration_s))
    except (LinkError, ConfigError, RunError) as error:
        return FlightResult(name, task.seed, None, str(error))
    outcome = simulation.flight.result()
    assert outcome is not None
    content = json.loads(outcome.as_json()) | {"text": str(outcome).removeprefix("flight: "), "made": made}
    partial = task.file.with_suffix(".part")
    partial.write_text(json.dumps(content), encoding="utf-8")
    partial.replace(task.file)
    return FlightResult(name, task.seed, content)


def _kept(file: Path, made: str) -> dict[str, Any] | None:
    """The outcome in a file, if it is that of the same settings."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and content.get("made") == made else None
