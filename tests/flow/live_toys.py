"""Small sources, sinks, stages and taps for live runs, controlled by the tests."""

from __future__ import annotations

import contextlib
import mmap
import queue
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from flow.graph import Graph, load_graph
from flow.link import Link, LinkError, PolledRecords, Record, Run, Source, SourceSettings, Tap
from flow.live import Live
from flow.message import Message
from flow.stage import Settings, Stage
from stages.messages import Tick
from tests.flow.toys import Number, Sum

PATIENCE_S = 60.0  # for what must happen, on a busy machine too


class LineSettings(SourceSettings):
    """Settings of `Line`."""

    topic: str = "/numbers"


class Line(Source[LineSettings]):
    """A source whose bytes a test puts in; it can be cut."""

    def __init__(self, settings: LineSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._queue = queue.SimpleQueue()
        self._openings: list[threading.Event] = []
        self._arrival_ns: int = 1_000

    def decode(self, record: Record) -> Number | None:
        if record.data == b"refuse":
            raise LinkError("no numbers here: is the counter plugged in?")
        return Number(stamp_ns=record.stamp_ns, value=float(record.data)) if record.data else None

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        closed = threading.Event()
        self._openings.append(closed)

        def records() -> Iterator[Record]:
            while not closed.is_set():
                try:
                    data = self._queue.get(timeout=0.05)
                except queue.Empty:
                    continue
                if data == b"cut":
                    raise LinkError("the line is dead: is it plugged in?")
                if data == b"burn":
                    raise KeyError("smoke")
                if data == b"end":
                    return
                self._arrival_ns += 10
                yield Record(self.settings.topic, self._arrival_ns, self._arrival_ns - 5, data)

        try:
            yield records()
        finally:
            closed.set()

    def put(self, *values: object) -> None:
        for value in values:
            self._queue.put(str(value).encode())


class OtherLineSettings(LineSettings):
    """Settings of `OtherLine`."""

    topic: str = "/others"


class OtherLine(Line):
    """A second one."""

    settings_type = OtherLineSettings


class Numbers(PolledRecords):
    """The records of an opened `PolledLine`."""

    def __init__(self, line: PolledLine) -> None:
        super().__init__()
        self._line = line

    @property
    def files(self) -> list[socket.socket]:
        return [self._line._reader]

    def pending(self) -> list[Record]:
        with contextlib.suppress(BlockingIOError):
            self._line._reader.recv(1)
        return self._line.pending()


class PolledLine(Line):
    """A line that shares a thread: each item is announced by a byte."""

    polled: ClassVar[bool] = True

    def __init__(self, settings: LineSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)

    def pending(self) -> list[Record]:
        try:
            data = self._queue.get_nowait()
        except queue.Empty:
            return []
        if data == b"cut":
            raise LinkError("the line is dead: is it plugged in?")
        if data == b"burn":
            raise KeyError("smoke")
        self._arrival_ns += 10
        return [Record(self.settings.topic, self._arrival_ns, self._arrival_ns - 5, data)]

    @contextmanager
    def listen(self) -> Iterator[Numbers]:
        numbers = Numbers(self)
        try:
            yield numbers
        finally:
            numbers.closed.set()

    def put(self, *values: object) -> None:
        super().put(*values)
        self._writer.send(bytes(len(values)))


class Clinging(Line):
    """A line that can be closed only when a test releases it."""

    def __init__(self, settings: LineSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._go = threading.Event()

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        with super().listen() as records:
            try:
                yield records
            finally:
                self._go.wait(PATIENCE_S)


class Jam(Link):
    """A sink that blocks at its first number until a test releases it."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._go = threading.Event()
        self._entered = threading.Event()

    def on_number(self, number: Number) -> None:
        self._entered.set()
        self._go.wait(PATIENCE_S)


class Collector(Link):
    """A sink that keeps its messages and records what it sent."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._got = queue.SimpleQueue()
        self._sent: list[Record] = []
        self.restarted: list[str] = []  # ports whose stage has restarted
        self.begins_again: str | None = None

    def on_number(self, number: Number) -> None:
        if number.value == 13:
            raise LinkError("thirteen is not sent: choose another number")
        self._sent.append(Record("/sent", number.stamp_ns, number.stamp_ns, b"%d" % int(number.value)))
        self._got.put(number.value)

    def upstream_restarted(self, port: str) -> str | None:
        self.restarted.append(port)
        return self.begins_again

    def upstream_lost(self, port: str) -> str:
        self._got.put(port)
        return "it stands still"

    def sent(self) -> list[Record]:
        sent, self._sent = self._sent, []
        return sent

    def take(self, count: int) -> list[float]:
        return [self._got.get(timeout=PATIENCE_S) for _ in range(count)]


class Brittle(Stage):
    """Doubles; raises at 666 and 999; counts its messages since it was made."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._taken: int = 0

    def on_number(self, number: Number) -> Number:
        self._taken += 1
        if number.value in (666, 999):
            raise ArithmeticError(f"cannot take {number.value:g}")
        return Number(stamp_ns=self._taken, value=2 * number.value)

    @property
    def counters(self) -> dict[str, int]:
        return {"taken": self._taken}


class Gate(Stage):
    """Passes numbers on, but blocks in each call until a test opens it."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._open = threading.Event()
        self._entered = threading.Event()

    def on_number(self, number: Number) -> Number:
        self._entered.set()
        assert self._open.wait(PATIENCE_S)
        return number


class Order(Stage):
    """Its output depends on the order of its inputs."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._value: float = 0.0

    def on_left(self, number: Number) -> Number:
        self._value = (3 * self._value + number.value) % 1_000_003
        return Number(stamp_ns=number.stamp_ns, value=self._value)

    def on_right(self, number: Number) -> Number:
        self._value = (5 * self._value + 7 * number.value) % 1_000_003
        return Number(stamp_ns=number.stamp_ns, value=self._value)

    def finish(self) -> Number:
        return Number(stamp_ns=1, value=self._value)


class Memory(Tap):
    """Keeps records and messages."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._records: list[Record] = []
        self._seen: list[tuple[str, int, Message]] = []

    def record(self, record: Record) -> None:
        self._records.append(record)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        if not output.startswith("run."):
            self._seen.append((output, arrival_ns, message))


class Stuck(Tap):
    """A viewer that blocks at the first message until a test releases it."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._go = threading.Event()

    def wants(self, message: type[Message]) -> bool:
        return issubclass(message, Number | Sum)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        self._go.wait(PATIENCE_S)


def graph_of(folder, text: str) -> Graph:
    (folder / "live.yaml").write_text(text)
    return load_graph(folder / "live.yaml")


def run_live(graph: Graph, taps=(), **kwargs) -> Live:
    """A run that has started; the clock stands still, so that no lag depends on the machine."""
    live = Live(graph, taps, now_ns=lambda: 2_000, **kwargs)
    live.start()
    return live


class TickerSettings(Settings):
    """Settings of `Ticker`."""

    raise_at: int | None = None


class Ticker(Stage[TickerSettings]):
    """Counts ticks."""

    def __init__(self, settings: TickerSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._count: int = 0

    def on_tick(self, tick: Tick) -> Number:
        self._count += 1
        if self._count == self.settings.raise_at:
            raise ArithmeticError(f"requested at {self._count}")
        return Number(stamp_ns=tick.stamp_ns, value=self._count)


class JudgeSettings(Settings):
    """Settings of `ArrivalTap`."""

    file: Path


class ArrivalTap(Tap[JudgeSettings]):
    """Keeps the newest record's arrival in a mapped file, which outlives the process."""

    def __init__(self, settings: JudgeSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._map: Any = None

    def wants(self, message: type[Message]) -> bool:
        return False

    def open(self, run: Run) -> None:
        if run.live:
            self.settings.file.write_bytes(bytes(8))
            with self.settings.file.open("r+b") as stream:
                self._map = mmap.mmap(stream.fileno(), 8)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        pass

    def record(self, record: Record) -> None:
        self._map[:] = struct.pack("<q", record.arrival_ns)
