"""A recording cut into the parts of a live run, as the recorder leaves them."""

from __future__ import annotations

from pathlib import Path

from flow.link import Record
from flow.live.input_order import END_TOPIC
from links.recording import RecordingReader, RecordingWriter

LATE_NS = 20_000_000


def split(source: Path, folder: Path, cuts_s: tuple[float, ...], run: str = "a run", name: str = "flight") -> Path:
    """The first of the parts that end at `cuts_s` and at the end; the last one has the end of the run.

    Servo states are late at a cut: the part after it begins with some that came before it, as threads do.
    """
    with RecordingReader(source) as reader:
        cuts_ns = [reader.start_ns + round(1e9 * cut) for cut in cuts_s]
        parts: list[list[Record]] = [[] for _ in (*cuts_s, 0)]
        for record in reader.records():
            late_ns = LATE_NS if record.topic == "/servo/state" else 0
            parts[sum(record.arrival_ns + late_ns >= cut for cut in cuts_ns)].append(record)
        parts[-1].append(Record(END_TOPIC, reader.end_ns, reader.end_ns, b"{}"))
        files = [folder / (f"{name}.mcap" if n == 1 else f"{name}-{n}.mcap") for n in range(1, len(parts) + 1)]
        for number, (file, records) in enumerate(zip(files, parts, strict=True), 1):
            about = {"session": run, "part": str(number)}
            with RecordingWriter(file, rig_yaml=reader.rig_yaml, metadata=about, lossless=True) as writer:
                for record in records:
                    writer.write(record)
    return files[0]
