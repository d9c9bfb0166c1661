"""Makes the recordings of the scenario matrix and, in closed loop, the runs that go with them.

What is there, complete and made alike is kept. A recording gets its name when it is complete, a run its summary last:
what was stopped is made again.

Source: ours.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

from flow.graph import Graph
from flow.link import TRUTH_TOPICS, LinkError
from flow.ports import RunError
from flow.problem import ConfigError
from links.recording import RecordingReader
from links.run_folder import Asked, RunFolder, holds_run, replay_into
from links.simulated.matrix.flights import Cell
from links.simulated.matrix.jobs import run_all
from links.simulated.matrix.matrix import Conditions, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop, loop_metadata, servo_edge
from links.simulated.rig.run import simulate_into
from links.simulated.rig.scenario import Scenario
from links.truth import TruthLog

VIEWER = "links.viewer.Viewer"
PLAIN = Cell("open_lot", 20, "hover", "parked")  # the rig is the same in all cells with a drone


@dataclass(frozen=True)
class Making:
    """How all recordings of one run over the matrix are made."""

    folder: Path
    closed_loop: Asked | None
    results: Path | None  # where the closed loop's runs go, if they are wanted
    conditions: Conditions
    images: Path | None = None  # recordings of the same names, whose images are taken instead of painted


@dataclass(frozen=True)
class Task:
    """One recording to make."""

    making: Making
    cell: Cell
    seed: int

    @property
    def name(self) -> str:
        """`campus-20m-orbit-driving-s1`."""
        return f"{self.cell.name}-s{self.seed}"


@dataclass(frozen=True)
class Outcome:
    """What became of a task."""

    what: Literal["made", "kept", "impossible", "failed"]
    text: str = ""  # why not
    stage_failed: bool = False  # a stage raised; else something outside is to be mended
    replayed: bool = False  # it was kept, and its run was missing


@dataclass(frozen=True)
class MatrixReport:
    """What a run over the matrix did."""

    made: int
    kept: int  # were there, complete and the same
    replayed: int  # of those kept: had no run yet
    impossible: tuple[str, ...]  # cells that a seed's scene has no place for, in words
    failed: tuple[Outcome, ...]


def make_matrix(
    folder: Path,
    wanted: list[Cell],
    seeds: range,
    closed_loop: Path | None,
    progress: Callable[[float, float], None],
    conditions: Conditions | None = None,
    results: Path | None = None,
    jobs: int = 1,
    images: Path | None = None,
) -> MatrixReport:
    """Make what is missing: `folder/<cell>-s<seed>.mcap`, `results/<cell>-s<seed>-<configuration>`.

    With `images` those of its `<cell>-s<seed>.mcap` are taken; where that is missing or of another flight the
    recording fails (painting is slow, and a second call without `images` paints just what is missing).
    `progress` is told simulated seconds done and in all. Raises ConfigError, or LinkError, for a configuration that
    closes no loop; what goes wrong with one recording is in the report, and the others are made.
    """
    conditions = conditions or Conditions()
    asked = None if closed_loop is None else _asked(closed_loop, conditions, results is not None)
    making = Making(folder, asked, results, conditions, images)
    tasks = [Task(making, cell, seed) for seed, cell in product(seeds, wanted)]
    whole_s = sum(task.cell.duration_s for task in tasks)

    def told(shares: Sequence[float]) -> None:
        done_s = sum(share * task.cell.duration_s for share, task in zip(shares, tasks, strict=True))
        progress(done_s, whole_s)

    folder.mkdir(parents=True, exist_ok=True)
    outcomes = run_all(make_one, tasks, jobs, told)
    return MatrixReport(
        made=sum(outcome.what == "made" for outcome in outcomes),
        kept=sum(outcome.what == "kept" for outcome in outcomes),
        replayed=sum(outcome.replayed for outcome in outcomes),
        impossible=tuple(outcome.text for outcome in outcomes if outcome.what == "impossible"),
        failed=tuple(outcome for outcome in outcomes if outcome.what == "failed"),
    )


def _asked(closed_loop: Path, conditions: Conditions, for_results: bool) -> Asked:
    """The configuration of all closed loops, tried on a plain cell's rig; runs that are kept have no viewer file."""
    rig_yaml = scenario_of(PLAIN, 1, conditions).rig_yaml()
    graph = Asked(closed_loop).graph(rig_yaml, "the matrix's rig")
    servo_edge(graph)
    viewers = [spec.name for spec in graph.nodes.values() if spec.use == VIEWER]
    return Asked(closed_loop, sets=tuple(f"{name}.file=null" for name in viewers) if for_results else ())


def make_one(task: Task, progress: Callable[[float], None]) -> Outcome:
    """Make a task's recording and its run, where they are missing."""
    try:
        scenario = scenario_of(task.cell, task.seed, task.making.conditions)
    except LinkError as error:
        return Outcome("impossible", f"seed {task.seed}: {error}")
    try:
        return _make(task, scenario, progress)
    except (LinkError, ConfigError, OSError) as error:
        return Outcome("failed", f"{task.name}: {error}")
    except RunError as error:
        return Outcome("failed", f"{task.name}: {error}", stage_failed=True)


def _make(task: Task, scenario: Scenario, progress: Callable[[float], None]) -> Outcome:
    file = task.making.folder / f"{task.name}.mcap"
    asked = task.making.closed_loop
    if asked is None:
        if is_made(file, scenario, {}):
            return Outcome("kept")
        _simulate(task, file, scenario, None, progress)
        return Outcome("made")
    graph = asked.graph(scenario.rig_yaml(), f"{scenario.name} (rig)")
    made_by = loop_metadata(asked.config, graph)
    results = task.making.results
    folder = results and results / f"{task.name}-{asked.config.stem}"
    if is_made(file, scenario, made_by):
        if folder is None or holds_run(folder, file, graph):
            return Outcome("kept")
        replay_into(folder, file, asked, lambda done, whole: progress(done / whole))
        return Outcome("kept", replayed=True)
    if folder is None:
        _simulate(task, file, scenario, ClosedLoop(graph, scenario.closed_loop, made_by), progress)
    else:
        _simulate_and_keep_run(task, file, scenario, folder, asked, graph, progress)
    return Outcome("made")


def _simulate_and_keep_run(
    task: Task,
    file: Path,
    scenario: Scenario,
    folder: Path,
    asked: Asked,
    graph: Graph,
    progress: Callable[[float], None],
) -> None:
    """The closed loop runs the very graph that a replay of its recording would: it leaves the same run."""
    is_new = not folder.exists()
    with ExitStack() as undo, RunFolder(folder, file, asked, graph) as run:
        if is_new:  # a flight that cannot be made leaves no folder that looks like a run
            undo.callback(shutil.rmtree, folder)
        loop = ClosedLoop(graph, scenario.closed_loop, loop_metadata(asked.config, graph), run.taps)
        _simulate(task, file, scenario, loop, progress)
        undo.pop_all()
        truth = TruthLog()
        with RecordingReader(file) as reader:
            truth.take(reader.records([topic for topic in reader.topics if topic.startswith(TRUTH_TOPICS)]))
            run.finish(loop.report, loop.output_hash, truth, reader.warnings)


def _simulate(
    task: Task, file: Path, scenario: Scenario, loop: ClosedLoop | None, progress: Callable[[float], None]
) -> None:
    """Make a recording; it has its name only when it is complete."""
    images = task.making.images and task.making.images / file.name
    part = file.with_name(f"{file.name}.part")
    try:
        simulate_into(part, scenario, progress, overwrite=True, loop=loop, images=images)
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def is_made(file: Path, scenario: Scenario, made_by: dict[str, str]) -> bool:
    """Whether a file is the complete recording of this scenario, `loop_metadata` the same configuration or without any."""
    if not file.is_file():
        return False
    try:
        with RecordingReader(file) as reader:
            how = {key: value for key, value in reader.metadata.items() if key.startswith("closed_loop")}
            return reader.config_yaml == scenario.as_yaml() and how == made_by and reader.finished
    except LinkError:
        return False
