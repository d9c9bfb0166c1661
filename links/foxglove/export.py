"""A recording or a run as one MCAP file in Foxglove's own schemas: it opens without an extension and without ROS.

The file appears when it is complete.

Source: ours; https://mcap.dev/spec/registry (json, jsonschema).
"""

from __future__ import annotations

import json
import os
import tempfile
from collections import Counter
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from flow.link import LinkError
from links.foxglove.messages import FoxgloveMessages, finite
from links.foxglove.schemas import schema_text
from links.recording import Progress
from links.ros.export import ExportReport, exported_messages

LIBRARY = "grd"
MAGIC = b"\x89MCAP0\r\n"


def export(
    source: Path,
    out: Path,
    *,
    recording: Path | None = None,
    rig_yaml: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Write a recording, or a run's folder with its own recording or `recording`, to the new file `out`.

    `rig_yaml` is used where the recording has no rig.
    LinkError when there is nothing to export, or `out` exists and is no MCAP file that may be overwritten.
    """
    if out.exists() and not (overwrite and _is_mcap(out)):
        hint = ", or allow it to be overwritten (--overwrite)" if _is_mcap(out) else ""
        raise LinkError(f"{out} exists already: choose another name{hint}")
    if recording is not None and recording.exists() and out.exists() and recording.samefile(out):
        raise LinkError(f"{out} is the recording itself: choose another name")
    if source.is_file() and out.exists() and source.samefile(out):
        raise LinkError(f"{out} is the recording itself: choose another name")
    try:
        number, name = tempfile.mkstemp(prefix=f".{out.name}-", dir=out.absolute().parent)
    except OSError as error:
        raise LinkError(f"{out} cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(number, "wb") as stream:
            report = _write(stream, source, out, recording, rig_yaml, progress)
        Path(name).chmod(0o644)
        Path(name).replace(out)
    finally:
        Path(name).unlink(missing_ok=True)
    return report


def _write(
    stream: BinaryIO,
    source: Path,
    out: Path,
    recording: Path | None,
    rig_yaml: str | None,
    progress: Progress | None,
) -> ExportReport:
    warnings: list[str] = []
    topics: Counter[str] = Counter()
    not_finite: Counter[str] = Counter()
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    writer, messages = Writer(stream, compression=CompressionType.ZSTD), FoxgloveMessages()
    writer.start(profile="", library=LIBRARY)
    for entry in exported_messages(source, recording, rig_yaml, warnings, progress):
        for m in messages.of(entry):
            if not finite(m.values):
                not_finite[m.topic] += 1
                continue
            if m.schema not in schemas:
                schemas[m.schema] = writer.register_schema(m.schema, "jsonschema", schema_text(m.schema))
            if m.topic not in channels:
                channels[m.topic] = writer.register_channel(m.topic, "json", schemas[m.schema])
            data = json.dumps(m.values, separators=(",", ":"), allow_nan=False).encode()
            writer.add_message(channels[m.topic], m.log_time_ns, data, m.publish_time_ns, topics[m.topic])
            topics[m.topic] += 1
    if not topics:
        raise LinkError(f"{source}: no record that Foxglove shows: `grd info {source}` shows its topics")
    writer.finish()
    warnings += [f"{count} messages on {topic} are left out: not finite" for topic, count in not_finite.items()]
    return ExportReport(out, dict(topics), warnings)


def _is_mcap(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC
