"""A live run: every message arrives, whatever else fails, raises or is slow."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from flow.events import EventMessage
from flow.link import Tap
from flow.live.report import LinkState
from flow.message import Message
from flow.stage import Settings
from tests.flow.live_toys import PATIENCE_S, Collector, Line, Memory, Stuck, graph_of, run_live

TOYS = "tests.flow.live_toys"
DOUBLING = f"""\
stages:
  brittle: {{use: {TOYS}.Brittle, inputs: {{number: line.number}}}}
links:
  line: {{use: {TOYS}.Line}}
  collector: {{use: {TOYS}.Collector, inputs: {{number: brittle.number}}}}
"""


def line_of(live) -> Line:
    return live.nodes["line"]


def collector_of(live) -> Collector:
    return live.nodes["collector"]


def test_numbers_go_through_a_stage_to_the_sink_in_their_order(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(*range(100))
    assert collector_of(live).take(100) == [2.0 * n for n in range(100)]
    report = live.stop()
    assert report.records == 100
    assert report.messages == {"line.number": 100, "brittle.number": 100}
    assert report.edges["brittle.number"].taken == report.edges["collector.number"].taken == 100
    assert (report.dropped, report.events, report.switched_off) == (0, [], [])
    assert report.nodes["brittle"].calls == 101  # finish is one


def test_a_stage_with_long_deadlines_takes_its_messages_without_being_woken_by_each(tmp_path):
    config = DOUBLING.replace("number: line.number", "number: {from: line.number, deadline_ms: 1000}")
    live = run_live(graph_of(tmp_path, config))
    rest = [thread for thread in live._wiring.stage_threads if thread._rests]
    assert [thread.name for thread in rest] == ["stage brittle"]
    line_of(live).put(*range(100))
    assert collector_of(live).take(100) == [2.0 * n for n in range(100)]
    report = live.stop()
    assert (report.dropped, report.events, report.edges["brittle.number"].taken) == (0, [], 100)


def test_taps_get_every_message_and_recorders_every_record_in_and_out(tmp_path):
    memory = Memory()
    live = run_live(graph_of(tmp_path, DOUBLING), [memory])
    line_of(live).put(1, 2)
    collector_of(live).take(2)
    live.stop()
    seen = sorted((name, arrival, message.value) for name, arrival, message in memory._seen)
    assert seen == [
        ("brittle.number", 1010, 2.0),
        ("brittle.number", 1020, 4.0),
        ("line.number", 1010, 1.0),
        ("line.number", 1020, 2.0),
    ]
    taken = [(r.topic, r.arrival_ns, r.data) for r in memory._records if not r.topic.startswith("/run/")]
    assert sorted(taken) == [
        ("/numbers", 1010, b"1"),
        ("/numbers", 1020, b"2"),
        ("/sent", 1, b"2"),
        ("/sent", 2, b"4"),
    ]


def test_a_link_that_fails_is_reported_and_reopened_and_nothing_else_stops(tmp_path):
    text = DOUBLING + f"  other: {{use: {TOYS}.OtherLine}}\n"
    live = run_live(graph_of(tmp_path, text))
    for end in ("cut", "burn", "end"):
        line_of(live).put(1, end, 2)
    assert collector_of(live).take(6) == [2.0, 4.0] * 3
    report = live.stop()
    texts = [str(event) for event in report.events]
    assert "line: the line is dead: is it plugged in?; it is reopened" in texts
    assert "line: line.listen failed: KeyError: 'smoke'; it is reopened" in texts
    assert "line: its records have ended; it is reopened" in texts
    assert "line: records arrive again (3 times)" in texts
    assert report.links["line"].openings == 4
    assert report.links["other"].openings == 1


class Listener(Tap):
    """Keeps the events that it receives."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._received: list[EventMessage] = []

    def wants(self, message: type[Message]) -> bool:
        return message is EventMessage

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        assert output == "run.events"
        assert isinstance(message, EventMessage)
        self._received.append(message)


def test_taps_get_each_event_once_at_its_time(tmp_path):
    listener = Listener()
    live = run_live(graph_of(tmp_path, DOUBLING.replace("brittle.number", "line.number")), [listener])
    line_of(live).put(*[13] * 50, 1, "cut", 2)
    assert collector_of(live).take(2) == [1.0, 2.0]
    live.stop()
    received = [(t.node, t.text, t.resolved, t.stamp_ns) for t in listener._received]
    assert sorted(received) == [
        ("collector", "thirteen is not sent: choose another number", False, 2_000),
        ("line", "records arrive again", True, 2_000),
        ("line", "the line is dead: is it plugged in?; it is reopened", False, 2_000),
    ]


def test_a_source_that_stops_sending_is_reported_and_its_return_too(tmp_path, monkeypatch):
    monkeypatch.setattr(Line, "silent_after_s", 0.3)
    live = run_live(graph_of(tmp_path, DOUBLING + f"  other: {{use: {TOYS}.OtherLine}}\n"))  # that one never speaks
    line_of(live).put(1)
    assert collector_of(live).take(1) == [2.0]
    text = "line: has sent nothing for 0.3 s: is it powered, and its cable plugged in?"
    wait_until(lambda: text in [str(event) for event in live.report().events])
    line_of(live).put(2)
    wait_until(lambda: "line: works again" in [str(event) for event in live.report().events])
    assert not [text for text in map(str, live.stop().events) if text.startswith("other")]


def wait_until(done):
    deadline_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline_s, "it was not reported in time"
        time.sleep(0.05)


def test_only_the_record_that_cannot_be_decoded_is_lost(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(1, "refuse", "no number", 2)
    assert collector_of(live).take(2) == [2.0, 4.0]
    report = live.stop()
    assert report.links["line"].undecoded == 2
    assert str(report.events[0]) == "line: no numbers here: is the counter plugged in?"
    assert "line.decode failed" in str(report.events[1])


def test_only_the_message_that_a_sink_fails_at_is_lost(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(6.5, 7)
    assert collector_of(live).take(1) == [14.0]
    report = live.stop()
    assert report.failures == {"collector": 1}
    assert [str(i) for i in report.events] == ["collector: thirteen is not sent: choose another number"]


def test_a_stage_that_raises_restarts_and_the_others_run_on(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(1, 666, 3, 4)
    assert collector_of(live).take(3) == [2.0, 6.0, 8.0]
    report = live.stop()
    assert (report.restarts, report.switched_off) == ({"brittle": 1}, [])
    assert report.counters["brittle"] == {"taken": 4}, "of both objects"
    (text,) = [str(i) for i in report.events]
    assert text.startswith("brittle: brittle.number failed at 0.000001 s: ArithmeticError: cannot take 666")
    assert text.endswith("brittle restarts")


def test_a_restarted_stage_has_no_state(tmp_path):
    memory = Memory()
    live = run_live(graph_of(tmp_path, DOUBLING), [memory])
    line_of(live).put(1, 2, 666, 3)
    collector_of(live).take(3)
    live.stop()
    assert [m.stamp_ns for name, _, m in memory._seen if name == "brittle.number"] == [1, 2, 1]


def test_a_stage_that_keeps_raising_is_switched_off_and_the_others_run_on(tmp_path):
    text = DOUBLING.replace(
        "  brittle:", f"  sound: {{use: {TOYS}.Brittle, inputs: {{number: other.number}}}}\n  brittle:"
    )
    text += (
        f"  other: {{use: {TOYS}.OtherLine}}\n  second: {{use: {TOYS}.Collector, inputs: {{number: sound.number}}}}\n"
    )
    live = run_live(graph_of(tmp_path, text))
    line_of(live).put(1, *[666] * 6, 2)
    live.nodes["other"].put(5)
    assert live.nodes["second"].take(1) == [10.0]
    next(stage for stage in live._wiring.stages if stage.stage.name == "brittle").ended.wait(PATIENCE_S)
    line_of(live).put(3, 4)
    live.nodes["other"].put(6)
    assert live.nodes["second"].take(1) == [12.0]
    report = live.stop()
    assert report.switched_off == ["brittle"]
    assert report.restarts == {"brittle": 5}
    assert collector_of(live).take(1) == [2.0]
    assert any("5 restarts in 60 s did not help: brittle stays off" in str(i) for i in report.events)


def test_a_link_reacts_to_restarts_and_the_loss_of_its_upstream_stage_and_that_is_reported(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    collector_of(live).begins_again = "it begins again"
    line_of(live).put(*[666] * 5)
    line_of(live).put(7)
    assert collector_of(live).take(1) == [14.0], "five restarts do not switch it off"
    line_of(live).put(666)
    assert collector_of(live).take(1) == ["number"]
    report = live.stop()
    assert report.switched_off == ["brittle"]
    assert "collector: 'brittle' is switched off: it stands still" in [str(i) for i in report.events]
    assert collector_of(live).restarted == ["number"] * 5
    assert "collector: 'brittle' restarts: it begins again (5 times)" in [str(i) for i in report.events]


GATED = DOUBLING.replace("Brittle", "Gate").replace("brittle", "gate")


def gate_of(live):
    return live._wiring.stages[0].stage._stage


@pytest.mark.parametrize(
    ("policy", "passed"),
    [
        ("{from: line.number, policy: latest}", [1.0, 9.0]),
        ("{from: line.number, policy: drop_oldest, depth: 3}", [1.0, 7.0, 8.0, 9.0]),
        ("line.number", [float(n) for n in range(1, 10)]),
    ],
)
def test_the_queue_of_a_slow_stage_keeps_what_its_edge_declares(tmp_path, policy, passed):
    memory = Memory()
    live = run_live(graph_of(tmp_path, GATED.replace("number: line.number", f"number: {policy}")), [memory])
    line_of(live).put(1)
    assert gate_of(live)._entered.wait(PATIENCE_S)
    line_of(live).put(*range(2, 10), "end")  # after the end the line is no longer open
    while live.report().links["line"].state is LinkState.OPEN:
        threading.Event().wait(0.01)
    gate_of(live)._open.set()
    assert collector_of(live).take(len(passed)) == passed
    report = live.stop()
    assert report.edges["gate.number"].dropped == report.dropped == 9 - len(passed)
    assert [m.value for name, _, m in memory._seen if name == "line.number"] == [float(n) for n in range(1, 10)]


def test_a_blocked_tap_stops_nothing_and_its_missed_messages_are_counted(tmp_path):
    stuck = Stuck()
    live = run_live(graph_of(tmp_path, DOUBLING), [stuck])
    for _ in range(6):
        line_of(live).put(*range(500))
        assert collector_of(live).take(500) == [2.0 * n for n in range(500)]
    assert live.report().tap_drops["stuck"] >= 2 * (
        3000 - 1024 - 1024
    )  # of two outputs, less those queued and those being taken
    stuck._go.set()
    live.stop()


def test_a_run_stops_although_a_stage_and_a_tap_block(tmp_path):
    stuck = Stuck()
    live = run_live(graph_of(tmp_path, GATED), [stuck])
    line_of(live).put(1, 2, 3)
    gate = gate_of(live)
    assert gate._entered.wait(PATIENCE_S)
    report = live.stop()
    texts = [str(event) for event in report.events]
    assert "run: the thread 'stage gate' did not end in time" in texts
    assert "run: the thread 'tap stuck' did not end in time" in texts
    gate._open.set()
    stuck._go.set()


ALL_HANG = f"""\
stages:
  gate: {{use: {TOYS}.Gate, inputs: {{number: line.number}}}}
  other_gate: {{use: {TOYS}.Gate, inputs: {{number: line.number}}}}
links:
  line: {{use: {TOYS}.Clinging}}
  jam: {{use: {TOYS}.Jam, inputs: {{number: line.number}}}}
"""


def test_a_run_stops_within_two_seconds_although_links_stages_and_a_tap_hang(tmp_path):
    """All kinds at once. The best of three, since a busy machine may be too slow for one."""
    took_s = []
    while len(took_s) < 3 and min(took_s, default=2.0) >= 2.0:
        stuck = Stuck()
        live = run_live(graph_of(tmp_path, ALL_HANG), [stuck])
        jam = live.nodes["jam"]
        line_of(live).put(1, 2, 3)
        gates = [run.stage._stage for run in live._wiring.stages]
        assert all(hanging._entered.wait(PATIENCE_S) for hanging in (*gates, jam))
        began_s = time.monotonic()
        report = live.stop()
        took_s.append(time.monotonic() - began_s)
        left = {str(i).split("'")[1] for i in report.events if "did not end in time" in str(i)}
        assert {"listen line", "close line", "stage gate", "stage other_gate", "send jam", "tap stuck"} <= left
        for event in (*(gate._open for gate in gates), jam._go, line_of(live)._go, stuck._go):
            event.set()
    assert min(took_s) < 2.0, took_s


def test_missed_deadlines_are_counted_for_each_edge(tmp_path):
    text = DOUBLING.replace("number: line.number", "number: {from: line.number, deadline_ms: 0.001}")
    graph = graph_of(tmp_path, text)
    live = run_live(graph)  # its clock is at 2000 ns; arrivals are 1010, 1020, ...
    line_of(live).put(*range(3))
    collector_of(live).take(3)
    report = live.stop()
    assert [report.edges[name].missed for name in ("brittle.number", "collector.number")] == [0, 0]
    late = graph_of(tmp_path, text.replace("0.001", "0.00098"))
    live = run_live(late)
    line_of(live).put(*range(3))
    collector_of(live).take(3)
    report = live.stop()
    assert [report.edges[name].missed for name in ("brittle.number", "collector.number")] == [1, 0]
    assert report.edges["brittle.number"].lag_max_ms == 990e-6


def test_a_source_that_cannot_listen_is_reported(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING.replace(f"{TOYS}.Line", "tests.flow.toys.Numbers")))
    report = live.stop()
    assert [str(i) for i in report.events] == ["line: Numbers cannot run live: it gives nothing"]


def test_a_failing_tap_is_reported_and_affects_nothing_else(tmp_path):
    class Broken(Tap):
        def see(self, output, message, arrival_ns):
            raise OSError(28, "No space left on device")

    live = run_live(graph_of(tmp_path, DOUBLING), [Broken()])
    line_of(live).put(1, 2)
    assert collector_of(live).take(2) == [2.0, 4.0]
    texts = [str(i) for i in live.stop().events]
    assert any("No space left on device" in text for text in texts)


def test_two_runs_of_one_graph_share_nothing(tmp_path):
    graph = graph_of(tmp_path, DOUBLING)
    for _ in range(2):
        live = run_live(graph)
        line_of(live).put(5)
        assert collector_of(live).take(1) == [10.0]
        assert live.stop().records == 1
