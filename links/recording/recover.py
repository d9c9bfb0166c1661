"""A clean, complete copy of what can be read of a damaged or unfinished recording.

Source: ours.
"""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass
from pathlib import Path

from flow.link import LinkError
from links.recording.format import CONFIG_ATTACHMENT, RIG_ATTACHMENT, Progress
from links.recording.mcap_file import McapFile
from links.recording.reader import RecordingReader, recover_hint
from links.recording.writer import beside, create


@dataclass(frozen=True, slots=True)
class RecoverReport:
    """What `recover` saved, and what it could not."""

    path: Path
    topics: dict[str, int]  # messages by topic
    warnings: list[str]

    @property
    def records(self) -> int:
        """Messages in the copy."""
        return sum(self.topics.values())


def recover(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RecoverReport:
    """Copy what can be read of `path` to `out` (flight.recovered.mcap), in order and with sequence numbers kept.

    LinkError when no record can be read; then there is no copy.
    """
    source = Path(path)
    target = Path(out) if out is not None else beside(source, ".recovered.mcap")
    with RecordingReader(source) as reader:
        if target.exists() and target.samefile(source):
            raise LinkError(f"{target} is the damaged recording itself: give the copy another name")
        records = reader.records(progress=progress)
        first = next(records, None)
        if first is None:
            reasons = [f"{source}: no record can be read, so that there is nothing to copy", *reader.warnings]
            raise LinkError("; ".join(reasons))
        attachments = {RIG_ATTACHMENT: reader.rig_yaml, CONFIG_ATTACHMENT: reader.config_yaml}
        topics: dict[str, int] = {}
        try:
            with create(target, overwrite=overwrite) as stream:
                copy = McapFile(
                    stream,
                    attachments={name: text for name, text in attachments.items() if text is not None},
                    metadata=reader.metadata,
                    channels=reader.channels,
                )
                for record in itertools.chain([first], records):
                    copy.add(record)
                    topics[record.topic] = topics.get(record.topic, 0) + 1
                copy.finish()
        except OSError as error:
            raise LinkError(f"{target}: {error.strerror or error}: check the disk and its free space") from None
        return RecoverReport(target, topics, [text.replace(recover_hint(source), "") for text in reader.warnings])
