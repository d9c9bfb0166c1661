"""The order in which each stage of a live run took its inputs: what `flow.live.rerun` needs to repeat the run exactly.

A stage's outputs depend only on the order of its inputs, so only that order is recorded. It is one number for each
message taken, `skipped * ports + port`. `skipped` counts the messages of that edge that were dropped since the one
before. `port` is an index into the ports that the head names; the last port is `finish`. Numbers are LEB128 coded, so
small ones take one byte. A record is the head, one line of JSON, and then the numbers:

    {"stage": "track", "ports": ["pulses", "detections", "finish"], "first": 4711}
    0x00 0x00 0x01 0x00 ...

`first` is the number of messages that the stage took before these; it reveals a lost record.

Source: ours; LEB128 as in DWARF 5, 7.6.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from flow.link import RUN_TOPICS, LinkError, Record

ORDER_TOPIC = RUN_TOPICS + "order"
END_TOPIC = RUN_TOPICS + "end"
"""Topic of one record, JSON {"output_hash"}: the live run's hash (null: not computed), written when it has stopped."""
FINISH = "finish"
MAX_BITS = 63  # of a number
MAX_RECORD_BYTES = 4 * 2**20  # a stage that takes 10 000 messages a second for minutes


class OrderLog:
    """Encodes the order of one stage. The stage's thread adds to it, another thread takes the records."""

    def __init__(self, stage: str, ports: Sequence[str]) -> None:
        self._stage = stage
        self._ports = [*ports, FINISH]
        self._taken = [-1] * len(self._ports)  # number of the message taken last, by port
        self._numbers = bytearray()
        self._first = self._count = 0
        self._lock = threading.Lock()

    def add(self, port: int, number: int) -> None:
        """The stage takes message `number` of a port; those between it and the one before were dropped."""
        value = (number - self._taken[port] - 1) * len(self._ports) + port
        self._taken[port] = number
        with self._lock:
            while value > 0x7F:
                self._numbers.append(value & 0x7F | 0x80)
                value >>= 7
            self._numbers.append(value)
            self._count += 1

    def add_finish(self) -> None:
        """The stage finishes."""
        self.add(len(self._ports) - 1, 0)

    def take(self, now_ns: int) -> Record | None:
        """A record of the steps added since the call before; None: there are none."""
        with self._lock:
            if not self._numbers:
                return None
            head = {"stage": self._stage, "ports": self._ports, "first": self._first}
            data = json.dumps(head).encode() + b"\n" + self._numbers
            self._first, self._numbers = self._count, bytearray()
        return Record(ORDER_TOPIC, now_ns, now_ns, data)


@dataclass(slots=True)
class StageOrder:
    """The order of one stage, decoded."""

    ports: list[str]
    count: int = 0
    numbers: bytearray = field(default_factory=bytearray)
    cut_off: bool = False  # a record is missing; those after it are ignored

    def steps(self) -> Iterator[tuple[str, int]]:
        """(port, messages of it to skip before) of each message taken, in order. LinkError: the numbers are damaged."""
        value = shift = 0
        for byte in self.numbers:
            value |= (byte & 0x7F) << shift
            shift += 7
            if shift > MAX_BITS:
                raise LinkError("a stage's input order has a number that no run writes: is the recording damaged?")
            if byte < 0x80:
                skipped, port = divmod(value, len(self.ports))
                yield self.ports[port], skipped
                value = shift = 0


def read_orders(records: Iterable[Record]) -> dict[str, StageOrder]:
    """The order of each stage, from the records of ORDER_TOPIC in recorded order. LinkError: a record is no order."""
    orders: dict[str, StageOrder] = {}
    for record in records:
        try:
            head, _, numbers = record.data.partition(b"\n")
            fields = cast("dict[str, Any]", json.loads(head))
            stage, ports, first = str(fields["stage"]), [str(port) for port in fields["ports"]], int(fields["first"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise LinkError(f"{record.topic} at {record.arrival_ns} ns is no input order ({error!r})") from None
        order = orders.setdefault(stage, StageOrder(ports))
        whole = ports == order.ports and ports[-1:] == [FINISH] and first == order.count
        if order.cut_off or not whole or len(numbers) > MAX_RECORD_BYTES:
            order.cut_off = True
            continue
        order.numbers += numbers
        order.count += sum(byte < 0x80 for byte in numbers)
    return orders
