"""The live runner at the pace of the sensors: CPU, and the delay of each edge, compared with a replay of the same records.

    pytest tests/benchmarks/system/bench_live.py -s

Thirteen seconds of LiDAR (754 packets a second), servo and autopilot go through the field's stages: sources and stages
in one thread (as configs/field.yaml has them), only the stages in one, and a thread for each.
"""

from __future__ import annotations

import dataclasses
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flow.link import TRUTH_TOPICS, WAKE_S, PolledRecords, Record, Source
from flow.live import Live
from flow.replay import Replay
from flow.taps import Digest
from links.clock import host_time
from links.recording import RecordingReader
from links.runs.request import RunRequest

ROOT = Path(__file__).resolve().parents[3]
RECORDING = ROOT / "recordings" / "experiment_2.mcap"
STAGES = ("sweep", "detect", "track", "motion", "telemetry", "drone_motion", "aim", "fuse")
OWN_SOURCES = tuple(f"links.{name}.thread=null" for name in ("lidar", "servo", "odometry", "clock"))
OWN_THREADS = OWN_SOURCES + tuple(f"stages.{name}.thread=null" for name in STAGES)


@pytest.fixture(scope="module")
def flight():
    with RecordingReader(RECORDING) as reader:
        records = [record for record in reader.records() if not record.topic.startswith(TRUTH_TOPICS)]
        return reader.rig_yaml, records


def graph_of(rig_yaml, *sets):
    config = ROOT / "configs" / "sim_live.yaml"
    return RunRequest(config, (), ("lidar.clock=free", *sets)).graph(rig_yaml, str(RECORDING))


class Due(PolledRecords):
    """Recorded records, each when it is due."""

    def __init__(self, records: list[Record], shift_ns: int) -> None:
        super().__init__()
        self._records, self._shift_ns = deque(records), shift_ns

    @property
    def wait_s(self) -> float:
        due_s = (self._records[0].arrival_ns + self._shift_ns - host_time.now_ns()) * 1e-9 if self._records else WAKE_S
        return min(max(0.0, due_s), WAKE_S)

    def pending(self) -> Iterator[Record]:
        now_ns = host_time.now_ns()
        while self._records and self._records[0].arrival_ns + self._shift_ns <= now_ns:
            record = self._records.popleft()
            yield dataclasses.replace(record, arrival_ns=now_ns, stamp_ns=record.stamp_ns + self._shift_ns)


def pace(source: Source, records: list[Record], begin_ns: int) -> None:
    """Make a source give recorded records, each when it is due."""
    mine = [record for record in records if record.topic == source.topic]
    shift_ns = begin_ns - records[0].arrival_ns

    @contextmanager
    def listen(self) -> Iterator[Due]:
        due = Due(mine, shift_ns)
        try:
            yield due
        finally:
            due.closed.set()

    object.__setattr__(source, "__class__", type(type(source).__name__, (type(source),), {"listen": listen}))


def fly(rig_yaml, records, sets):
    """One live run; its report, and the CPU that it took."""
    live = Live(graph_of(rig_yaml, *sets), digest=Digest(), now_ns=host_time.now_ns)
    for name, link in live.nodes.items():
        if isinstance(link, Source) and name != "clock":
            pace(link, records, host_time.now_ns() + 200_000_000)
    began_s = time.process_time()
    live.start()
    threading.Event().wait(0.4 + (records[-1].arrival_ns - records[0].arrival_ns) * 1e-9)
    cpu_s = time.process_time() - began_s
    report = live.stop()
    assert report.links["lidar"].records > 0
    return report, cpu_s


@pytest.mark.parametrize(
    "sets", [(), OWN_SOURCES, OWN_THREADS], ids=["sources_and_stages_in_one", "stages_in_one", "a_thread_for_each"]
)
def test_live_at_the_sensors_pace(benchmark, flight, sets):
    rig_yaml, records = flight
    replay_all(rig_yaml, records)  # compiles
    report, cpu_s = benchmark.pedantic(fly, args=(rig_yaml, records, sets), rounds=1)
    seconds = (records[-1].arrival_ns - records[0].arrival_ns) * 1e-9
    benchmark.extra_info["cores"] = round(cpu_s / seconds, 3)
    lines = [f"\n{cpu_s / seconds:.2f} cores; {report.dropped} dropped, {report.missed} late"]
    for name, edge in report.edges.items():
        lines.append(f"{name:24s} {edge.taken:6d}  p50 {edge.lag_p50_ms:7.2f}  p99 {edge.lag_p99_ms:7.2f} ms")
    sys.stdout.write("\n".join(lines) + "\n")


def replay_all(rig_yaml, records):
    runner = Replay(graph_of(rig_yaml), [Digest()])
    for record in records:
        runner.feed(record)
    return runner.finish()


def test_replay_of_the_same(benchmark, flight):
    rig_yaml, records = flight
    began_s = time.process_time()
    benchmark.pedantic(replay_all, args=(rig_yaml, records), rounds=1, warmup_rounds=1)
    seconds = (records[-1].arrival_ns - records[0].arrival_ns) * 1e-9
    sys.stdout.write(f"\nreplay: {(time.process_time() - began_s) / 2 / seconds:.2f} CPU-s for a recorded second\n")
