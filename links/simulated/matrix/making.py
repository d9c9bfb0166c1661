"""Makes the recordings of the scenario matrix and, in closed loop, the runs that belong to them.

Existing recordings and runs are kept if they are complete and made with the same settings. A recording gets its name
when it is complete, a run gets its summary last; interrupted ones are repeated.

Source: ours.
"""

from __future__ import annotations

import enum
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from flow.config_error import ConfigError
from flow.graph import Graph
from flow.jobs import Workers, run_all
from flow.link import TRUTH_TOPICS, LinkError
from flow.ports import RunError
from links.recording import RecordingReader
from links.runs.request import RunRequest
from links.runs.run_folder import RunFolder, holds_run, replay_into
from links.runs.truth import TruthLog
from links.simulated.matrix.flights import Cell
from links.simulated.matrix.matrix import Conditions, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop, loop_metadata, servo_edge
from links.simulated.rig.run import simulate_into
from links.simulated.rig.scenario import Scenario

VIEWER = "links.viewer.Viewer"
PLAIN = Cell("open_lot", 20, "hover", "parked")  # all cells with a drone have the same rig


@dataclass(frozen=True)
class Making:
    """How the recordings of one run over the matrix are made."""

    folder: Path
    closed_loop: RunRequest | None
    results: Path | None  # folder for the runs of the closed loop; None: they are not kept
    conditions: Conditions
    images: Path | None = None  # folder of recordings of the same names, whose images are used


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


class TaskStatus(enum.Enum):
    """What was done for a task."""

    MADE = enum.auto()
    KEPT = enum.auto()
    IMPOSSIBLE = enum.auto()  # the scene of the seed does not allow the cell
    FAILED = enum.auto()


@dataclass(frozen=True)
class TaskResult:
    """Result of a task."""

    status: TaskStatus
    text: str = ""  # reason, unless it was made or kept
    stage_failed: bool = False  # a stage raised an exception; otherwise the cause is outside the graph
    replayed: bool = False  # the recording was kept, its run was missing


@dataclass(frozen=True)
class MatrixReport:
    """Summary of a run over the matrix."""

    made: int
    kept: int  # existing recordings
    replayed: int  # of those kept: their run was missing
    impossible: tuple[str, ...]  # cells that do not fit into the scene of a seed, with the reason
    failed: tuple[TaskResult, ...]


def make_matrix(
    folder: Path,
    selected: list[Cell],
    seeds: range,
    closed_loop: Path | None,
    progress: Callable[[float, float], None],
    conditions: Conditions | None = None,
    results: Path | None = None,
    workers: Workers = 1,
    images: Path | None = None,
) -> MatrixReport:
    """Make what is missing: `folder/<cell>-s<seed>.mcap`, `results/<cell>-s<seed>-<configuration>`.

    With `images` the images of its `<cell>-s<seed>.mcap` are used; a recording fails where that is missing or shows
    another flight (a second call without `images` renders only what is missing). `progress` takes completed and total
    simulated seconds. ConfigError, or LinkError, for a configuration that closes no loop. A failure of one recording is
    in the report and does not stop the others.
    """
    conditions = conditions or Conditions()
    request = None if closed_loop is None else _checked_request(closed_loop, conditions, results is not None)
    making = Making(folder, request, results, conditions, images)
    tasks = [Task(making, cell, seed) for seed, cell in product(seeds, selected)]
    total_s = sum(task.cell.duration_s for task in tasks)

    def report(shares: Sequence[float]) -> None:
        done_s = sum(share * task.cell.duration_s for share, task in zip(shares, tasks, strict=True))
        progress(done_s, total_s)

    folder.mkdir(parents=True, exist_ok=True)
    outcomes = run_all(make_one, tasks, workers, report)
    return MatrixReport(
        made=sum(outcome.status is TaskStatus.MADE for outcome in outcomes),
        kept=sum(outcome.status is TaskStatus.KEPT for outcome in outcomes),
        replayed=sum(outcome.replayed for outcome in outcomes),
        impossible=tuple(outcome.text for outcome in outcomes if outcome.status is TaskStatus.IMPOSSIBLE),
        failed=tuple(outcome for outcome in outcomes if outcome.status is TaskStatus.FAILED),
    )


def _checked_request(closed_loop: Path, conditions: Conditions, for_results: bool) -> RunRequest:
    """The configuration of all closed loops, checked with the rig of a plain cell; runs that are kept have no .rrd."""
    rig_yaml = scenario_of(PLAIN, 1, conditions).rig_yaml()
    graph = RunRequest(closed_loop).graph(rig_yaml, "the matrix's rig")
    servo_edge(graph)
    viewers = [spec.name for spec in graph.nodes.values() if spec.use == VIEWER]
    return RunRequest(closed_loop, sets=tuple(f"{name}.file=null" for name in viewers) if for_results else ())


def make_one(task: Task, progress: Callable[[float], None]) -> TaskResult:
    """Make the recording and the run of a task, where they are missing."""
    try:
        scenario = scenario_of(task.cell, task.seed, task.making.conditions)
    except LinkError as error:
        return TaskResult(TaskStatus.IMPOSSIBLE, f"seed {task.seed}: {error}")
    try:
        return _make(task, scenario, progress)
    except (LinkError, ConfigError, OSError) as error:
        return TaskResult(TaskStatus.FAILED, f"{task.name}: {error}")
    except RunError as error:
        return TaskResult(TaskStatus.FAILED, f"{task.name}: {error}", stage_failed=True)


def _make(task: Task, scenario: Scenario, progress: Callable[[float], None]) -> TaskResult:
    file = task.making.folder / f"{task.name}.mcap"
    request = task.making.closed_loop
    if request is None:
        if is_made(file, scenario, {}):
            return TaskResult(TaskStatus.KEPT)
        _simulate(task, file, scenario, None, progress)
        return TaskResult(TaskStatus.MADE)
    graph = request.graph(scenario.rig_yaml(), f"{scenario.name} (rig)")
    metadata = loop_metadata(request.config, graph)
    results = task.making.results
    folder = results and results / f"{task.name}-{request.config.stem}"
    if is_made(file, scenario, metadata):
        if folder is None or holds_run(folder, file, graph):
            return TaskResult(TaskStatus.KEPT)
        replay_into(folder, file, request, lambda done, whole: progress(done / whole))
        return TaskResult(TaskStatus.KEPT, replayed=True)
    if folder is None:
        _simulate(task, file, scenario, ClosedLoop(graph, scenario.closed_loop, metadata), progress)
    else:
        _simulate_and_keep_run(task, file, scenario, folder, request, graph, progress)
    return TaskResult(TaskStatus.MADE)


def _simulate_and_keep_run(
    task: Task,
    file: Path,
    scenario: Scenario,
    folder: Path,
    request: RunRequest,
    graph: Graph,
    progress: Callable[[float], None],
) -> None:
    """Simulate in closed loop with the graph that a replay of the recording would have, and keep its run."""
    is_new = not folder.exists()
    with ExitStack() as undo, RunFolder(folder, file, request, graph) as run:
        if is_new:  # an impossible flight must not leave an empty run folder
            undo.callback(shutil.rmtree, folder)
        loop = ClosedLoop(graph, scenario.closed_loop, loop_metadata(request.config, graph), run.taps)
        _simulate(task, file, scenario, loop, progress)
        undo.pop_all()
        truth = TruthLog()
        with RecordingReader(file) as reader:
            truth.add_all(reader.records([topic for topic in reader.topics if topic.startswith(TRUTH_TOPICS)]))
            run.finish(loop.report, loop.output_hash, truth, reader.warnings)


def _simulate(
    task: Task, file: Path, scenario: Scenario, loop: ClosedLoop | None, progress: Callable[[float], None]
) -> None:
    """Make a recording; it gets its name when it is complete."""
    images = task.making.images and task.making.images / file.name
    part = file.with_name(f"{file.name}.part")
    try:
        simulate_into(part, scenario, progress, overwrite=True, loop=loop, images=images)
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def is_made(file: Path, scenario: Scenario, metadata: dict[str, str]) -> bool:
    """Whether a file is the complete recording of this scenario with this `loop_metadata` (empty: no closed loop)."""
    if not file.is_file():
        return False
    try:
        with RecordingReader(file) as reader:
            found = {key: value for key, value in reader.metadata.items() if key.startswith("closed_loop")}
            return reader.config_yaml == scenario.as_yaml() and found == metadata and reader.finished
    except LinkError:
        return False
