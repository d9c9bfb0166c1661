"""A live run with a limit of 3 MB per file: it reports the limit, continues, and prints its counters.

python record_on_a_small_disk.py FOLDER
"""

import json
import resource
import sys
import threading
from pathlib import Path

from flow.graph import load_graph
from flow.link import Run
from flow.live import Live
from links.recording import Recorder

LIMIT_BYTES = 3_000_000
GRAPH = """\
stages: {brittle: {use: tests.flow.live_toys.Brittle, inputs: {number: line.number}}}
links:
  line: {use: tests.flow.live_toys.Line}
  collector: {use: tests.flow.live_toys.Collector, inputs: {number: brittle.number}}
"""


def main(folder: Path) -> None:
    (folder / "graph.yaml").write_text(GRAPH)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT_BYTES, LIMIT_BYTES))
    graph = load_graph(folder / "graph.yaml")
    recorder = Recorder()
    recorder.open(Run(folder, "graph", "", graph.settings_yaml(), True))
    live = Live(graph, [recorder])
    live.start()
    collector = live.nodes["collector"]
    numbers = 0
    while recorder.status is None:  # a number is a record of 1 to 1000 digits; they do not compress well
        for _ in range(50):
            numbers += 1
            live.nodes["line"].put(f"{numbers}.{hash(('a', numbers)) ** 40}"[:1000])
        collector.take(50)
    live.nodes["line"].put(7)
    (after,) = collector.take(1)
    while not any("nothing is recorded now" in str(event) for event in live.report().events):
        threading.Event().wait(0.01)
    report = live.stop()
    recorder.close()
    events = [str(event) for event in report.events]
    output = {
        "after": after,
        "events": events,
        "counters": recorder.counters,
        "taken": report.edges["collector.number"].taken,
    }
    sys.stdout.write(json.dumps(output))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
