"""The output folder of a run: configuration, results, errors against the truth, and a summary.

A replay, a live run and a simulated closed loop leave the same files. With several drones the folder has the files of
the first, and a folder in it, named after the stage (`fuse_2`), those of each further fused pose.

Replays of several recordings (`replay_all`) are independent tasks: a folder that holds a complete run of the same
recording and settings is kept, and a recording that fails does not stop the others.

Source: DESIGN, Outputs of a run.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from flow.config.draw import mermaid
from flow.config_error import ConfigError
from flow.graph import Graph
from flow.jobs import Workers, run_all
from flow.link import LinkError, Run, Source, Tap
from flow.live.report import LiveReport
from flow.ports import RunError
from flow.replay import RunReport, replay
from flow.stage import Stage
from flow.subprocess_replay import can_use_subprocesses, replay_in_subprocesses
from flow.taps import Digest
from links.lidar import Lidar, recorded_lidars
from links.mavlink.autopilot import Autopilot
from links.recording import Progress, Session
from links.runs.fused_poses import read_fused_poses
from links.runs.request import RunRequest, RunResult
from links.runs.result_file import ResultFile
from links.runs.results import SUMMARY_FILE, Results
from links.runs.summary import summary
from links.runs.truth import TruthLog, label_candidates, read_truth_file
from links.runs.usage import Usage
from stages.messages import Detections, DroneFix, RelativePose

CONFIG_FILE = "config.yaml"
DRONE_MESSAGES = (Detections, DroneFix, RelativePose)  # a stage with one of these outputs searches for a drone


class RunFolder:
    """`with RunFolder(folder, recording, request, graph) as run`: `run.taps` get the messages, `run.finish` ends it.

    The summary is written last: a folder without one holds an interrupted run.
    """

    def __init__(
        self,
        folder: Path,
        recording: Path,
        request: RunRequest,
        graph: Graph,
        started_s: float | None = None,
        *,
        live: bool = False,
    ) -> None:
        """`started_s`: start of the run on the monotonic clock; None: now."""
        self._folder, self._recording, self._request, self._graph = folder, recording, request, graph
        self._live = live
        self._started_s = time.monotonic() if started_s is None else started_s
        gate = _gate(graph)
        chains = _further_chains(graph)
        self._results, self._open = Results(**gate).without(frozenset().union(*chains.values())), ExitStack()
        self._further = {stage: Results(**gate).without(graph.nodes.keys() - own) for stage, own in chains.items()}
        declared = [spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Tap)]
        self.taps: list[Tap] = [
            self._results,
            *self._further.values(),
            *(tap for tap in declared if isinstance(tap, Tap)),
        ]
        self._viewers = _viewers(self.taps, gate)

    def __enter__(self) -> RunFolder:
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / SUMMARY_FILE).unlink(missing_ok=True)
        name = self._request.config.stem if self._live else self._recording.stem
        senders = _senders(self._graph) if self._live else {}
        about = Run(self._folder, name, mermaid(self._graph), self._graph.settings_yaml(), self._live, senders)
        self._write(CONFIG_FILE, about.settings_yaml)
        with ExitStack() as opening:
            folders = {id(results): self._folder / stage for stage, results in self._further.items()}
            for folder in folders.values():
                folder.mkdir(exist_ok=True)
            for tap in self.taps:
                tap.open(replace(about, out_dir=folders.get(id(tap), self._folder)))
                opening.callback(tap.close)
            self._open = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    def _write(self, name: str, text: str) -> None:
        """Write a file of the folder. A full disk does not stop a live run; `Results.status` reports it."""
        file = ResultFile(self._folder / name, tolerant=self._live)
        file.write(text)
        file.close()

    def note(self, text: str) -> None:
        """Append a line to the log of the run."""
        self._results.note(text)

    def finish(
        self,
        report: RunReport,
        output_hash: str | None,
        truth: TruthLog | None,
        warnings: list[str],
        usage: Usage | None = None,
        parts: int | None = None,
    ) -> RunResult:
        """End the run. `warnings` are those of its recording, `truth` is the truth in the recording.

        `truth` None: read the file that a simulated rig wrote next to the recording; the rig is a tap and has ended.
        """
        warnings = [*warnings, *(truth.warnings() if truth else []), *_remarks(self._graph, report)]
        for text in (*warnings, *([] if output_hash is None else [f"output hash {output_hash}"])):
            self.note(text)
        if truth is not None:
            for viewer in self._viewers:
                viewer.truths = [truth.drone_in_vehicle(number) for number in sorted(truth.drones)]
        self._open.close()
        if truth is None:
            truth = read_truth_file(self._recording)
            warnings += truth.warnings()
        result = RunResult(
            recording=self._recording,
            out_dir=self._folder,
            report=report,
            results=self._results,
            errors=None,
            poses=None,
            output_hash=output_hash,
            wall_s=time.monotonic() - self._started_s,
            warnings=warnings,
            usage=usage,
            parts=parts,
            stage_outputs=_stage_outputs(self._graph, report),
        )
        for stage, results in self._further.items():
            self._finish_drone(replace(result, out_dir=self._folder / stage, results=results), truth)
        return self._finish_drone(result, truth)

    def _finish_drone(self, result: RunResult, truth: TruthLog) -> RunResult:
        """The result of one drone with its errors; writes the truth and the summary into its folder."""
        folder, results = result.out_dir, result.results
        truth.write(folder)
        if why := label_candidates(folder, truth):
            result.warnings.append(why)
        errors, poses = truth.fix_errors_of(results.fixes), read_fused_poses(folder, truth)
        result = replace(result, errors=errors, poses=poses)
        text = json.dumps(summary(result, self._request), indent=2, allow_nan=False)
        self._write(str((folder / SUMMARY_FILE).relative_to(self._folder)), text + "\n")
        return result


def _stage_outputs(graph: Graph, report: RunReport) -> str:
    """`aim (CalibrationSweep: 12 servo_goal)`, ...; empty when a stage searches for a drone."""
    counts: dict[str, list[str]] = {spec.name: [] for spec in graph.nodes.values() if issubclass(spec.cls, Stage)}
    for node, output, message in graph.outputs():
        if node not in counts:
            continue
        if message in DRONE_MESSAGES:
            return ""
        counts[node].append(f"{report.messages.get(f'{node}.{output}', 0)} {output}")
    return "; ".join(f"{n} ({graph.nodes[n].cls.__name__}: {', '.join(c) or 'no output'})" for n, c in counts.items())


def _viewers(taps: list[Tap], gate: dict[str, Any]) -> list[Any]:
    """The viewers among the taps, with the gate's settings. Rerun is imported only where a graph has taps."""
    if all(isinstance(tap, Results) for tap in taps):
        return []
    from links.viewer import Viewer
    from links.viewer.scene import Gate

    viewers = [tap for tap in taps if isinstance(tap, Viewer)]
    for viewer in viewers:
        viewer.gate = Gate(**gate) if gate else None
    return viewers


def _further_chains(graph: Graph) -> dict[str, frozenset[str]]:
    """The stages of fused poses after the first, each with all nodes that feed it and not the first."""
    fuses = [node for node, _, message in graph.outputs() if message is RelativePose]
    feeding = {fuse: graph.feeding(fuse) for fuse in fuses}
    return {fuse: feeding[fuse] - feeding[fuses[0]] for fuse in fuses[1:]}


def _gate(graph: Graph) -> dict[str, Any]:
    """Settings of the autopilot's gate, as configured."""
    links = (spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Autopilot))
    settings = (link.settings for link in links if isinstance(link, Autopilot))
    return next(({"limits": s.limits, "yaw": s.yaw} for s in settings), {})


def _senders(graph: Graph) -> dict[str, dict[str, str]]:
    """Properties of the sender by topic, from the settings of the sources."""
    senders: dict[str, dict[str, str]] = {}
    for spec in graph.nodes.values():
        if issubclass(spec.cls, Source):
            source = spec.build()
            assert isinstance(source, Source)
            senders |= source.senders
    return senders


def replay_into(
    folder: Path,
    recording: Path,
    request: RunRequest,
    progress: Progress | None = None,
    *,
    single_process: bool = False,
    hashed: bool = True,
) -> RunResult:
    """Replay a recording, all its parts, on its own rig. Raises ConfigError, LinkError, RunError.

    RunError also when no record was decoded.

    `single_process`: ignore the subprocesses of the configuration. `hashed`: compute the output hash.
    """
    started_s = time.monotonic()
    session = Session(recording)
    graph = request.graph_on(session)
    truth, digest = read_truth_file(recording), Digest() if hashed else None
    clock_warnings = clock_differences(graph, session.config_yaml)
    with RunFolder(folder, recording, request, graph, started_s) as run:
        run_graph = replay if single_process or not can_use_subprocesses() else replay_in_subprocesses
        taps = run.taps if digest is None else (digest, *run.taps)
        report = run_graph(graph, truth.without_truth(session.records(progress=progress)), taps)
        if nothing := _nothing_decoded(graph, report):
            raise RunError("; ".join([f"{recording}: {nothing}", *session.warnings, *_remarks(graph, report)]))
        warnings, output_hash = [*session.warnings, *clock_warnings], None if digest is None else digest.hexdigest()
        return run.finish(report, output_hash, truth, warnings, parts=len(session.parts))


def _nothing_decoded(graph: Graph, report: RunReport) -> str:
    """That no source published a message, and what was rejected; empty when one did."""
    links = [(node, output) for node, output, _ in graph.outputs() if graph.nodes[node].kind == "links"]
    if any(report.messages.get(f"{node}.{output}") for node, output in links):
        return ""
    rejected = [
        f"{name}: {count} {reason}"
        for name, counters in report.counters.items()
        for reason, count in counters.rejected.items()
        if count
    ]
    return "; ".join([f"nothing was replayed: none of its {report.records} records was decoded", *rejected])


def clock_differences(graph: Graph, recorded_yaml: str | None) -> list[str]:
    """A warning for each LiDAR whose `clock` setting differs from that of the recorded run, by topic.

    `recorded_yaml` is the configuration in the recording. With a free clock the stamps of a LiDAR are late by the
    shortest packet delay: a `servo_time_offset_s` calibrated with one clock is wrong with the other.
    """
    recorded = dict(_topic_and_clock(config) for config in recorded_lidars(recorded_yaml))
    warnings: list[str] = []
    for name, spec in graph.nodes.items():
        topic, clock = _topic_and_clock(spec.config)
        recorded_clock = recorded.get(topic, clock)
        if spec.cls is Lidar and recorded_clock != clock:
            warnings.append(
                f"{name}: recorded with `clock: {recorded_clock}`, replayed with `clock: {clock}`: the LiDAR stamps "
                "shift against the servo by the shortest packet delay (some ms); use the recorded setting with "
                f"--set {name}.clock={recorded_clock}"
            )
    return warnings


def _topic_and_clock(config: dict[str, Any]) -> tuple[str, str]:
    """Topic and clock in the settings of a LiDAR."""
    topic, clock = (str(config.get(key, Lidar.settings_type.model_fields[key].default)) for key in ("topic", "clock"))
    return topic, clock


def holds_run(folder: Path, recording: Path, graph: Graph) -> bool:
    """Whether a folder holds a complete run of a graph over a recording, with equal settings and not older."""
    try:
        is_new = (folder / SUMMARY_FILE).stat().st_mtime_ns >= recording.stat().st_mtime_ns
        return is_new and (folder / CONFIG_FILE).read_text(encoding="utf-8") == graph.settings_yaml()
    except FileNotFoundError:
        return False


@dataclass(frozen=True)
class ReplayTask:
    """One recording to replay."""

    recording: Path
    folder: Path
    request: RunRequest
    hashed: bool
    single_process: bool


@dataclass(frozen=True)
class ReplayOutcome:
    """What became of a recording: the folder of its run, or why it has none."""

    recording: Path
    folder: Path
    output_hash: str | None = None
    kept: bool = False  # the run was there
    failure: str = ""

    def __str__(self) -> str:
        if self.failure:
            return f"{self.recording}: {self.failure}"
        return f"{self.folder}: {'kept' if self.kept else 'made'}, output hash {self.output_hash or 'not computed'}"


def replay_all(
    recordings: Sequence[Path],
    requests: Sequence[RunRequest],
    out_dir: Path,
    workers: Workers,
    progress: Callable[[float, float], None],
    *,
    single_process: bool = False,
    hashed: bool = True,
) -> list[ReplayOutcome]:
    """Replay each with its request into `out_dir/<recording>-<configuration>`. LinkError: two recordings have one name.

    `single_process`, `hashed`: as in `replay_into`.
    """
    twice = [name for name, count in Counter(path.stem for path in recordings).items() if count > 1]
    if twice:
        raise LinkError(f"several recordings are named {twice[0]}: their runs would share a folder; give each --out")
    tasks = [
        ReplayTask(path, out_dir / f"{path.stem}-{request.config.stem}", request, hashed, single_process)
        for path, request in zip(recordings, requests, strict=True)
    ]
    return run_all(replay_one, tasks, workers, lambda shares: progress(sum(shares), len(tasks)))


def replay_one(task: ReplayTask, report: Callable[[float], None]) -> ReplayOutcome:
    """Replay one recording, unless its folder holds the run. A folder with another run is not changed."""
    try:
        graph = task.request.graph_on(Session(task.recording))
        if holds_run(task.folder, task.recording, graph):
            summary = json.loads((task.folder / SUMMARY_FILE).read_text(encoding="utf-8"))
            return ReplayOutcome(task.recording, task.folder, summary["output_hash"], kept=True)
        if (task.folder / SUMMARY_FILE).exists():
            raise LinkError(
                f"{task.folder} has a run with other settings, or of an older recording: name another --out, or remove "
                "it first"
            )
        result = replay_into(
            task.folder,
            task.recording,
            task.request,
            lambda done, whole: report(done / whole),
            single_process=task.single_process,
            hashed=task.hashed,
        )
    except (LinkError, ConfigError, RunError, OSError) as error:
        return ReplayOutcome(task.recording, task.folder, failure=str(error))
    return ReplayOutcome(task.recording, task.folder, result.output_hash)


def _remarks(graph: Graph, report: RunReport) -> list[str]:
    """Events of the run; of a replay also unwired topics and links without records in the recording."""
    remarks = [*graph.left_out_texts(), *(str(event) for event in report.events)]
    if isinstance(report, LiveReport):
        return remarks
    remarks += [f"{count} records on {topic} are wired to nothing" for topic, count in report.unwired_topics.items()]
    silent = [spec.name for spec in graph.nodes.values() if spec.kind == "links" and report.nodes[spec.name].calls == 0]
    sources = {edge.producer for edge in graph.edges}
    remarks += [f"the recording has no records for '{name}'" for name in silent if name in sources]
    return remarks
