"""Stages in worker processes of a live run: the same outputs and errors, and restarts when a process ends."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from flow.config_error import ConfigError
from flow.graph import load_graph
from flow.message import Message, message
from flow.stage import Stage
from tests.flow.live.test_live_rerun import RACE, race, rerun_of
from tests.flow.live.test_live_run import DOUBLING, collector_of, line_of
from tests.flow.live_toys import PATIENCE_S, graph_of, run_live
from tests.flow.toys import Number

REMOTE = DOUBLING.replace("inputs: {number: line.number}}", "inputs: {number: line.number}, process: worker}", 1)


@message
class Odd(Message):
    """Cannot be encoded."""

    things: list[int]


class Oddly(Stage):
    """Gives a message that cannot be encoded."""

    def on_number(self, number: Number) -> Odd:
        return Odd(stamp_ns=number.stamp_ns, things=[1])


def runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_remote_stage_gives_the_same_outputs_and_its_process_ends_with_the_run(tmp_path):
    live = run_live(graph_of(tmp_path, REMOTE))
    (pid,) = live.processes
    assert pid != os.getpid()
    line_of(live).put(*range(100))
    assert collector_of(live).take(100) == [2.0 * n for n in range(100)]
    assert live.report().counters["brittle"] == {"taken": 100}
    report = live.stop()
    assert report.messages == {"line.number": 100, "brittle.number": 100}
    assert (report.dropped, report.events) == (0, [])
    assert not runs(pid)


def test_an_exception_of_a_remote_stage_has_the_same_text_and_restarts_it(tmp_path):
    texts_of = []
    for text in (DOUBLING, REMOTE):
        live = run_live(graph_of(tmp_path, text))
        line_of(live).put(1, 666, 2)
        assert collector_of(live).take(2) == [2.0, 4.0]
        report = live.stop()
        assert report.restarts == {"brittle": 1}
        assert report.counters["brittle"] == {"taken": 3}
        texts_of.append([str(event) for event in report.events])
    assert texts_of[0] == texts_of[1] != []


def test_the_rerun_of_a_live_run_with_remote_stages_has_its_hash(tmp_path):
    text = RACE.replace("{use: tests.flow.live_toys.Order,", "{process: worker, use: tests.flow.live_toys.Order,")
    assert text.count("process: worker") == 2
    graph = graph_of(tmp_path, text)
    report, digest, records = race(graph)
    rerun, second, same = rerun_of(graph, records)
    assert same == digest
    assert second.messages == report.messages
    assert rerun.left == {}


def test_a_killed_process_is_reported_and_replaced_for_all_its_stages(tmp_path):
    text = REMOTE + "  also: {use: tests.flow.live_toys.Collector, inputs: {number: second.number}}\n"
    second = "  second: {use: tests.flow.live_toys.Brittle, inputs: {number: line.number}, process: worker}\n"
    live = run_live(graph_of(tmp_path, text.replace("links:\n", second + "links:\n")))
    both = [live.nodes["collector"], live.nodes["also"]]
    (pid,) = live.processes
    line_of(live).put(1)
    assert [sink.take(1) for sink in both] == [[2.0], [2.0]]
    os.kill(pid, signal.SIGKILL)
    end_s = time.monotonic() + PATIENCE_S
    while len(live.report().restarts) < 2:  # each stage learns of it with its next message
        line_of(live).put(2)
        threading.Event().wait(0.05)
        assert time.monotonic() < end_s
    line_of(live).put(3)
    for sink in both:
        while sink.take(1) != [6.0]:
            pass
    (other,) = live.processes
    assert other != pid
    report = live.stop()
    assert report.restarts == {"brittle": 1, "second": 1}
    texts = [str(event) for event in report.events]
    assert sum("the process 'worker' has ended by signal 9 (Killed); " in t and "restarts" in t for t in texts) == 2, (
        texts
    )
    assert not runs(other)


def test_a_blocked_remote_stage_does_not_prevent_the_end_of_the_run(tmp_path):
    text = REMOTE.replace("live_toys.Brittle", "live_toys.Gate")
    live = run_live(graph_of(tmp_path, text))
    (pid,) = live.processes
    line_of(live).put(1)
    while not live.report().edges["brittle.number"].taken and not live._wiring.stages[0].stage.last_ns:
        threading.Event().wait(0.01)
    begin_s = time.monotonic()
    live.stop()
    assert time.monotonic() - begin_s < 4.0
    assert not runs(pid)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ("process: Aside", "must be a name as stages have, got 'Aside'"),
        ("process: 3", "must be a name as stages have, got 3"),
        ("process: ''", "must be a name as stages have, got ''"),
        (
            "process: worker, thread: lidar",
            "in a worker process each stage has its own thread: leave 'thread' out, or write",
        ),
    ],
)
def test_a_wrong_process_is_an_error_with_its_line(tmp_path, wrong, text):
    (tmp_path / "live.yaml").write_text(REMOTE.replace("process: worker", wrong))
    with pytest.raises(ConfigError) as caught:
        load_graph(tmp_path / "live.yaml")
    (error,) = caught.value.errors
    assert text in error.text
    assert error.location.line == 2


def test_null_takes_back_the_thread_and_the_process_of_an_included_file(tmp_path):
    (tmp_path / "shared.yaml").write_text(REMOTE.replace("process: worker", "thread: lidar"))
    (tmp_path / "remote.yaml").write_text("include: shared.yaml\nstages: {brittle: {thread: null, process: worker}}\n")
    (tmp_path / "local.yaml").write_text("include: remote.yaml\nstages: {brittle: {process: null}}\n")
    specs = [load_graph(tmp_path / f"{name}.yaml").nodes["brittle"] for name in ("shared", "remote", "local")]
    assert [(spec.process, spec.thread) for spec in specs] == [("", "lidar"), ("worker", "brittle"), ("", "brittle")]


def test_a_stage_whose_messages_cannot_be_encoded_must_not_name_a_process(tmp_path):
    text = REMOTE.replace("tests.flow.live_toys.Brittle", "tests.flow.remote.test_stage_process.Oddly")
    (tmp_path / "live.yaml").write_text(text[: text.index("  collector")])
    with pytest.raises(ConfigError, match=r"Odd\.things cannot cross to another process or host: .* leave it out"):
        load_graph(tmp_path / "live.yaml")
