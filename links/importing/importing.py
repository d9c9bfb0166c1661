"""Imports a file of another program as a recording; its contents decide the file type.

Source: ours.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from flow.link import LinkError
from links.importing.capture import Capture
from links.importing.dataflash import DataflashLog
from links.importing.file_kind import IMPORTED, FileKind, file_bytes, file_kind
from links.importing.imported_file import ImportedFile
from links.importing.telemetry_log import TelemetryLog
from links.importing.ulog_file import UlogFile
from links.lidar import rig_unit
from links.recording.format import Progress
from links.recording.reader import open_file
from links.recording.writer import RecordingWriter, beside
from links.ros.mapping import BagMapping

_PROGRESS_EVERY = 1000  # records


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What an import wrote and skipped."""

    path: Path
    topics: dict[str, int]  # records by topic
    skipped: dict[str, int]  # packets or bytes by reason
    warnings: list[str]


def import_file(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    rig_yaml: str | None = None,
    port: int | None = None,
    sender: str | None = None,
    mapping: BagMapping | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ImportReport:
    """Convert a capture, a log or a ROS bag to a recording next to it (or at `out`).

    `port` (None: the model's own) and `sender` (IPv4 address) choose the lidar in a capture, `mapping` (None: guessed)
    the topics of a bag; `rig_yaml` is the text of the calibration, by default DEFAULT_RIG where there is a lidar.
    Without a rig the packets name the model; an Ouster's do not. LinkError when the file has no usable record; a
    partial output is removed.
    """
    source = Path(path)
    target = Path(out) if out is not None else beside(source, ".mcap")
    if target.exists() and source.exists() and target.samefile(source):
        if file_kind(source) is FileKind.RECORDING:
            raise LinkError(_already_one(source))
        raise LinkError(f"{target} is the file to import: give the recording another name with -o")
    with ExitStack() as stack:
        imported = _open(stack, source, port, sender, rig_yaml, mapping)
        records = imported.records()
        first = next(records, None)
        if first is None:
            raise LinkError(imported.nothing_found())
        topics: Counter[str] = Counter()
        total_bytes = file_bytes(source)
        writer = RecordingWriter(
            target,
            rig_yaml=rig_yaml or imported.default_rig(),
            metadata={"imported_from": source.name},
            channels=imported.channels(),
            lossless=True,
            overwrite=overwrite,
        )
        try:
            with writer:
                for number, record in enumerate(itertools.chain([first], records)):
                    writer.write(record)
                    topics[record.topic] += 1
                    if progress and number % _PROGRESS_EVERY == 0:
                        progress(imported.done_bytes(), total_bytes)
        except BaseException:
            with suppress(OSError):
                target.unlink()
            raise
    if progress:
        progress(total_bytes, total_bytes)
    return ImportReport(target, dict(topics), imported.skipped(), imported.warnings())


def _open(
    stack: ExitStack,
    source: Path,
    port: int | None,
    sender: str | None,
    rig_yaml: str | None,
    mapping: BagMapping | None,
) -> ImportedFile:
    """The file as what it is; `stack` closes it."""
    kind = file_kind(source)
    unit = None if rig_yaml is None else rig_unit(rig_yaml, "--rig")
    if mapping is not None and kind is not FileKind.BAG:
        raise LinkError(f"--map names the topics of a ROS bag, and {source} is none")
    if kind is FileKind.CAPTURE:
        return Capture(stack.enter_context(open_file(source)), source, port, sender, unit)
    if kind is FileKind.TELEMETRY:
        return TelemetryLog(stack.enter_context(open_file(source)), source)
    if kind is FileKind.RECORDING:
        raise LinkError(_already_one(source))
    if kind is FileKind.BAG:
        from links.importing.rosbag_file import RosbagFile

        return stack.enter_context(RosbagFile(source, mapping, unit))
    if kind is FileKind.DATAFLASH:
        return DataflashLog(source)
    if kind is FileKind.ULOG:
        return UlogFile(source)
    raise LinkError(f"{source} is none of the files that can be imported: {IMPORTED}")


def _already_one(source: Path) -> str:
    return f"{source} is a recording already: use it as it is (`grd replay {source}`)"
