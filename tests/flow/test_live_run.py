"""A live run: what goes in comes out, whatever dies, raises or dawdles beside it."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from flow.incidents import IncidentTold
from flow.link import Tap
from flow.message import Message
from flow.stage import Settings
from tests.flow.live_toys import PATIENCE_S, Collector, Line, Memory, Stuck, graph_of, run_live

ROOM = "tests.flow.live_toys"
DOUBLING = f"""\
stages:
  brittle: {{use: {ROOM}.Brittle, inputs: {{number: line.number}}}}
links:
  line: {{use: {ROOM}.Line}}
  collector: {{use: {ROOM}.Collector, inputs: {{number: brittle.number}}}}
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
    assert (report.dropped, report.incidents, report.off) == (0, [], [])
    assert report.nodes["brittle"].calls == 101  # finish is one


def test_taps_see_every_message_and_recorders_every_record_in_and_out(tmp_path):
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


def test_a_link_that_dies_is_said_and_opened_again_and_nothing_else_stops(tmp_path):
    text = DOUBLING + f"  other: {{use: {ROOM}.OtherLine}}\n"
    live = run_live(graph_of(tmp_path, text))
    for end in ("cut", "burn", "end"):
        line_of(live).put(1, end, 2)
    assert collector_of(live).take(6) == [2.0, 4.0] * 3
    report = live.stop()
    texts = [str(incident) for incident in report.incidents]
    assert "line: the line is dead: is it plugged in?; it is opened again" in texts
    assert "line: line.listen failed: KeyError: 'smoke'; it is opened again" in texts
    assert "line: its records have ended; it is opened again" in texts
    assert "line: records come again (3 times)" in texts
    assert report.links["line"].openings == 4
    assert report.links["other"].openings == 1


class Listener(Tap):
    """Keeps the incidents it is told."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._told: list[IncidentTold] = []

    def wants(self, message: type[Message]) -> bool:
        return message is IncidentTold

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        assert output == "run.incidents"
        assert isinstance(message, IncidentTold)
        self._told.append(message)


def test_taps_are_told_of_incidents_at_their_time_and_not_again_and_again(tmp_path):
    listener = Listener()
    live = run_live(graph_of(tmp_path, DOUBLING.replace("brittle.number", "line.number")), [listener])
    line_of(live).put(*[13] * 50, 1, "cut", 2)
    assert collector_of(live).take(2) == [1.0, 2.0]
    live.stop()
    told = [(t.node, t.text, t.mended, t.stamp_ns) for t in listener._told]
    assert sorted(told) == [
        ("collector", "thirteen is not sent: choose another number", False, 2_000),
        ("line", "records come again", True, 2_000),
        ("line", "the line is dead: is it plugged in?; it is opened again", False, 2_000),
    ]


def test_a_source_that_has_spoken_and_falls_silent_is_said_and_its_return_too(tmp_path, monkeypatch):
    monkeypatch.setattr(Line, "silent_after_s", 0.3)
    live = run_live(graph_of(tmp_path, DOUBLING + f"  other: {{use: {ROOM}.OtherLine}}\n"))  # that one never speaks
    line_of(live).put(1)
    assert collector_of(live).take(1) == [2.0]
    said = "line: has said nothing for 0.3 s: is it powered, and its line plugged in?"
    wait_until(lambda: said in [str(incident) for incident in live.report().incidents])
    line_of(live).put(2)
    wait_until(lambda: "line: works again" in [str(incident) for incident in live.report().incidents])
    assert not [text for text in map(str, live.stop().incidents) if text.startswith("other")]


def wait_until(done):
    deadline_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline_s, "it was not said in time"
        time.sleep(0.05)


def test_a_record_that_cannot_be_decoded_costs_itself_only(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(1, "refuse", "nonsense", 2)
    assert collector_of(live).take(2) == [2.0, 4.0]
    report = live.stop()
    assert report.links["line"].undecoded == 2
    assert str(report.incidents[0]) == "line: no numbers here: is the counter plugged in?"
    assert "line.decode failed" in str(report.incidents[1])


def test_a_sink_that_fails_costs_the_message_only(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(6.5, 7)
    assert collector_of(live).take(1) == [14.0]
    report = live.stop()
    assert report.failures == {"collector": 1}
    assert [str(i) for i in report.incidents] == ["collector: thirteen is not sent: choose another number"]


def test_a_stage_that_raises_starts_afresh_and_the_rest_flies_on(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(1, 666, 3, 4)
    assert collector_of(live).take(3) == [2.0, 6.0, 8.0]
    report = live.stop()
    assert (report.restarts, report.off) == ({"brittle": 1}, [])
    assert report.counters["brittle"] == {"taken": 4}, "of both objects"
    (text,) = [str(i) for i in report.incidents]
    assert text.startswith("brittle: brittle.number failed at 0.000001 s: ArithmeticError: cannot bear 666")
    assert text.endswith("brittle starts afresh")


def test_a_fresh_stage_has_no_memory_and_a_skipping_one_keeps_it(tmp_path):
    taken = {}
    for on_error in ("restart", "skip"):
        memory = Memory()
        text = DOUBLING.replace("Brittle,", f"Brittle, on_error: {on_error},")
        live = run_live(graph_of(tmp_path, text), [memory])
        line_of(live).put(1, 2, 666, 3)
        collector_of(live).take(3)
        live.stop()
        taken[on_error] = [m.stamp_ns for name, _, m in memory._seen if name == "brittle.number"]
    assert taken == {"restart": [1, 2, 1], "skip": [1, 2, 4]}


def test_a_stage_that_keeps_raising_is_switched_off_and_the_rest_flies_on(tmp_path):
    text = DOUBLING.replace(
        "  brittle:", f"  sound: {{use: {ROOM}.Brittle, inputs: {{number: other.number}}}}\n  brittle:"
    )
    text += (
        f"  other: {{use: {ROOM}.OtherLine}}\n  second: {{use: {ROOM}.Collector, inputs: {{number: sound.number}}}}\n"
    )
    live = run_live(graph_of(tmp_path, text))
    line_of(live).put(1, *[666] * 6, 2)
    live.nodes["other"].put(5)
    assert live.nodes["second"].take(1) == [10.0]
    next(stage for stage in live._wiring.stages if stage.life.name == "brittle").ended.wait(PATIENCE_S)
    line_of(live).put(3, 4)
    live.nodes["other"].put(6)
    assert live.nodes["second"].take(1) == [12.0]
    assert live.running
    report = live.stop()
    assert report.off == ["brittle"]
    assert report.restarts == {"brittle": 5}
    assert collector_of(live).take(1) == [2.0]
    assert any("5 fresh starts in 60 s did not help: brittle stays off" in str(i) for i in report.incidents)


def test_a_link_learns_that_the_stage_behind_it_gave_up_and_what_it_did_is_said(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING))
    line_of(live).put(*[666] * 5)
    line_of(live).put(7)
    assert collector_of(live).take(1) == [14.0], "five fresh starts are no end"
    line_of(live).put(666)
    assert collector_of(live).take(1) == ["number"]
    report = live.stop()
    assert report.off == ["brittle"]
    assert "collector: 'brittle' works no more: it stands still" in [str(i) for i in report.incidents]


def test_a_stage_may_stop_the_run(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING.replace("Brittle,", "Brittle, on_error: stop,")))
    line_of(live).put(666)
    assert live._shared.stopping.wait(PATIENCE_S)
    assert not live.running
    assert live.stop().stopped_by == "brittle"


GATED = DOUBLING.replace("Brittle", "Gate").replace("brittle", "gate")


def gate_of(live):
    return live._wiring.stages[0].life._stage


@pytest.mark.parametrize(
    ("policy", "passed"),
    [
        ("{from: line.number, policy: latest}", [1.0, 9.0]),
        ("{from: line.number, policy: drop_oldest, depth: 3}", [1.0, 7.0, 8.0, 9.0]),
        ("{from: line.number, policy: block, depth: 3}", [float(n) for n in range(1, 10)]),
        ("line.number", [float(n) for n in range(1, 10)]),
    ],
)
def test_what_waits_for_a_slow_stage_is_what_its_edge_declares(tmp_path, policy, passed):
    memory = Memory()
    live = run_live(graph_of(tmp_path, GATED.replace("number: line.number", f"number: {policy}")), [memory])
    line_of(live).put(1)
    assert gate_of(live)._entered.wait(PATIENCE_S)
    line_of(live).put(*range(2, 10), "end")  # an end: the line says when all have been sent
    blocked = "block" in policy
    while not blocked and live.report().links["line"].state == "open":
        threading.Event().wait(0.01)
    gate_of(live)._open.set()
    assert collector_of(live).take(len(passed)) == passed
    report = live.stop()
    assert report.edges["gate.number"].dropped == report.dropped == 9 - len(passed)
    assert [m.value for name, _, m in memory._seen if name == "line.number"] == [float(n) for n in range(1, 10)]


def test_a_tap_that_hangs_stops_nobody_and_what_it_missed_is_counted(tmp_path):
    stuck = Stuck()
    live = run_live(graph_of(tmp_path, DOUBLING), [stuck])
    for _ in range(6):
        line_of(live).put(*range(500))
        assert collector_of(live).take(500) == [2.0 * n for n in range(500)]
    assert live.report().tap_drops["stuck"] >= 2 * (3000 - 1024 - 1024)  # outputs; waiting, in its hands
    stuck._go.set()
    live.stop()


def test_a_stop_comes_through_though_a_stage_and_a_tap_hang(tmp_path):
    stuck = Stuck()
    live = run_live(graph_of(tmp_path, GATED), [stuck])
    line_of(live).put(1, 2, 3)
    gate = gate_of(live)
    assert gate._entered.wait(PATIENCE_S)
    report = live.stop()
    texts = [str(incident) for incident in report.incidents]
    assert "run: the thread 'stage gate' did not end in time" in texts
    assert "run: the thread 'tap stuck' did not end in time" in texts
    gate._open.set()
    stuck._go.set()


ALL_HANG = f"""\
stages:
  gate: {{use: {ROOM}.Gate, inputs: {{number: line.number}}}}
  other_gate: {{use: {ROOM}.Gate, inputs: {{number: line.number}}}}
links:
  line: {{use: {ROOM}.Clinging}}
  jam: {{use: {ROOM}.Jam, inputs: {{number: line.number}}}}
"""


def test_a_stop_takes_less_than_two_seconds_though_links_stages_and_a_tap_hang(tmp_path):
    """All of each kind at once. The promise is of time: on a machine that is too busy for it, the best of three."""
    took_s = []
    while len(took_s) < 3 and min(took_s, default=2.0) >= 2.0:
        stuck = Stuck()
        live = run_live(graph_of(tmp_path, ALL_HANG), [stuck])
        jam = live.nodes["jam"]
        line_of(live).put(1, 2, 3)
        gates = [run.life._stage for run in live._wiring.stages]
        assert all(hanging._entered.wait(PATIENCE_S) for hanging in (*gates, jam))
        began_s = time.monotonic()
        report = live.stop()
        took_s.append(time.monotonic() - began_s)
        left = {str(i).split("'")[1] for i in report.incidents if "did not end in time" in str(i)}
        assert {"listen line", "close line", "stage gate", "stage other_gate", "send jam", "tap stuck"} <= left
        for event in (*(gate._open for gate in gates), jam._go, line_of(live)._go, stuck._go):
            event.set()
    assert min(took_s) < 2.0, took_s


def test_lateness_is_counted_against_each_edges_own_deadline(tmp_path):
    text = DOUBLING.replace("number: line.number", "number: {from: line.number, deadline_ms: 0.001}")
    graph = graph_of(tmp_path, text)
    live = run_live(graph)  # its clock says 2000 ns; arrivals are 1010, 1020, ...
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


def test_a_source_that_cannot_listen_stays_silent_and_is_named(tmp_path):
    live = run_live(graph_of(tmp_path, DOUBLING.replace(f"{ROOM}.Line", "tests.flow.toys.Numbers")))
    report = live.stop()
    assert [str(i) for i in report.incidents] == ["line: Numbers cannot run live: it stays silent"]


def test_a_failing_tap_is_said_and_costs_nothing_else(tmp_path):
    class Broken(Tap):
        def see(self, output, message, arrival_ns):
            raise OSError(28, "No space left on device")

    live = run_live(graph_of(tmp_path, DOUBLING), [Broken()])
    line_of(live).put(1, 2)
    assert collector_of(live).take(2) == [2.0, 4.0]
    texts = [str(i) for i in live.stop().incidents]
    assert any("No space left on device" in text for text in texts)


def test_two_runs_of_one_graph_share_nothing(tmp_path):
    graph = graph_of(tmp_path, DOUBLING)
    for _ in range(2):
        live = run_live(graph)
        line_of(live).put(5)
        assert collector_of(live).take(1) == [10.0]
        assert live.stop().records == 1
