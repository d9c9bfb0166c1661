"""One host of a test as a process: `run_host.py CONFIG HOSTS NAME [clock ahead in s]`.

Runs its part of the graph live; without a hosts file (`-`) the whole graph. Reads stdin: `report` prints a line of
counters, end of file stops the host.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

ahead_ns = round(float(sys.argv[4]) * 1e9) if len(sys.argv) > 4 else 0
wall_ns = time.time_ns
time.time_ns = lambda: wall_ns() + ahead_ns  # before the first use: the clock of this host is wrong

from flow.graph import load_graph  # noqa: E402
from flow.live import Live  # noqa: E402
from links.clock.host_time import now_ns  # noqa: E402
from links.zenoh import host_graph  # noqa: E402


def print_line(**what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main() -> None:
    graph = load_graph(Path(sys.argv[1]))
    if sys.argv[2] != "-":
        graph = host_graph(graph, Path(sys.argv[2]), sys.argv[3])
    live = Live(graph, now_ns=now_ns)
    live.start()
    print_line(kind="started")
    for line in sys.stdin:
        if line.strip() == "report":
            report = live.report()
            statuses = {name: link.status for name, link in live.nodes.items() if link.status}
            events = [str(event) for event in report.events]
            print_line(
                kind="report",
                counters={name: dict(c) for name, c in report.counters.items()},
                statuses=statuses,
                events=events,
            )
    begin_s = time.monotonic()
    live.stop()
    print_line(kind="stopped", took_s=time.monotonic() - begin_s)


main()
