"""The byte stream between a process and a worker process that runs a partition of its graph.

A partition is some of a graph's nodes, with all edges among them. Each partition has one stream socket. The parent
sends requests and the worker answers them in order. Numbers are little-endian; messages are `flow.remote.codec` bytes.

    frame     u8 kind, u32 length, body
    answer    its body is u32 length of a JSON object, that object (or nothing), then for each message: u16 index of the
              output in `Graph.outputs`, u32 length, bytes; no bytes for a message that only the worker needs

Source: ours.
"""

from __future__ import annotations

import enum
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from flow.graph import Graph
from flow.link import Record


class Request(enum.IntEnum):
    """Kinds of frames from the parent; the answers are of kind OUTPUTS unless another one is named."""

    START = 0
    """The partition as JSON: see `start_body`."""
    RECORDS = 1
    """For each record: i64 arrival_ns, i64 stamp_ns, i64 sequence, u32 lengths of topic and data, topic, data.
    One answer for each record."""
    MESSAGE = 2
    """u16 index of an input port of the partition's only node, the message."""
    END = 3
    """i64 arrival_ns of the run's last record. Answer: REFUSED."""
    FINISH = 4
    """Empty: the next stage finishes."""
    REPORT = 5
    """Empty. Answer: REPORT."""


class AnswerKind(enum.IntEnum):
    """Kinds of answers."""

    OUTPUTS = 10
    """Outputs of the nodes."""
    FAILED = 11
    """Error of a node, after the outputs of the nodes before it; it can answer any request."""
    REFUSED = 12
    """The sources that could decode no record."""
    REPORT = 13
    """A `PartitionReport`."""


CHUNK_BYTES = 2**18
_FRAME, _RECORD, _OUTPUT = struct.Struct("<BI"), struct.Struct("<qqqII"), struct.Struct("<HI")
_LENGTH, PORT, TIME = struct.Struct("<I"), struct.Struct("<H"), struct.Struct("<q")

Encoded = tuple[int, bytes]  # index of an output, a message's bytes


class DisconnectedError(ConnectionError):
    """The other side has closed the stream."""


class Answer(NamedTuple):
    """One answer of a worker."""

    kind: int
    head: dict[str, Any]
    messages: list[Encoded]


class Frames:
    """Frames read from a byte stream; `receive` returns the stream's next bytes, none at its end."""

    def __init__(self, receive: Callable[[], bytes]) -> None:
        self._receive, self._data, self._at = receive, b"", 0

    @property
    def buffered(self) -> bool:
        """Whether bytes wait that belong to the next frame."""
        return self._at < len(self._data)

    def next(self) -> tuple[int, bytes]:
        """Kind and body of the next frame, waited for. DisconnectedError: the stream has ended."""
        kind, length = _FRAME.unpack(self._take(_FRAME.size))
        return kind, self._take(length)

    def _take(self, length: int) -> bytes:
        available = len(self._data) - self._at
        if available < length:
            chunks = [self._data[self._at :]]
            while available < length:
                chunk = self._receive()
                if not chunk:
                    raise DisconnectedError("the stream has ended")
                chunks.append(chunk)
                available += len(chunk)
            self._data, self._at = b"".join(chunks), 0
        self._at += length
        return self._data[self._at - length : self._at]


def frame(kind: int, *body: bytes) -> bytes:
    """A frame whose body is these bytes."""
    return b"".join((_FRAME.pack(kind, sum(len(piece) for piece in body)), *body))


def start_body(graph: Graph, wanted: Sequence[str] | None, *, digest: bool, strict: bool) -> bytes:
    """A partition as JSON; config is plain YAML values.

    `wanted`: outputs whose messages are sent back (None: all). `digest`: hash every output. `strict`: as in a replay.
    """
    nodes = [{"name": s.name, "kind": s.kind, "use": s.use, "config": s.config} for s in graph.nodes.values()]
    edges = [(edge.producer, edge.output, edge.consumer, edge.port) for edge in graph.edges]
    body = {"nodes": nodes, "edges": edges, "wanted": wanted, "digest": digest, "strict": strict}
    return json.dumps(body).encode()


def record_bytes(record: Record) -> bytes:
    """A record within the body of RECORDS."""
    topic = record.topic.encode()
    head = _RECORD.pack(record.arrival_ns, record.stamp_ns, record.sequence, len(topic), len(record.data))
    return b"".join((head, topic, record.data))


def records_of(body: bytes) -> Iterator[Record]:
    """The records in the body of RECORDS."""
    at = 0
    while at < len(body):
        arrival_ns, stamp_ns, sequence, topic_bytes, data_bytes = _RECORD.unpack_from(body, at)
        topic_at = at + _RECORD.size
        data_at = topic_at + topic_bytes
        at = data_at + data_bytes
        yield Record(body[topic_at:data_at].decode(), arrival_ns, stamp_ns, body[data_at:at], sequence)


def answer_frame(kind: int, messages: Iterable[Encoded] = (), head: dict[str, Any] | None = None) -> bytes:
    """An answer as a frame."""
    text = json.dumps(head).encode() if head else b""
    pieces = [_LENGTH.pack(len(text)), text]
    for output, data in messages:
        pieces += (_OUTPUT.pack(output, len(data)), data)
    return frame(kind, *pieces)


def answer_of(kind: int, body: bytes) -> Answer:
    """The answer that a frame holds."""
    at = _LENGTH.size + _LENGTH.unpack_from(body)[0]
    head: dict[str, Any] = json.loads(body[_LENGTH.size : at]) if at > _LENGTH.size else {}
    messages: list[Encoded] = []
    while at < len(body):
        output, length = _OUTPUT.unpack_from(body, at)
        begin = at + _OUTPUT.size
        at = begin + length
        messages.append((output, body[begin:at]))
    return Answer(kind, head, messages)
