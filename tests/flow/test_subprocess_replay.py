"""A replay in several processes: its partitions, and that outputs, order and errors are those of one process."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field

from flow import subprocess_replay
from flow.graph import load_graph
from flow.link import LinkError, Record, Tap
from flow.message import Message
from flow.ports import RemoteError, RunError
from flow.replay import replay
from flow.stage import Settings, Stage
from flow.subprocess_replay import replay_in_subprocesses
from flow.taps import Digest
from tests.flow.toys import Number, Numbers, NumbersSettings, Text

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked, and this system has no fork")


class SlowSettings(Settings):
    """Settings of `Slow`."""

    longest_s: float = Field(0.0, ge=0)
    killed_at: float | None = None
    raises_at: float | None = None
    undeclared_at: float | None = None


class Slow(Stage[SlowSettings]):
    """Passes a number on, and its negative, after a random delay; counts them."""

    def __init__(self, settings: SlowSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._count: int = 0

    def on_number(self, number: Number) -> Iterator[Number]:
        settings = self.settings
        if settings.longest_s:
            time.sleep(random.random() * settings.longest_s)
        if number.value == settings.killed_at:
            os.kill(os.getpid(), signal.SIGKILL)
        yield Number(stamp_ns=number.stamp_ns, value=number.value + self._count)
        if number.value == settings.raises_at:
            raise ZeroDivisionError("on request")
        if number.value == settings.undeclared_at:
            yield Text(stamp_ns=0, words="not declared")  # type: ignore[misc]
        yield Number(stamp_ns=number.stamp_ns, value=-number.value)
        self._count += 1

    def finish(self) -> Number:
        return Number(stamp_ns=0, value=1e6 + self._count)

    @property
    def counters(self) -> dict[str, int]:
        return {"taken": self._count}


class Numbers2Settings(NumbersSettings):
    """Settings of `Numbers2`."""

    topic: str = "/numbers2"


class Numbers2(Numbers):
    """Numbers by another topic."""

    settings_type = Numbers2Settings


class LogSettings(Settings):
    """Settings of `Log`."""

    only: str | None = None


class Log(Tap[LogSettings]):
    """Keeps its messages in order; of one type only, if `only` is set."""

    def __init__(self, settings: LogSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._seen: list[tuple[str, int, str]] = []

    def wants(self, message: type[Message]) -> bool:
        return self.settings.only is None or message.__name__ == self.settings.only

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        content = [getattr(message, name) for name in ("value", "total", "words") if hasattr(message, name)]
        self._seen.append((output, arrival_ns, f"{message.stamp_ns} {content}"))


GRAPH = """\
stages:
  first: {use: tests.flow.test_subprocess_replay.Slow, inputs: {number: numbers.number}}
  near: {use: tests.flow.test_subprocess_replay.Slow, inputs: {number: first.number}, process: near}
  far: {use: tests.flow.test_subprocess_replay.Slow, inputs: {number: numbers2.number}, process: far}
  home: {use: tests.flow.test_subprocess_replay.Slow, inputs: {number: first.number}}
  join:
    use: tests.flow.toys.Add
    config: {name: joined}
    inputs: {left: near.number, right: far.number, words: words.text}
  end:
    use: tests.flow.toys.Add
    config: {name: end}
    inputs: {left: home.number, right: near.number}
links:
  numbers: {use: tests.flow.toys.Numbers}
  numbers2: {use: tests.flow.test_subprocess_replay.Numbers2}
  words: {use: tests.flow.toys.Words}
"""


def graph_of(folder, *changes: tuple[str, str]):
    text = GRAPH
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / "x.yaml").write_text(text)
    return load_graph(folder / "x.yaml")


def setting(stage: str, text: str) -> tuple[str, str]:
    return (
        f"  {stage}: {{use: tests.flow.test_subprocess_replay.Slow",
        f"  {stage}: {{use: tests.flow.test_subprocess_replay.Slow, config: {{{text}}}",
    )


def records(count: int, seed: int = 0) -> list[Record]:
    """Records of all topics in random order, some at equal times, and of one topic that no source takes."""
    draw = random.Random(seed)
    topics = ("/numbers", "/numbers2", "/words", "/nobody")
    made = [(draw.choice(topics), 1000 + 10 * (i // 3), i) for i in range(count)]
    return [Record(topic, at, at - 500, str(i).encode(), i) for topic, at, i in made]


def ran(run, graph, given, **kwargs):
    """(hash, messages of a tap in order, report without times) of a run."""
    digest, log = Digest(), Log()
    report = run(graph, given, (digest, log), **kwargs)
    counts = (report.records, report.first_ns, report.last_ns, report.steps, report.messages, report.unwired_topics)
    calls = {name: node.calls for name, node in report.nodes.items()}
    return digest.hexdigest(), log._seen, (*counts, calls, report.counters, [str(i) for i in report.events])


def test_a_partition_is_a_stage_with_all_that_feeds_it_and_partitions_that_share_a_node_are_one(tmp_path):
    assert set(graph_of(tmp_path).partitions()) == {
        frozenset({"numbers", "first", "near"}),
        frozenset({"numbers2", "far"}),
    }
    both = graph_of(tmp_path, ("far: {use: tests.flow.test_subprocess_replay.Slow, inputs: {number: numbers2", "far: {use: tests.flow.test_subprocess_replay.Slow, inputs: {number: numbers"))  # fmt: skip
    assert both.partitions() == [{"numbers", "first", "near", "far"}]
    assert graph_of(tmp_path, ("process: far", "process: near")).partitions() == [
        {"numbers", "first", "near", "numbers2", "far"}
    ]
    assert load_graph(CONFIGS / "estimate.yaml").partitions() == []


def test_with_both_fisheyes_the_images_of_each_camera_have_a_partition():
    drone, vehicle = sorted(load_graph(CONFIGS / "vision.yaml").partitions(), key=len)
    assert drone == {"camera_drone", "autopilot", "vp_drone", "drone_odometry"}
    assert {"camera_vehicle", "vp_vehicle", "sweep", "lidar"} < vehicle
    assert not vehicle & {"detect", "track", "align", "fuse"}


@pytest.mark.parametrize("seed", range(3))
def test_outputs_their_order_and_the_report_are_those_of_one_process_at_any_speed(tmp_path, seed, monkeypatch):
    monkeypatch.setattr(subprocess_replay, "MAX_RECORDS", 40)
    monkeypatch.setattr(subprocess_replay, "BATCH_RECORDS", 1 + 3 * seed)
    given = records(400, seed)
    wanted = ran(replay, graph_of(tmp_path), given)
    slow = [
        setting(name, "longest_s: 0.002") for name in random.Random(seed).sample(["first", "near", "far", "home"], 2)
    ]
    assert ran(replay_in_subprocesses, graph_of(tmp_path, *slow), given) == wanted
    assert len(wanted[1]) > 1000


def test_a_configuration_without_processes_runs_in_one(tmp_path):
    (tmp_path / "y.yaml").write_text(GRAPH.replace(", process: near", "").replace(", process: far", ""))
    plain = load_graph(tmp_path / "y.yaml")
    assert ran(replay_in_subprocesses, plain, records(50)) == ran(replay, graph_of(tmp_path), records(50))


def test_an_empty_recording_runs_to_its_end(tmp_path):
    assert ran(replay_in_subprocesses, graph_of(tmp_path), []) == ran(replay, graph_of(tmp_path), [])


@pytest.mark.parametrize("how", ["raises_at", "undeclared_at"])
@pytest.mark.parametrize("stage", ["near", "far", "home"])
def test_an_exception_of_a_stage_comes_in_its_turn_with_the_same_text(tmp_path, how, stage):
    graph, given = graph_of(tmp_path, setting(stage, f"{how}: 205")), records(400, 3)
    given = [Record("/numbers2" if stage == "far" else "/numbers", r.arrival_ns, r.stamp_ns, r.data, r.sequence)
             if r.data == b"205" else r for r in given]  # fmt: skip
    if stage != "far":
        given = [r for r in given if r.topic != "/numbers" or r.data == b"205"]  # first adds how many came before
    seen = []
    for run in (replay, replay_in_subprocesses):
        log = Log()
        with pytest.raises(RunError) as caught:
            run(graph, given, (log,))
        cause = caught.value.__cause__
        text = str(cause) if isinstance(cause, RemoteError) else f"{type(cause).__name__}: {cause}"
        seen.append((str(caught.value), text, log._seen))
    assert seen[0] == seen[1]
    assert stage in seen[0][0]


def test_a_process_that_is_killed_is_named_with_the_signal(tmp_path):
    graph = graph_of(tmp_path, setting("far", "killed_at: 7"))
    given = [Record("/numbers2", 1000 + i, i, str(i).encode(), i) for i in range(2000)]
    with pytest.raises(RunError, match=r"^the process 'far' has ended by signal 9 \(Killed\): is there enough memory"):
        replay_in_subprocesses(graph, given)


def test_rejected_records_are_reported_and_a_source_that_rejects_all_ends_the_replay(tmp_path, monkeypatch):
    given = records(60, 1)
    some = [
        Record(r.topic, r.arrival_ns, r.stamp_ns, b"refuse" if i % 7 == 0 else r.data, i) for i, r in enumerate(given)
    ]
    wanted = ran(replay, graph_of(tmp_path), some)
    assert ran(replay_in_subprocesses, graph_of(tmp_path), some) == wanted
    assert any("plugged in" in text for text in wanted[2][-1])
    every = [Record("/numbers2", 1000 + i, i, b"refuse", i) for i in range(9)]
    with pytest.raises(LinkError, match=r"^no numbers here: is the counter plugged in\?$"):
        replay_in_subprocesses(graph_of(tmp_path), every)
    monkeypatch.setattr("flow.replay.MAX_REFUSALS", 3)
    log = Log()
    with pytest.raises(LinkError, match="no numbers here"):
        replay_in_subprocesses(graph_of(tmp_path), [*every[:3], *given], (log,))
    assert not log._seen


def test_a_read_error_of_the_recording_ends_the_replay_after_the_records_before_it(tmp_path):
    def broken():
        yield from records(90, 2)
        raise LinkError("the disk is gone")

    seen = []
    for run in (replay, replay_in_subprocesses):
        log = Log()
        with pytest.raises(LinkError, match="the disk is gone"):
            run(graph_of(tmp_path), broken(), (log,))
        seen.append(log._seen)
    assert seen[0] == seen[1]
    assert len(seen[0]) > 200


def test_a_tap_that_raises_ends_a_replay_and_its_processes(tmp_path):
    class Broken(Tap):
        def see(self, output: str, message: Message, arrival_ns: int) -> None:
            raise LinkError("full")

    before = children()
    with pytest.raises(LinkError, match="full"):
        replay_in_subprocesses(graph_of(tmp_path), records(50), (Broken(),))
    assert children() == before


def children() -> set[int]:
    return {child.pid or 0 for child in multiprocessing.active_children()}


def test_records_and_bytes_sent_ahead_of_their_turn_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess_replay, "MAX_RECORDS", 50)
    monkeypatch.setattr(subprocess_replay, "MAX_BYTES", 1000)
    taken = 0

    class Watch(Tap):
        def see(self, output: str, message: Message, arrival_ns: int) -> None:
            ahead.append(taken - message.stamp_ns)

    def counted(size: int):
        nonlocal taken
        for i in range(300):
            taken = i
            yield Record("/numbers2", 1000 + i, i, b"%0*d" % (size, i), i)

    for size, most in ((3, 50), (100, 11)):
        ahead: list[int] = []
        replay_in_subprocesses(graph_of(tmp_path), counted(size), (Watch(),))
        sources = ahead[: 300 * 3]
        assert most - 5 <= max(sources) <= most


def test_only_messages_that_are_taken_are_sent_back(tmp_path, monkeypatch):
    received: list[tuple[str, Message | None]] = []
    outputs = subprocess_replay._Partition.outputs

    def listening(self):
        given = outputs(self)
        received.extend(given.messages)
        return given

    monkeypatch.setattr(subprocess_replay._Partition, "outputs", listening)
    log = Log(only="Sum")
    report = replay_in_subprocesses(graph_of(tmp_path), records(100), (Digest(), log))
    assert {name for name, message in received if message is None} == {"numbers.number", "numbers2.number"}
    assert {name for name, message in received if message is not None} == {"first.number", "near.number", "far.number"}
    assert {name for name, _, _ in log._seen} == {"join.sum", "end.sum"}
    assert report.messages["numbers.number"] == sum(r.topic == "/numbers" for r in records(100))
