"""A recording or a run as a ROS 2 bag: a folder with one MCAP file and metadata.yaml, as `ros2 bag` writes it.

The folder appears when it is complete. Foxglove opens the MCAP file, `ros2 bag play` the folder; `grd import` gives the
recording's packets, images and frames back byte for byte.

Source: ours; rosbags (https://ternaris.gitlab.io/rosbags), rosbag2 format version 9.
"""

from __future__ import annotations

import heapq
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flow.link import LinkError
from links.recording import Progress, Session
from links.ros.bag import BAG_METADATA
from links.ros.message_types import build, typestore
from links.ros.recording_messages import Entry, RecordingMessages
from links.ros.run_messages import run_messages

STATIC = "/tf_static"  # sent once, kept for those who subscribe later


@dataclass(frozen=True, slots=True)
class ExportReport:
    """What an export wrote."""

    path: Path
    topics: dict[str, int]
    warnings: list[str]


def export(
    source: Path,
    out: Path,
    *,
    recording: Path | None = None,
    rig_yaml: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Write a recording, or a run's folder with its own recording or `recording`, to the new folder `out`.

    `rig_yaml` is used where the recording has no rig.
    LinkError when there is nothing to export, or `out` exists and is no bag that may be overwritten.
    """
    if out.exists() and not (overwrite and (out / BAG_METADATA).is_file()):
        hint = "" if not (out / BAG_METADATA).is_file() else ", or allow it to be overwritten (--overwrite)"
        raise LinkError(f"{out} exists already: choose another name{hint}")
    warnings: list[str] = []
    messages = exported_messages(source, recording, rig_yaml, warnings, progress)
    first = next(messages, None)
    if first is None:
        raise LinkError(f"{source}: no record that `grd export` converts: `grd info {source}` shows its topics")
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.absolute().parent))
    except OSError as error:
        raise LinkError(f"{out} cannot be written: {error.strerror}") from None
    try:
        topics = _write(folder / out.name, first, messages)
        if out.exists():
            shutil.rmtree(out)
        (folder / out.name).rename(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return ExportReport(out, topics, warnings)


def exported_messages(
    source: Path, recording: Path | None, rig_yaml: str | None, warnings: list[str], progress: Progress | None
) -> Iterator[Entry]:
    """The messages of a run and those of its recording, or of a recording, by time."""
    of_run: list[Entry] = []
    if source.is_dir():
        if recording is None:  # of a live run; later parts have longer names
            recording = min(source.glob("*.mcap"), key=lambda file: len(file.name), default=None)
        of_run = sorted(run_messages(source, whole=recording is None), key=_time_ns)
    else:
        recording = source
    if recording is None:
        warnings.append(f"{source}: without the sensors' data: name the recording with --recording to add them")
        yield from of_run
        return
    yield from heapq.merge(of_run, _recorded_messages(recording, rig_yaml, warnings, progress), key=_time_ns)


def _time_ns(entry: Entry) -> int:
    return entry[2]


def _recorded_messages(
    recording: Path, rig_yaml: str | None, warnings: list[str], progress: Progress | None
) -> Iterator[Entry]:
    session = Session(recording)
    messages = RecordingMessages(session.rig_yaml or rig_yaml, str(recording))
    for record in session.records(progress=progress):
        yield from messages.of(record)
    yield from messages.end()
    warnings += session.warnings + messages.warnings()


def _write(folder: Path, first: Entry, messages: Iterator[Entry]) -> dict[str, int]:
    """Write a bag; returns the messages by topic."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ModuleNotFoundError:
        raise LinkError("to export a bag install the extra ros (pip install 'grd-pose[ros]')") from None
    store = typestore()
    topics: Counter[str] = Counter()
    connections: dict[str, Any] = {}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        entry: Entry | None = first
        while entry is not None:
            topic, kind, time_ns, values = entry
            if topic not in connections:
                qos = _kept() if topic == STATIC else ()
                connections[topic] = writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=qos)
            writer.write(connections[topic], time_ns, store.serialize_cdr(build(store, kind, values), kind))
            topics[topic] += 1
            entry = next(messages, None)
    return dict(topics)


def _kept() -> list[Any]:
    """The quality of service of static transforms."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    infinite = QosTime(9_223_372_036, 854_775_807)
    return [
        Qos(
            QosHistory.KEEP_LAST,
            1,
            QosReliability.RELIABLE,
            QosDurability.TRANSIENT_LOCAL,
            infinite,
            infinite,
            QosLiveliness.AUTOMATIC,
            infinite,
            False,
        )
    ]
