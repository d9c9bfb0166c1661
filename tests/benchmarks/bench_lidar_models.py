"""grd's decoder compared with others on real packets of each maker, in turns in one run: CPU time per packet.

    GRD_OUSTER_SDK_PYTHON=PYTHON python -m pytest -s tests/benchmarks/bench_lidar_models.py

Velodyne: velodyne-decoder's stream of structs. Ouster: ouster-sdk, in an environment of its own. Hesai: none in Python.
Dual return of the VLP-16 is made from its single returns. Printed: minimum and median.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from os import environ
from pathlib import Path

import pytest
import velodyne_decoder

from flow.link import Record
from links.importing.pcap import PcapReport, read_datagrams
from links.importing.rosbag_file import RosbagFile
from links.lidar import Lidar, ouster_beams
from stages.geometry.rig_lidar import RigLidar
from tests.benchmarks.bench_lidar import CAPTURE, dual, their_stream

OTHER = CAPTURE.parents[1] / "lidar_other"
OUSTER_SDK = environ.get("GRD_OUSTER_SDK_PYTHON")  # python of an environment with ouster-sdk
ROUNDS = 60
HDL_32E = CAPTURE.with_name("hdl32_mrpt_WRONG_MODEL.pcap")


def velodyne_records(capture: Path) -> list[Record]:
    if not capture.exists():
        pytest.skip(f"{capture.name} is not here (../shared/data/lidar)")
    packets = velodyne_decoder.util.iter_pcap(str(capture))
    return [Record("/lidar/packets", round(1e9 * t), round(1e9 * t), bytes(data)) for t, data in packets]


def ouster_case(name: str) -> tuple[list[Record], RigLidar]:
    capture, metadata = OTHER / f"{name}.pcap", OTHER / f"{name}.json"
    if not capture.exists():
        pytest.skip(f"{capture.name} is not here (../shared/data/lidar_other)")
    model, beams = ouster_beams(metadata.read_text(), str(metadata))
    with capture.open("rb") as stream:
        datagrams = [d for d in read_datagrams(stream, capture, PcapReport()) if d.port == 7502]
    return [Record("/lidar/packets", d.time_ns, d.time_ns, d.payload) for d in datagrams], RigLidar(
        model=model, beams=beams
    )


def in_turns(packets: int, *runs: Callable[[], object]) -> list[tuple[float, float]]:
    """Minimum and median [us] of CPU per packet of each run."""
    times_us: list[list[float]] = [[] for _ in runs]
    for _ in range(ROUNDS):
        for run, times in zip(runs, times_us, strict=True):
            start_ns = time.thread_time_ns()
            run()
            times.append((time.thread_time_ns() - start_ns) / 1e3 / packets)
    return [(min(times), statistics.median(times)) for times in times_us]


def decode_all(records: list[Record], unit: RigLidar) -> None:
    lidar = Lidar(unit=unit)
    for record in records:
        lidar.decode(record)
    assert lidar.counters["decoded"] == len(records)
    assert lidar.counters["lost"] == 0


def show(name: str, packets: int, ours: tuple[float, float], theirs: tuple[float, float] | None) -> None:
    text = f"\n{name}, {packets} packets [us]: grd {ours[0]:.1f}, {ours[1]:.1f}"
    if theirs is not None:
        text += (
            f"; the other {theirs[0]:.1f}, {theirs[1]:.1f}; ratio {ours[0] / theirs[0]:.2f}, {ours[1] / theirs[1]:.2f}"
        )
    sys.stdout.write(text + "\n")


@pytest.mark.parametrize(
    ("name", "capture", "model"),
    [("VLP-16", CAPTURE, "VLP-16"), ("VLP-16, dual", CAPTURE, "VLP-16"), ("HDL-32E", HDL_32E, "HDL-32E")],
)
def test_velodyne(name, capture, model):
    records = velodyne_records(capture)
    records = dual(records) if "dual" in name else records
    unit = RigLidar(model=model)
    decode_all(records, unit)
    show(
        name,
        len(records),
        *in_turns(len(records), lambda: decode_all(records, unit), lambda: their_stream(records, True)),
    )


@pytest.mark.parametrize("name", ["xt16", "xt32"])
def test_hesai(name):
    bag, unit = OTHER / f"hesai_{name}.db3", RigLidar(model=name.upper())
    if not bag.exists():
        pytest.skip(f"{bag.name} is not here (../shared/data/lidar_other)")
    with RosbagFile(bag, None, unit) as file:
        records = list(file.records())
    decode_all(records, unit)
    show(unit.model, len(records), in_turns(len(records), lambda: decode_all(records, unit))[0], None)


@pytest.mark.skipif(OUSTER_SDK is None, reason="set GRD_OUSTER_SDK_PYTHON to a python with ouster-sdk")
@pytest.mark.parametrize("name", ["OS-1-32-G_v2.1.1_1024x10", "OS-0-32-U1_v2.2.0_1024x10"])
def test_ouster(name):
    assert OUSTER_SDK is not None
    records, unit = ouster_case(name)
    decode_all(records, unit)
    script = Path(__file__).with_name("ouster_sdk_time.py")
    command = [OUSTER_SDK, script, OTHER / f"{name}.pcap", OTHER / f"{name}.json"]
    theirs = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    ours = in_turns(len(records), lambda: decode_all(records, unit))[0]
    show(unit.model, len(records), ours, (float(theirs[0]), float(theirs[1])))
