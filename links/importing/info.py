"""What is in a file that grd reads: its kind, span, topics with counts, and what an import would make of a bag.

Source: ours.
"""

from __future__ import annotations

import datetime
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flow.link import LinkError
from links.importing.dataflash import DataflashLog
from links.importing.file_kind import IMPORTED, FileKind, file_bytes, file_kind
from links.importing.pcap import PcapReport, read_datagrams
from links.importing.tlog import TlogReport, read_frames
from links.importing.ulog_file import read_ulog
from links.lidar import recognised_model, rig_unit
from links.recording import Session
from links.recording.format import topic as declared
from links.recording.reader import RecordingReader, open_file
from links.ros.bag import Bag
from links.ros.mapping import BagMapping, guess


@dataclass(slots=True)
class FileInfo:
    """What `grd info` shows."""

    kind: FileKind
    facts: list[tuple[str, str]] = field(default_factory=list)
    columns: tuple[str, ...] = ()
    rows: list[tuple[str, ...]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    mapping: BagMapping | None = None  # of a bag, as guessed


def file_info(path: Path) -> FileInfo:
    """The content of a file or folder. LinkError when grd does not read it, or it is damaged from the start."""
    kind = file_kind(path)
    if kind is None:
        raise LinkError(f"{path} is none of the files that grd reads: a recording, a run's folder, {IMPORTED}")
    info = FileInfo(kind, [("file", f"{path}, {kind}, {file_bytes(path) / 1e6:.1f} MB")])
    _READERS[kind](path, info)
    return info


def _recording(path: Path, info: FileInfo) -> None:
    with RecordingReader(path) as reader:
        info.warnings += reader.warnings
        facts = _span(reader.start_ns, reader.end_ns)
        if reader.rig_yaml is not None:
            try:
                facts.append(("LiDAR", rig_unit(reader.rig_yaml, str(path)).model))
            except LinkError as error:
                info.warnings.append(str(error))
        facts += [
            ("rig", _there(reader.rig_yaml)),
            ("configuration", _there(reader.config_yaml)),
            *((name, text) for name, text in reader.metadata.items()),
        ]
        seconds = (reader.end_ns - reader.start_ns) * 1e-9
        info.columns = ("topic", "messages", "per second", "content")
        info.rows = [(n, str(c), _rate(c, seconds), declared(n).holds) for n, c in reader.topics.items()]
    session = Session(path)
    if session.known > 1:
        facts.append(("parts", ", ".join(part.name for part in session.parts)))
    info.warnings += [text for text in session.warnings if text not in info.warnings]
    info.facts += facts


def _bag(path: Path, info: FileInfo) -> None:
    with Bag(path) as bag:
        mapping = info.mapping = guess(bag.topics)
        becomes = {use.topic: stream for stream, uses in mapping.uses.items() for use in uses}
        info.facts += [("format", f"ROS {bag.ros}, {len(bag.parts)} file(s)"), *_span(bag.start_ns, bag.end_ns)]
        seconds = (bag.end_ns - bag.start_ns) * 1e-9
        info.columns = ("topic", "type", "messages", "per second", "becomes")
        info.rows = [
            (t.name, t.type, str(t.messages), _rate(t.messages, seconds), becomes.get(t.name, "-")) for t in bag.topics
        ]
        info.warnings += bag.warnings


def _capture(path: Path, info: FileInfo) -> None:
    report, counts = PcapReport(), Counter[tuple[str, int, int, str]]()
    times: list[int] = []
    with open_file(path) as stream:
        for datagram in read_datagrams(stream, path, report):
            model = recognised_model(datagram.payload) or "-"
            counts[datagram.sender, datagram.port, len(datagram.payload), model] += 1
            times = [*times[:1], datagram.time_ns]
    if times:
        info.facts += _span(times[0], times[-1])
    seconds = (times[-1] - times[0]) * 1e-9 if times else 0.0
    info.columns = ("sender", "UDP port", "bytes", "LiDAR", "packets", "per second")
    info.rows = [(s, str(p), str(b), m, str(n), _rate(n, seconds)) for (s, p, b, m), n in counts.most_common()]
    info.warnings += [f"{count} packets {reason}" for reason, count in report.skipped.items()]
    info.warnings += report.warnings


def _telemetry(path: Path, info: FileInfo) -> None:
    from links.mavlink.transport.framing import V1, dialect, header

    names = {number: kind.msgname for number, kind in dialect().mavlink_map.items()}
    report, counts = TlogReport(), Counter[tuple[str, str]]()
    times: list[int] = []
    with open_file(path) as stream:
        for time_ns, frame in read_frames(stream, path, report):
            (system, component), _ = header(frame)
            number = frame[5] if frame[0] == V1 else int.from_bytes(frame[7:10], "little")
            counts[f"{system}, {component}", names.get(number, f"message {number}")] += 1
            times = [*times[:1], time_ns]
    _log(info, times, counts, report.warnings)


def _log(info: FileInfo, times: list[int], counts: Counter[tuple[str, str]], warnings: list[str]) -> None:
    if times:
        info.facts += _span(times[0], times[-1])
    seconds = (times[-1] - times[0]) * 1e-9 if times else 0.0
    info.columns = ("system, component", "message", "messages", "per second")
    info.rows = [(source, name, str(n), _rate(n, seconds)) for (source, name), n in counts.most_common()]
    info.warnings += warnings


def _dataflash(path: Path, info: FileInfo) -> None:
    log = DataflashLog(path)
    counts, times = Counter[tuple[str, str]](), []
    for message in log.messages():
        counts["1, 1", message.get_type()] += 1
        times = [*times[:1], 1000 * round(1e6 * message._timestamp)]
    _log(info, times, counts, log.warnings())


def _ulog(path: Path, info: FileInfo) -> None:
    log = read_ulog(path)
    seconds = (log.last_timestamp - log.start_timestamp) * 1e-6
    hardware = log.msg_info_dict.get("ver_hw", "unknown")
    info.facts += [("hardware", str(hardware)), ("duration", f"{seconds:.2f} s")]
    info.columns = ("topic", "instance", "messages", "per second")
    each = ((d.name, d.multi_id, len(d.data["timestamp"])) for d in log.data_list)
    info.rows = [(name, str(number), str(count), _rate(count, seconds)) for name, number, count in sorted(each)]


def _run(path: Path, info: FileInfo) -> None:
    summary = path / "summary.json"
    values: dict[str, Any] = {}
    if summary.is_file():
        values = _summary(summary)
    else:
        info.warnings.append(f"{path}: no summary.json: the run was interrupted")
    for name in ("grd", "recording", "config", "recorded_s", "output_hash", "records", "sweeps", "fixes", "poses"):
        if name in values:
            info.facts.append((name, str(values[name])))
    for key, what in (("truth_errors", "LiDAR positions"), ("pose_errors", "fused poses")):
        errors = values.get(key, {})
        info.facts += [
            (f"{what} against the truth, {name}", "-" if error is None else str(error))
            for name, error in errors.items()
        ]
    info.warnings += values.get("warnings", [])
    files = sorted(file for file in path.iterdir() if file.is_file())
    info.columns = ("file", "kB")
    info.rows = [(file.name, f"{file.stat().st_size / 1e3:.1f}") for file in files]


def _summary(file: Path) -> dict[str, Any]:
    """The values of a run's summary.json. LinkError when it is damaged."""
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("it is no object")
        for name, kind in (("truth_errors", dict), ("pose_errors", dict), ("warnings", list)):
            if not isinstance(values.get(name, kind()), kind):
                raise ValueError(f"{name} is no {kind.__name__}")
    except (ValueError, RecursionError) as error:
        raise LinkError(
            f"{file} is damaged ({error}): replay the recording to write it again (`grd replay`), or remove it to see "
            "the run's other files"
        ) from None
    return values


_READERS: dict[FileKind, Callable[[Path, FileInfo], None]] = {
    FileKind.RECORDING: _recording,
    FileKind.BAG: _bag,
    FileKind.CAPTURE: _capture,
    FileKind.TELEMETRY: _telemetry,
    FileKind.DATAFLASH: _dataflash,
    FileKind.ULOG: _ulog,
    FileKind.RUN: _run,
}


def _span(start_ns: int, end_ns: int) -> list[tuple[str, str]]:
    at = datetime.datetime.fromtimestamp(start_ns // 1_000_000_000, datetime.UTC)
    return [("start", f"{at:%Y-%m-%d %H:%M:%S} UTC"), ("duration", f"{(end_ns - start_ns) * 1e-9:.2f} s")]


def _rate(count: int, seconds: float) -> str:
    return f"{(count - 1) / seconds:.1f}" if seconds > 0 and count > 1 else "-"


def _there(text: str | None) -> str:
    return "no" if text is None else "yes"
