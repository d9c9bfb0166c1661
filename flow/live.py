"""The live runner: the same graph and stages as in a replay, on threads.

One thread listens to each source, decodes there and sends; each stage, each sink and each tap has a thread and an
inbox (`flow.edge`: how messages wait). Stages that do little for each of many messages share a thread (`thread: NAME`):
Python lets one thread work at a time, and going from one to the next for each packet costs as much as the work. Those
that do much for each of few messages may work in a process of their own (`process: NAME`, `flow.stage_process`).

What goes wrong is reported and handled, and the rest flies on: a stage that raises (`flow.stage_life`), a
link that dies (it is opened again, with pauses that grow), a tap that is slow (it misses messages). With a recorder
among the taps, the order in which each stage took its inputs is recorded (`flow.consumption`), and `flow.rerun` takes
the same steps again: the same messages, the same hash.

Source: ours.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Sequence

from flow.consumption import END_TOPIC
from flow.graph import Graph
from flow.incidents import Incidents
from flow.link import Link, Record, Tap
from flow.live_report import LiveReport
from flow.live_threads import Shared
from flow.live_wiring import Wiring
from flow.metrics import Latency
from flow.replay import NodeReport
from flow.taps import Digest

SWITCH_S = 5e-4  # Python lets another thread go on after this long, not after 5 ms: a packet waits for many threads
HOUSE_S = 0.1  # new order goes to the recorders this often
STATUS_S = 1.0  # the edges' status goes to the taps this often
CLOSE_S, DRAIN_S, REST_S = 0.8, 0.5, 0.1  # of a stop: links end listening; stages and sinks take what waits; the rest
TAPS_S = 0.2  # and taps see what waits for them


class Live:
    """A graph's nodes on threads: `start`, then `stop` when it is enough; `report` at any time.

    `taps` are open and stay open. `now_ns` is the clock of the records' arrivals.
    """

    def __init__(
        self,
        graph: Graph,
        taps: Sequence[Tap] = (),
        *,
        digest: Digest | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        strict: bool = False,
    ) -> None:
        self.incidents = Incidents(now_ns)
        recorders = [tap for tap in taps if type(tap).record is not Tap.record]
        self._shared = Shared(now_ns, self.incidents, recorders, digest, strict)
        self._wiring = Wiring(graph, taps, self._shared)
        self.incidents.tell = self._wiring.tell_incident
        self._names = list(graph.nodes)
        self._troubles: dict[str, str | None] = {}
        self._ended = threading.Event()
        self._house = threading.Thread(target=self._keep_house, name="housekeeping", daemon=True)
        self._switch_s = sys.getswitchinterval()

    @property
    def nodes(self) -> dict[str, Link]:
        """Links by name; stages are in their threads' hands."""
        return self._wiring.links

    @property
    def processes(self) -> list[int]:
        """The process numbers of those in which stages work beside this one."""
        return self._wiring.processes.pids

    def start(self) -> None:
        """Start all threads; sources last, so that nothing is sent to a stage that is not there yet."""
        sys.setswitchinterval(SWITCH_S)
        threads = self._wiring
        threads.processes.wait()
        for thread in (*threads.taps, *threads.sinks, *threads.stage_threads, *threads.sources, self._house):
            thread.start()

    def stop(self) -> LiveReport:
        """End the run in less than 2 s: links close, stages take what waits and finish, taps see it. The report."""
        threads = self._wiring
        self._shared.stopping.set()
        closers = [
            threading.Thread(target=source.close, name=f"close {source.node}", daemon=True)
            for source in threads.sources
        ]
        for closer in closers:
            closer.start()
        self._join([*closers, *threads.sources], CLOSE_S)
        deadline_s = time.monotonic() + DRAIN_S
        for worker in (*threads.stages, *threads.sinks):
            worker.inbox.close()
            if not worker.ended.wait(max(0.0, deadline_s - time.monotonic())):
                worker.inbox.clear()
        self._join([*threads.stage_threads, *threads.sinks], REST_S)
        self._ended.set()
        self._join([self._house], REST_S)
        self._keep_orders()
        self._keep_end()
        for tap in threads.taps:
            tap.end()
        self._join(threads.taps, TAPS_S)
        threads.processes.end()
        sys.setswitchinterval(self._switch_s)
        return self.report()

    def _join(self, threads: Sequence[threading.Thread], within_s: float) -> None:
        """Wait for threads, together no longer than that; those that do not end are named and left behind."""
        deadline_s = time.monotonic() + within_s
        for thread in threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        for thread in threads:
            if thread.is_alive():
                self.incidents.report("run", f"the thread '{thread.name}' did not end in time")

    def _keep_house(self) -> None:
        """Until the end: the order goes to the recorders, the edges' status to the taps, links' troubles are said."""
        status_s = time.monotonic()
        while not self._ended.wait(HOUSE_S):
            self._keep_orders()
            if time.monotonic() < status_s:
                continue
            status_s += STATUS_S
            for edge in self._wiring.edges.values():
                edge.tell(self._shared.now_ns())
            silent = {source.node: source.silence() for source in self._wiring.sources}
            for name, link in self._wiring.links.items():
                trouble = link.trouble or silent.get(name)
                if trouble != self._troubles.get(name):
                    self._troubles[name] = trouble
                    self.incidents.report(name, trouble or "works again", mended=not trouble)

    def _keep_orders(self) -> None:
        for order in self._wiring.orders:
            record = order.take(self._shared.now_ns())
            if record is not None:
                self._shared.keep(record)

    def _keep_end(self) -> None:
        if self._shared.digest is not None:
            now_ns = self._shared.now_ns()
            data = json.dumps({"output_hash": self._shared.digest.hexdigest()}).encode()
            self._shared.keep(Record(END_TOPIC, now_ns, now_ns, data))

    def report(self) -> LiveReport:
        """All counts so far."""
        threads = self._wiring
        lives = {stage.life.name: stage.life for stage in threads.stages}
        compute: dict[str, Latency] = {sink.node: sink.compute for sink in threads.sinks}
        compute |= {source.node: source.compute for source in threads.sources}
        compute |= {name: life.compute for name, life in lives.items()}
        failures = {name: life.failures for name, life in lives.items()}
        failures |= {sink.node: sink.failures for sink in threads.sinks}
        edges = {name: edge.report() for name, edge in threads.edges.items()}
        return LiveReport(
            records=sum(source.report.records for source in threads.sources),
            first_ns=min((source.first_ns for source in threads.sources if source.first_ns), default=0),
            last_ns=max((source.last_ns for source in threads.sources), default=0),
            events=sum(edge.taken for edge in edges.values()),
            messages={o.name: o.count for outputs in threads.outputs.values() for o in outputs.values()},
            nodes={name: NodeReport(c.count, c) for name in self._names for c in [compute.get(name, Latency())]},
            edges=edges,
            links={source.node: source.report for source in threads.sources},
            counters={name: told for name, node in (threads.links | lives).items() if (told := dict(node.counters))},
            restarts={name: life.restarts for name, life in lives.items() if life.restarts},
            failures={name: count for name, count in failures.items() if count},
            off=[name for name, life in lives.items() if life.gave_up],
            tap_drops={tap.node: sum(tap.inbox.dropped) for tap in threads.taps},
            incidents=self.incidents.all,
        )
