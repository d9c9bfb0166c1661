"""CPU time and memory of a replay, per second of the recording: by number of drones, by camera, or of given recordings.

    python -m tests.benchmarks.system.cost drones                 # 1, 2, 4, 8 chains of stages on one recording
    python -m tests.benchmarks.system.cost cameras                # without, with vp and align, with both odometries
    python -m tests.benchmarks.system.cost recordings FILE...     # of other LiDAR models, in other weather

Process time in one thread, without output hash, reading and viewer; alternating, median of `--rounds`. Each value is of
a new process that has replayed the first WARM_S before. All chains of `drones` follow the drone of the recording.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

from flow.link import TRUTH_TOPICS
from flow.replay import replay
from links.recording import RecordingReader
from links.runs.request import RunRequest

ROOT = Path(__file__).parents[3]
CHAINS = (1, 2, 4, 8)
CHAIN = ["telemetry", "drone_motion", "detect", "track", "fuse"]
LINE_OF_SIGHT = {"stages": {"drone_odometry": None, "ego": None, "fuse": {"inputs": {"visual_motion": None}}}}
WARM_S = 3.0


class Case(NamedTuple):
    """A replay to measure."""

    name: str
    recording: Path
    config: Path


class Cost(NamedTuple):
    """What it took."""

    cpu: float  # seconds per recorded second
    peak_mb: float  # resident memory of the process, with the recording's records
    shares: dict[str, float]  # of the nodes' computing time [%]


def drones(folder: Path) -> Iterator[Case]:
    """Chains that share LiDAR, servo, sweep, vehicle motion and aim."""
    for count in CHAINS:
        copies = [
            {"file": str(ROOT / "configs/estimate.yaml"), "nodes": CHAIN, "suffix": f"_{k}"}
            for k in range(2, count + 1)
        ]
        inputs = {f"state_{k}": f"track_{k}.track_state" for k in range(2, count + 1)}
        inputs |= {f"candidates_{k}": f"detect_{k}.candidates" for k in range(2, count + 1)}
        values = {"include": [str(ROOT / "configs/estimate.yaml"), *copies], "stages": {"aim": {"inputs": inputs}}}
        yield Case(f"{count} drones", ROOT / "recordings/experiment_2.mcap", _written(folder, f"{count}.yaml", values))


def cameras(folder: Path) -> Iterator[Case]:
    """The stages of two fisheyes, added one after the other."""
    recording, vision = ROOT / "recordings/experiment_1.mcap", ROOT / "configs/vision.yaml"
    yield Case("no camera", recording, ROOT / "configs/estimate.yaml")
    without = {**LINE_OF_SIGHT["stages"], "motion": {"inputs": {"ego": None}}}
    yield Case("vp, align", recording, _written(folder, "vp.yaml", {"include": str(vision), "stages": without}))
    yield Case("vp, align, odometry", recording, vision)


def recordings(files: list[Path]) -> Iterator[Case]:
    """Recordings without cameras."""
    for file in files:
        yield Case("/".join(file.with_suffix("").parts[-2:]), file, ROOT / "configs/estimate.yaml")


def _written(folder: Path, name: str, values: object) -> Path:
    (folder / name).write_text(yaml.safe_dump(values))
    return folder / name


def measure(case: Case) -> Cost:
    """Replay once in this process, after the start that loads the compiled code."""
    with RecordingReader(case.recording) as reader:
        rig_yaml = reader.rig_yaml
        records = [record for record in reader.records() if not record.topic.startswith(TRUTH_TOPICS)]
    graph = RunRequest(case.config).graph(rig_yaml, str(case.recording))
    seconds = (records[-1].arrival_ns - records[0].arrival_ns) * 1e-9
    replay(graph, [r for r in records if r.arrival_ns - records[0].arrival_ns < WARM_S * 1e9], [])
    began_s = time.process_time()
    report = replay(graph, records, [])
    cpu_s = time.process_time() - began_s
    total_ns = sum(node.compute.total_ns for node in report.nodes.values())
    shares = {name: 100 * node.compute.total_ns / total_ns for name, node in report.nodes.items()}
    return Cost(cpu_s / seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, shares)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["drones", "cameras", "recordings"])
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_intermixed_args()
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        makers = {"drones": lambda: drones(folder), "cameras": lambda: cameras(folder)}
        cases = list(makers.get(args.what, lambda: recordings(args.files))())
        costs: dict[str, list[Cost]] = {case.name: [] for case in cases}
        for _, case in itertools.product(range(args.rounds), cases):
            with spawn.Pool(1) as pool:  # a process of its own
                costs[case.name].append(pool.apply(measure, (case,)))
            sys.stderr.write(f"{case.name}: {costs[case.name][-1].cpu:.3f}\n")
    for case_name, measured in costs.items():
        median = sorted(measured)[len(measured) // 2]
        spread = f"{min(measured)[0]:.3f} to {max(measured)[0]:.3f}"
        shares = ", ".join(
            f"{n} {part:.0f}" for n, part in sorted(median.shares.items(), key=lambda item: -item[1])[:8]
        )
        peak_mb = statistics.median(cost.peak_mb for cost in measured)
        sys.stdout.write(f"{case_name}: {median.cpu:.3f} core ({spread}), {peak_mb:.0f} MB; [%] {shares}\n")


if __name__ == "__main__":
    main()
