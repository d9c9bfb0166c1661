"""Compiles and loads all kernels of a graph before a live run.

Without it the first packets wait while kernels compile (seconds after an update) or load (tenths of a second). Which
functions a graph calls, with which types, shows when a recording is replayed through it. The recording is a committed
simulated one with every sensor; its first seconds, until the whole pose is known, reach all stages. No state remains:
the live run builds its nodes again. The recording is of a VLP-16: where another LiDAR is configured, the graph is that
on the recording's rig, which runs the same kernels.

The functions and types are kept beside numba's cache, under a name that depends on the graph's classes and on all
source. A later start loads these functions in place of the replay.

Source: ours; numba compiles at the first call.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from dataclasses import replace
from pathlib import Path

from flow.compile_cache import ROOT, cache_name
from flow.config_error import ConfigError
from flow.graph import Graph
from flow.link import TRUTH_TOPICS, LinkError
from flow.ports import RunError
from flow.replay import Replay
from links.lidar import Lidar
from links.recording import Progress, RecordingReader
from links.runs.request import RunRequest
from links.runs.shipped import RECORDINGS
from stages.kernels.calls import FOLDER, VERSION, calls_made, load_calls

RECORDING = RECORDINGS / "experiment_1.mcap"
SOURCE = ("flow", "links", "stages")  # folders whose code decides which functions are called with which types
REPLAYED_NS = 6_000_000_000  # of the recording; its pose is FULL before


def warm_up_graph(graph: Graph, request: RunRequest) -> Graph:
    """The graph to replay the recording through: `graph`, or for another LiDAR that on the recording's rig."""
    try:
        with RecordingReader(RECORDING) as reader:
            sets = tuple(text for text in request.sets if not text.startswith("rig."))
            on_recording = replace(request, sets=sets).graph(reader.rig_yaml, str(RECORDING))
    except (ConfigError, LinkError):
        return graph
    return graph if _models(graph) == _models(on_recording) else on_recording


def _models(graph: Graph) -> list[str]:
    return [Lidar(**spec.config).settings.unit.model for spec in graph.nodes.values() if spec.cls is Lidar]


def warm_up(graph: Graph, progress: Progress, recording: Path = RECORDING) -> str | None:
    """Load all kernels; None, or the reason why the replay of the recording's start failed or ended early."""
    calls = _calls_file(graph, recording)
    if calls.is_file() and load_calls(calls.read_bytes(), progress):
        return None
    try:
        with RecordingReader(recording) as reader:
            runner = Replay(graph)
            first_ns: int | None = None
            for record in reader.records():
                first_ns = record.arrival_ns if first_ns is None else first_ns
                if record.arrival_ns - first_ns > REPLAYED_NS:
                    break
                progress(record.arrival_ns - first_ns, REPLAYED_NS)
                if not record.topic.startswith(TRUTH_TOPICS):
                    runner.feed(record)
            progress(REPLAYED_NS, REPLAYED_NS)
            runner.finish()
    except (LinkError, RunError) as error:
        return f"warm-up on {recording.name} failed, the first messages may be late: {error}"
    _keep(calls)
    return None


def _calls_file(graph: Graph, recording: Path) -> Path:
    """Where the calls of a graph on a recording are kept; its name changes with all that decides about them."""
    classes = sorted(f"{spec.cls.__module__}.{spec.cls.__qualname__}" for spec in graph.nodes.values())
    source = cache_name(ROOT / name for name in SOURCE)
    of = "\n".join([*classes, str(recording.resolve()), source, sys.version, VERSION])
    return FOLDER / f"calls-{hashlib.sha256(of.encode()).hexdigest()[:16]}.pickle"


def _keep(calls: Path) -> None:
    with contextlib.suppress(OSError):  # a full or read-only disk: the next start replays
        calls.parent.mkdir(parents=True, exist_ok=True)
        part = calls.with_suffix(f".{os.getpid()}")
        part.write_bytes(calls_made())
        part.replace(calls)
