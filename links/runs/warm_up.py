"""Replays a recording through a graph before a live run, so that all kernels are compiled and loaded at its start.

Without it the first packets wait while kernels compile (seconds after an update) or load (tenths of a second). The
recording is a committed simulated one with every sensor; its first seconds, until the whole pose is known, reach all
stages. No state remains: the live run builds its nodes again.

Source: ours; numba compiles at the first call.
"""

from __future__ import annotations

from pathlib import Path

from flow.graph import Graph
from flow.link import TRUTH_TOPICS, LinkError
from flow.ports import RunError
from flow.replay import Replay
from links.recording import Progress, RecordingReader
from links.runs.shipped import RECORDINGS

RECORDING = RECORDINGS / "experiment_1.mcap"
REPLAYED_NS = 6_000_000_000  # of the recording; its pose is FULL before


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
