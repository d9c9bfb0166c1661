"""The folder that a run leaves: its configuration, its results, what truth says of them, and a summary.

A replay fills it, and so do a live run and a closed loop while its recording is made: one graph leaves the same files.

Source: DESIGN, Outputs of a run.
"""

from __future__ import annotations

import json
import resource
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml

from flow.config.draw import mermaid
from flow.config.tree import Section
from flow.config_error import Location
from flow.graph import Graph, load_graph
from flow.link import LinkError, Run, Source, Tap
from flow.live.report import LiveReport
from flow.replay import RunReport, replay
from flow.stage import Stage
from flow.subprocess_replay import can_use_subprocesses, replay_in_subprocesses
from flow.taps import Digest
from links.mavlink.autopilot import Autopilot
from links.mavlink.gate import Limits
from links.recording import Progress, RecordingReader, Session
from links.runs.result_file import ResultFile
from links.runs.results import SUMMARY_FILE, Results, stamp_s
from links.runs.truth import TRUTH_RECORDING, FixErrors, TruthLog
from links.runs.usage import Usage
from links.velodyne import Lidar, flown_lidars
from stages.messages import Detections, DroneFix, RelativePose

CONFIG_FILE = "config.yaml"
SEEKING = (Detections, DroneFix, RelativePose)  # who tells one of these seeks a drone


@dataclass(frozen=True, slots=True)
class Asked:
    """A configuration as it was asked for: a file, files laid over it, and settings changed."""

    config: Path
    overlays: tuple[Path, ...] = ()
    sets: tuple[str, ...] = ()

    def graph(self, rig_yaml: str | None, where: str) -> Graph:
        """The graph, on a rig of its own or (None) the configuration's. Raises ConfigError; LinkError for the rig."""
        sections: dict[str, Section] | None = None
        if rig_yaml is not None:
            place = Location(where, 0)
            try:
                sections = {"rig": (yaml.safe_load(rig_yaml), place)}
            except yaml.YAMLError as error:
                raise LinkError(f"{place} is not YAML: {str(error).splitlines()[0]}") from None
        return load_graph(self.config, self.overlays, self.sets, sections)


@dataclass(frozen=True, slots=True)
class Finished:
    """A run that is done, for telling about it."""

    recording: Path
    out_dir: Path
    report: RunReport
    results: Results
    errors: FixErrors | None
    digest: str
    wall_s: float
    warnings: list[str]
    usage: Usage | None = None  # of a live run
    parts: int | None = None  # of the recording, that a replay read
    ran_instead: str = ""  # the stages and what they told, of a configuration none of whose stages seeks a drone


class RunFolder:
    """`with RunFolder(folder, recording, asked, graph) as run`: a run tells `run.taps` all; `run.finish` ends it.

    The summary comes last: a folder without one holds a run that was stopped.
    """

    def __init__(
        self,
        folder: Path,
        recording: Path,
        asked: Asked,
        graph: Graph,
        began_s: float | None = None,
        *,
        live: bool = False,
    ) -> None:
        """`began_s`: when the run began on the monotonic clock, now if not said."""
        self._folder, self._recording, self._asked, self._graph = folder, recording, asked, graph
        self._live = live
        self._began_s = time.monotonic() if began_s is None else began_s
        self._results, self._open = Results(limits=_limits(graph)), ExitStack()
        declared = [spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Tap)]
        self.taps: list[Tap] = [self._results, *(tap for tap in declared if isinstance(tap, Tap))]

    def __enter__(self) -> RunFolder:
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / SUMMARY_FILE).unlink(missing_ok=True)
        name = self._asked.config.stem if self._live else self._recording.stem
        senders = _senders(self._graph) if self._live else {}
        about = Run(self._folder, name, mermaid(self._graph), self._graph.settings_yaml(), self._live, senders)
        self._write(CONFIG_FILE, about.settings_yaml)
        with ExitStack() as opening:
            for tap in self.taps:
                tap.open(about)
                opening.callback(tap.close)
            self._open = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    def _write(self, name: str, text: str) -> None:
        """A file of the folder. A full disk keeps nobody from flying, and is said by the results."""
        file = ResultFile(self._folder / name, patient=self._live)
        file.write(text)
        file.close()

    def note(self, text: str) -> None:
        """A line of the run's log."""
        self._results.note(text)

    def finish(
        self,
        report: RunReport,
        output_hash: str,
        truth: TruthLog | None,
        warnings: list[str],
        usage: Usage | None = None,
        parts: int | None = None,
    ) -> Finished:
        """End the run: `warnings` are its recording's, `truth` is what the recording says of the drones.

        None: what a simulated rig, which is a tap that has ended then, wrote beside the recording.
        """
        warnings = [*warnings, *_remarks(self._graph, report)]
        for text in (*warnings, f"output hash {output_hash}"):
            self.note(text)
        self._open.close()
        if truth is None:
            truth = truth_beside(self._recording)
        truth.write(self._folder)
        finished = Finished(
            recording=self._recording,
            out_dir=self._folder,
            report=report,
            results=self._results,
            errors=truth.errors_of(self._results.fixes),
            digest=output_hash,
            wall_s=time.monotonic() - self._began_s,
            warnings=warnings,
            usage=usage,
            parts=parts,
            ran_instead=_ran_instead(self._graph, report),
        )
        text = json.dumps(_summary(finished, self._asked), indent=2)
        self._write(SUMMARY_FILE, text + "\n")
        return finished


def _ran_instead(graph: Graph, report: RunReport) -> str:
    """`aim (CalibrationSweep: 12 servo_goal)`, ...; empty where a stage seeks a drone: then its finds are the story."""
    told: dict[str, list[str]] = {spec.name: [] for spec in graph.nodes.values() if issubclass(spec.cls, Stage)}
    for node, output, message in graph.outputs():
        if node not in told:
            continue
        if message in SEEKING:
            return ""
        told[node].append(f"{report.messages.get(f'{node}.{output}', 0)} {output}")
    return "; ".join(f"{n} ({graph.nodes[n].cls.__name__}: {', '.join(t) or 'tells nothing'})" for n, t in told.items())


def _limits(graph: Graph) -> Limits:
    """Of the autopilot's gate, as configured."""
    links = (spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Autopilot))
    return next((link.settings.limits for link in links if isinstance(link, Autopilot)), Limits())


def _senders(graph: Graph) -> dict[str, dict[str, str]]:
    """What the sources' settings tell of who sends on which topic."""
    senders: dict[str, dict[str, str]] = {}
    for spec in graph.nodes.values():
        if issubclass(spec.cls, Source):
            source = spec.build()
            assert isinstance(source, Source)
            senders |= source.senders
    return senders


def replay_into(
    folder: Path, recording: Path, asked: Asked, progress: Progress | None = None, *, together: bool = False
) -> Finished:
    """Replay a recording, all its parts, with its own rig when it has one. Raises ConfigError, LinkError, RunError.

    `together`: in one process, whatever the configuration says.
    """
    began_s = time.monotonic()
    session = Session(recording)
    graph = asked.graph(session.rig_yaml, f"{recording} (rig.yaml)")
    truth, digest = truth_beside(recording), Digest()
    clocks = other_clocks(graph, session.config_yaml)
    with RunFolder(folder, recording, asked, graph, began_s) as run:
        run_all = replay if together or not can_use_subprocesses() else replay_in_subprocesses
        report = run_all(graph, truth.aside(session.records(progress=progress)), (digest, *run.taps))
        warnings = [*session.warnings, *clocks]
        return run.finish(report, digest.hexdigest(), truth, warnings, parts=len(session.parts))


def other_clocks(graph: Graph, flown_yaml: str | None) -> list[str]:
    """A warning for each LiDAR whose clock is not the one that the recording was flown with, by its topic.

    `flown_yaml` is the configuration in the recording. Free, a LiDAR's stamps are late by a packet's shortest way: a
    `servo_time_offset_s` found with the one clock is wrong with the other.
    """
    flown = dict(_topic_and_clock(config) for config in flown_lidars(flown_yaml))
    warnings: list[str] = []
    for name, spec in graph.nodes.items():
        topic, clock = _topic_and_clock(spec.config)
        before = flown.get(topic, clock)
        if spec.cls is Lidar and before != clock:
            warnings.append(
                f"{name}: flown with `clock: {before}`, replayed with `clock: {clock}`: the LiDAR is moved against "
                f"the servo by a packet's shortest way (some ms); as flown by --set {name}.clock={before}"
            )
    return warnings


def _topic_and_clock(config: dict[str, Any]) -> tuple[str, str]:
    """Of a LiDAR's settings."""
    topic, clock = (str(config.get(key, Lidar.settings_type.model_fields[key].default)) for key in ("topic", "clock"))
    return topic, clock


def truth_beside(recording: Path) -> TruthLog:
    """The truth that a simulated rig wrote beside a live recording; empty where there is none."""
    truth, file = TruthLog(), recording.parent / TRUTH_RECORDING
    if file.is_file() and file != recording:
        with RecordingReader(file) as reader:
            truth.take(reader.records())
    return truth


def holds_run(folder: Path, recording: Path, graph: Graph) -> bool:
    """Whether a folder holds the whole run of a graph over a recording: same settings, no older than the recording."""
    try:
        is_new = (folder / SUMMARY_FILE).stat().st_mtime_ns >= recording.stat().st_mtime_ns
        return is_new and (folder / CONFIG_FILE).read_text(encoding="utf-8") == graph.settings_yaml()
    except FileNotFoundError:
        return False


def _remarks(graph: Graph, report: RunReport) -> list[str]:
    """What went wrong, and in a replay what was not used, so that a silent port is not taken for a quiet sensor."""
    remarks = [*graph.left_out_texts(), *(str(event) for event in report.events)]
    if isinstance(report, LiveReport):
        return remarks
    remarks += [f"{count} records on {topic} are wired to nothing" for topic, count in report.unwired_topics.items()]
    silent = [spec.name for spec in graph.nodes.values() if spec.kind == "links" and report.nodes[spec.name].calls == 0]
    sources = {edge.producer for edge in graph.edges}
    remarks += [f"the recording holds nothing for '{name}'" for name in silent if name in sources]
    return remarks


def _summary(run: Finished, asked: Asked) -> dict[str, Any]:
    report, results = run.report, run.results
    summary: dict[str, Any] = {
        "grd": version("grd"),
        "recording": run.recording.name,
        **({"parts": run.parts} if run.parts is not None and run.parts > 1 else {}),
        "config": asked.config.name,
        "overlays": [path.name for path in asked.overlays],
        "set": list(asked.sets),
        "output_hash": run.digest,
        "records": report.records,
        "start_s": stamp_s(report.first_ns),
        "end_s": stamp_s(report.last_ns),
        "recorded_s": (report.last_ns - report.first_ns) / 1e9,
        "messages": report.messages,
        "sweeps": results.sweeps,
        "sweeps_with_drone": results.sweeps_with_drone,
        "verdicts": [{"sweeps": count, "example": verdict} for verdict, count in results.verdicts],
        "fixes": len(results.fixes),
        "poses": {"states": results.pose_states, "resets": results.resets},
        "states": [
            {"stamp_s": stamp_s(t.stamp_ns), "track_id": t.track_id, "state": t.state, "reason": t.reason}
            for t in results.transitions
        ],
        "warnings": run.warnings,
        "counters": report.counters,
        "wall_s": round(run.wall_s, 3),
        "compute_ms": {
            name: {
                "calls": node.calls,
                "p50": round(node.compute.percentile_ns(50) / 1e6, 4),
                "p99": round(node.compute.percentile_ns(99) / 1e6, 4),
                "max": round(node.compute.max_ns / 1e6, 4),
                "total": round(node.compute.total_ns / 1e6, 1),
            }
            for name, node in report.nodes.items()
        },
    }
    if isinstance(report, LiveReport):
        summary["live"] = _live(report, run.usage) | ({} if run.usage is None else {"usage": run.usage.columns})
    if run.errors is not None:
        summary["against_truth"] = _judged(run.errors)
    return summary


def _live(report: LiveReport, usage: Usage | None) -> dict[str, Any]:
    """What only a live run can tell: how late it was, what it dropped, what went wrong."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    others_s = 0.0 if usage is None else usage.others_cpu_s
    edges = {name: {key: _rounded(value) for key, value in asdict(edge).items()} for name, edge in report.edges.items()}
    return {
        "cpu_s": round(used.ru_utime + used.ru_stime + others_s, 2),
        "max_rss_mb": round(used.ru_maxrss / 1024, 1),  # Linux tells kB; `usage` has the other processes', too
        "dropped": report.dropped,
        "missed_deadlines": report.missed,
        "edges": edges,
        "links": {name: asdict(link) for name, link in report.links.items()},
        "restarts": report.restarts,
        "failures": report.failures,
        "switched_off": report.switched_off,
        "not_shown": report.tap_drops,
        "events": [
            {
                "first_s": stamp_s(i.first_ns),
                "last_s": stamp_s(i.last_ns),
                "count": i.count,
                "what": f"{i.node}: {i.text}",
            }
            for i in report.events
        ],
    }


def _rounded(value: Any) -> Any:
    return round(value, 3) if isinstance(value, float) else value


def _judged(errors: FixErrors) -> dict[str, Any]:
    if not len(errors.stamps_ns):
        return {"fixes": 0, "fixes_without_truth": errors.not_covered}
    return {
        "fixes": len(errors.stamps_ns),
        "fixes_without_truth": errors.not_covered,
        "rmse_xyz_m": [round(float(v), 4) for v in errors.rmse_xyz_m],
        "rmse_3d_m": round(errors.rmse_m, 4),
        "mean_nees_of_3": round(float(errors.nees.mean()), 3),
        "inside_95_percent_ellipsoid": round(errors.inside_95, 4),
    }
