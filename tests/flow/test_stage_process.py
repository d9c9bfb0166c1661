"""Stages that work in a process of their own: the same messages, the same words, and a process that ends is no end."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from flow.graph import load_graph
from flow.message import Message, message
from flow.problem import ConfigError
from flow.stage import Stage
from tests.flow.live_toys import PATIENCE_S, graph_of, run_live
from tests.flow.test_live_rerun import RACE, again, race
from tests.flow.test_live_run import DOUBLING, collector_of, line_of
from tests.flow.toys import Number

ELSEWHERE = DOUBLING.replace("inputs: {number: line.number}}", "inputs: {number: line.number}, process: aside}", 1)


@message
class Odd(Message):
    """Does not travel."""

    things: list[int]


class Oddly(Stage):
    """Gives what cannot cross to another process."""

    def on_number(self, number: Number) -> Odd:
        return Odd(stamp_ns=number.stamp_ns, things=[1])


def runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_stage_elsewhere_gives_what_it_would_give_here_and_its_process_ends_with_the_run(tmp_path):
    live = run_live(graph_of(tmp_path, ELSEWHERE))
    (pid,) = live.processes
    assert pid != os.getpid()
    line_of(live).put(*range(100))
    assert collector_of(live).take(100) == [2.0 * n for n in range(100)]
    assert live.report().counters["brittle"] == {"taken": 100}
    report = live.stop()
    assert report.messages == {"line.number": 100, "brittle.number": 100}
    assert (report.dropped, report.incidents) == (0, [])
    assert not runs(pid)


def test_what_a_stage_elsewhere_raises_is_said_in_the_same_words_and_it_starts_afresh(tmp_path):
    said = []
    for text in (DOUBLING, ELSEWHERE):
        live = run_live(graph_of(tmp_path, text))
        line_of(live).put(1, 666, 2)
        assert collector_of(live).take(2) == [2.0, 4.0]
        report = live.stop()
        assert report.restarts == {"brittle": 1}
        assert report.counters["brittle"] == {"taken": 3}
        said.append([str(incident) for incident in report.incidents])
    assert said[0] == said[1] != []


def test_a_live_run_with_stages_in_processes_taken_again_has_its_hash(tmp_path):
    text = RACE.replace("{use: tests.flow.live_toys.Order,", "{process: aside, use: tests.flow.live_toys.Order,")
    assert text.count("process: aside") == 2
    graph = graph_of(tmp_path, text)
    report, digest, records = race(graph)
    rerun, second, same = again(graph, records)
    assert same == digest
    assert second.messages == report.messages
    assert rerun.left == {}


def test_a_process_that_is_killed_is_said_and_a_fresh_one_takes_over_for_all_its_stages(tmp_path):
    text = ELSEWHERE + "  also: {use: tests.flow.live_toys.Collector, inputs: {number: second.number}}\n"
    second = "  second: {use: tests.flow.live_toys.Brittle, inputs: {number: line.number}, process: aside}\n"
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
    texts = [str(incident) for incident in report.incidents]
    assert (
        sum("the process 'aside' has ended by signal 9 (Killed); " in t and "starts afresh" in t for t in texts) == 2
    ), texts
    assert not runs(other)


def test_a_stage_that_hangs_elsewhere_keeps_no_run_from_ending(tmp_path):
    text = ELSEWHERE.replace("live_toys.Brittle", "live_toys.Gate")
    live = run_live(graph_of(tmp_path, text))
    (pid,) = live.processes
    line_of(live).put(1)
    while not live.report().edges["brittle.number"].taken and not live._wiring.stages[0].life.last_ns:
        threading.Event().wait(0.01)
    begin_s = time.monotonic()
    live.stop()
    assert time.monotonic() - begin_s < 4.0
    assert not runs(pid)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("process: Aside", "must be a name as stages have, got 'Aside'"),
        ("process: 3", "must be a name as stages have, got 3"),
        ("process: aside, thread: lidar", "in a process each stage has a thread of its own: leave 'thread' out"),
    ],
)
def test_a_wrong_process_is_an_error_with_its_place(tmp_path, wrong, said):
    (tmp_path / "live.yaml").write_text(ELSEWHERE.replace("process: aside", wrong))
    with pytest.raises(ConfigError) as error:
        load_graph(tmp_path / "live.yaml")
    (problem,) = error.value.problems
    assert said in problem.text
    assert problem.place.line == 2


def test_a_stage_whose_messages_cannot_cross_is_no_stage_for_a_process(tmp_path):
    text = ELSEWHERE.replace("tests.flow.live_toys.Brittle", "tests.flow.test_stage_process.Oddly")
    (tmp_path / "live.yaml").write_text(text[: text.index("  collector")])
    with pytest.raises(ConfigError, match=r"Odd\.things cannot cross to another process or host: .* leave it out"):
        load_graph(tmp_path / "live.yaml")
