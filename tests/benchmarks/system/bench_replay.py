"""CPU time of replays without cameras: slices of 10 ms side by side with one message per LiDAR packet.

    python -m pytest tests/benchmarks/system/bench_replay.py -s

The figures are recorded seconds per second of process time, in one thread, alternating, median of ROUNDS; the ratio is
that of the medians. Reading the file is not included.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path

import pytest

from flow.link import TRUTH_TOPICS
from flow.replay import replay
from flow.taps import Digest
from links.recording import RecordingReader
from links.runs.request import RunRequest

ROOT = Path(__file__).resolve().parents[3]
ROUNDS = 5
KINDS = {"slices": (), "packets": ("lidar.slice_ms=0.1",)}


@pytest.mark.parametrize("hashed", [True, False], ids=["with output hash", "without"])
@pytest.mark.parametrize("name", ["experiment_2", "street_sweep"])
def test_replay_by_slices_and_by_packets(benchmark, name, hashed):
    recording = ROOT / "recordings" / f"{name}.mcap"
    with RecordingReader(recording) as reader:
        rig_yaml = reader.rig_yaml
        records = [record for record in reader.records() if not record.topic.startswith(TRUTH_TOPICS)]
    config = ROOT / "configs" / "estimate.yaml"
    graphs = {kind: RunRequest(config, (), sets).graph(rig_yaml, str(recording)) for kind, sets in KINDS.items()}
    seconds = (records[-1].arrival_ns - records[0].arrival_ns) * 1e-9

    def speed(kind: str) -> float:
        began_s = time.process_time()
        replay(graphs[kind], records, [Digest()] if hashed else [])
        return seconds / (time.process_time() - began_s)

    for kind in KINDS:
        speed(kind)  # compiles
    speeds = [{kind: speed(kind) for kind in KINDS} for _ in range(ROUNDS)]
    median = {kind: statistics.median(run[kind] for run in speeds) for kind in KINDS}
    benchmark.extra_info |= {f"{kind}: times real time": round(value, 2) for kind, value in median.items()}
    sys.stdout.write(
        f"\n{name}: slices {median['slices']:.2f}, packets {median['packets']:.2f} times real time, "
        f"ratio {median['slices'] / median['packets']:.2f}\n"
    )
    benchmark.pedantic(speed, ("slices",), rounds=1)
