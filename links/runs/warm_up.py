"""Replays a recording through a graph before a live run, so that all kernels are compiled and loaded at its start.

Without it the first packets wait while kernels compile (seconds after an update) or load (tenths of a second). The
recording is a committed simulated one with every sensor; its first seconds, until the whole pose is known, reach all
stages. No state remains: the live run builds its nodes again. The recording is of a VLP-16: where another LiDAR is
configured, the graph is that on the recording's rig, which runs the same kernels.

Source: ours; numba compiles at the first call.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from flow.config_error import ConfigError
from flow.graph import Graph
from flow.link import TRUTH_TOPICS, LinkError
from flow.ports import RunError
from flow.replay import Replay
from links.lidar import Lidar
from links.recording import Progress, RecordingReader
from links.runs.request import RunRequest
from links.runs.shipped import RECORDINGS

RECORDING = RECORDINGS / "experiment_1.mcap"
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
    """Replay the start of a recording through the graph; None, or the reason why the replay failed or ended early."""
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
    return None
