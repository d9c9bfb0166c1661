"""Formats of files that somebody else may have made, for the fuzz test: rigs, configurations, lenses, captures, logs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import yaml

from flow.config_error import ConfigError
from flow.link import LinkError
from links.cli.files import read_rig
from links.evaluation.text_files import read_tum
from links.importing import import_file
from links.importing.lens import read_lens
from links.runs import as_live
from links.runs.request import RunRequest
from tests.links.importing.captures import ethernet, pcap, udp
from tests.links.importing.test_import_tlog import frames, tlog
from tests.links.runs.test_foreign_recordings import RIGS, configuration
from tests.stages.geometry.test_lens_files import KALIBR, OCAMCALIB

ROOT = Path(__file__).resolve().parents[2]
File = tuple[str, int, Callable[[bytes], object], tuple[type[Exception], ...], list[bytes], bool]


def _written(folder: Path, name: str, take: Callable[[Path], object]) -> Callable[[bytes], object]:
    def written(data: bytes) -> object:
        (folder / name).write_bytes(data)
        return take(folder / name)

    return written


def files(folder: Path) -> list[File]:
    """(name, number of inputs, function, errors that it may raise, valid inputs, is text) of each format."""
    rig = (ROOT / "configs" / "rigs" / "standard.yaml").read_bytes()
    attached = rig.partition(b"rig:\n")[2].replace(b"\n  ", b"\n").removeprefix(b"  ")
    hostile = [text.encode() for text, _ in RIGS.values() if len(text) < 2000]
    estimate = ROOT / "configs" / "estimate.yaml"

    def take_rig(data: bytes) -> object:
        return RunRequest(estimate).graph(data.decode(errors="replace"), "flight.mcap (rig.yaml)")

    def take_config(data: bytes) -> object:
        session = SimpleNamespace(config_yaml=data.decode(errors="replace"), path=Path("flight.mcap"))
        return as_live._graph_of(cast(Any, session), False)  # pyright: ignore[reportPrivateUsage]

    def take_import(path: Path) -> object:
        return import_file(path, folder / "imported.mcap", overwrite=True)

    config = yaml.safe_dump(configuration(viewer={"use": "links.viewer.Viewer"})).encode()
    poses = b"# full pose\n1.5 1 2 3 0 0 0 1\n1.6 1 2 3.5 0 0 0.6 0.8\n"
    packet = bytes(1206)
    capture = pcap([ethernet(udp(b"\xff\xee" + packet[2:])), ethernet(udp(packet[:512], 8308))])
    link, both = (LinkError,), (ConfigError, LinkError)
    lens = lambda path: read_lens(path, "cam0", None)  # noqa: E731
    return [
        ("rig.yaml attached", 2_000, take_rig, both, [attached, *hostile], True),
        ("rig.yaml of --rig", 4_000, _written(folder, "rig.yaml", read_rig), link, [rig, *hostile], True),
        ("config.yaml attached", 2_000, take_config, both, [config, *hostile], True),
        ("camchain.yaml", 8_000, _written(folder, "camchain.yaml", lens), link, [KALIBR.encode(), *hostile], True),
        ("OCamCalib", 20_000, _written(folder, "calib.txt", lens), link, [OCAMCALIB.encode()], True),
        ("TUM", 20_000, _written(folder, "poses.tum", read_tum), link, [poses], True),
        ("pcap", 5_000, _written(folder, "capture.pcap", take_import), link, [capture], False),
        ("tlog", 3_000, _written(folder, "log.tlog", take_import), link, [tlog(frames(count=9))], False),
    ]
