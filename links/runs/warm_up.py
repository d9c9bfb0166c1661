"""A graph tried on a recording before it runs live: what is compiled at first use is compiled, and loaded, by then.

Without it the first packets wait for seconds where a stage is compiled (the first run after an update), and tenths of a
second each time. The recording is one of grd's own, simulated, with every sensor; nothing of it stays: the nodes are
built anew for the run.

Source: ours; numba compiles at the first call.
"""

from __future__ import annotations

from pathlib import Path

from flow.graph import Graph
from flow.link import TRUTH_TOPICS, LinkError
from flow.ports import RunError
from flow.replay import Replay
from links.recording import Progress, RecordingReader

RECORDING = Path(__file__).resolve().parents[2] / "recordings" / "experiment_1.mcap"


def warm_up(graph: Graph, progress: Progress, recording: Path = RECORDING) -> str | None:
    """Run the graph over a recording; why it was not, or not to its end, in words."""
    try:
        with RecordingReader(recording) as reader:
            runner = Replay(graph)
            for record in reader.records(progress=progress):
                if not record.topic.startswith(TRUTH_TOPICS):
                    runner.feed(record)
            runner.finish()
    except (LinkError, RunError) as error:
        return f"the graph could not be tried on {recording.name} beforehand, the start may be rough: {error}"
    return None
