"""A ROS bag as topics and messages: ROS 1 (.bag) and ROS 2 (.db3, .mcap, or their folder with metadata.yaml).

Bags compressed message by message or chunk by chunk are read as they are; a folder's files that are compressed as a
whole are unpacked to the temporary folder by rosbags. Parts of a split bag are read as one when the folder, or the
first of `NAME_0.bag`, `NAME_1.bag`, ..., is named; a later part is read alone, with a warning.

Source: ours; rosbags (https://ternaris.gitlab.io/rosbags).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from flow.link import LinkError
from links.ros.message_types import typestore

BAG_METADATA = "metadata.yaml"
_DAMAGE = (
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError),
    *(struct.error, OSError, EOFError, AssertionError),
)


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic of a bag."""

    name: str
    type: str  # package/msg/Name, also of a ROS 1 bag
    messages: int


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message, decoded."""

    topic: str
    type: str
    time_ns: int  # when it was recorded
    value: Any


class Bag:
    """`with Bag(path) as bag: for message in bag.messages(["/velodyne_packets"])`. Raises LinkError with the reason."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            import rosbags.highlevel
        except ModuleNotFoundError:
            raise LinkError(
                f"{path} is a ROS bag: to read it install the extra ros (pip install 'grd-pose[ros]')"
            ) from None
        self._store = typestore()
        self.parts, self.warnings = _parts(path)
        self._errors = _error_types()
        try:
            self._reader = rosbags.highlevel.AnyReader(self.parts, default_typestore=self._store)
            self._reader.open()
        except self._errors as error:
            raise self._damaged(error) from None
        merged: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            key = connection.topic, connection.msgtype
            merged[key] = merged.get(key, 0) + connection.msgcount
        self.topics = [BagTopic(name, kind, count) for (name, kind), count in sorted(merged.items())]
        self.ros = 2 if self._reader.is2 else 1
        empty = not any(topic.messages for topic in self.topics)
        self.start_ns, self.end_ns = (0, 0) if empty else (self._reader.start_time, self._reader.end_time)

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Messages of `topics` in the order of recording. LinkError where the bag is damaged or a type is unknown."""
        wanted = [connection for connection in self._reader.connections if connection.topic in topics]
        if not wanted:
            return
        messages = self._reader.messages(wanted)
        while True:
            try:
                connection, time_ns, raw = next(messages)
            except StopIteration:
                return
            except self._errors as error:
                raise self._damaged(error) from None
            yield BagMessage(connection.topic, connection.msgtype, time_ns, self._decode(connection, raw))

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reader.close()

    def _decode(self, connection: Any, raw: bytes) -> Any:
        kind = connection.msgtype
        own = self._reader.typestore
        store = own if kind in own.fielddefs else self._store
        if kind not in store.fielddefs:
            raise LinkError(
                f"{self.path}: {connection.topic} has messages of type {kind}, which the bag does not define and grd "
                "does not know: record it as .mcap, which stores the definitions"
            )
        try:
            return store.deserialize_cdr(raw, kind) if self.ros == 2 else store.deserialize_ros1(raw, kind)
        except self._errors as error:
            raise LinkError(f"{self.path}: {connection.topic}: a message is damaged ({_one_line(error)})") from None

    def _damaged(self, error: Exception) -> LinkError:
        text = _one_line(error)
        hint = ""
        if re.search(r"index|magic|metadata|footer|truncat", text, re.I):
            hint = ". Was it closed? `rosbag reindex` (ROS 1), `ros2 bag reindex` (.db3) or `mcap recover` repair it"
        return LinkError(f"{self.path}: the bag cannot be read: {text.rstrip('.')}{hint}")


def _parts(path: Path) -> tuple[list[Path], list[str]]:
    """The files of the bag that is named, and warnings about those that are left out."""
    if path.is_dir():
        return [path], []
    numbered = re.fullmatch(r"(.*)_(\d+)\.(bag|db3|mcap)", path.name)
    others = []
    if numbered:
        stem, suffix = numbered[1], numbered[3]
        alike = {int(m[1]): f for f in path.parent.iterdir() if (m := _number(stem, suffix, f.name))}
        others = [alike[k] for k in sorted(alike) if alike[k] != path]
        if others and suffix == "bag" and int(numbered[2]) == 0:
            missing = sorted(set(range(max(alike))) - set(alike))
            warnings = [f"{path}: part {k} of this bag is missing" for k in missing]
            return [alike[k] for k in sorted(alike)], warnings
    if not others:
        return [path], []
    whole = path.parent if (path.parent / BAG_METADATA).is_file() else others[0]
    return [path], [f"{path} is one of {len(others) + 1} parts and read alone: name {whole} for all of them"]


def _number(stem: str, suffix: str, name: str) -> re.Match[str] | None:
    return re.fullmatch(rf"{re.escape(stem)}_(\d+)\.{suffix}", name)


def _error_types() -> tuple[type[Exception], ...]:
    """What rosbags and the libraries below it raise for damaged files."""
    import apsw
    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    return (AnyReaderError, Reader1Error, Reader2Error, SerdeError, TypesysError, apsw.Error, RuntimeError, *_DAMAGE)


def _one_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
