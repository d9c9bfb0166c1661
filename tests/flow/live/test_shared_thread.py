"""Sources that share a thread with stages: as with a thread of their own, and one failure stops nothing else."""

from __future__ import annotations

import time

import pytest

from flow.config_error import ConfigError
from flow.live.report import LinkState
from flow.live.shared_thread import SharedThread
from tests.flow.live_toys import PATIENCE_S, Memory, Numbers, PolledLine, graph_of, run_live

TOYS = "tests.flow.live_toys"
SHARED = f"""\
stages:
  brittle: {{use: {TOYS}.Brittle, thread: one, inputs: {{number: line.number}}}}
  order: {{use: {TOYS}.Order, thread: one, inputs: {{left: brittle.number, right: other.number}}}}
links:
  line: {{use: {TOYS}.PolledLine, thread: one}}
  other: {{use: {TOYS}.PolledLine, thread: one, config: {{topic: /others}}}}
  collector: {{use: {TOYS}.Collector, inputs: {{number: order.number}}}}
"""


def threads_of(live) -> set[str]:
    return {thread.name for thread in live._wiring.stage_threads} | {t.name for t in live._wiring.source_threads}


def test_all_messages_of_two_sources_pass_two_stages_in_one_thread(tmp_path):
    memory = Memory()
    live = run_live(graph_of(tmp_path, SHARED), [memory])
    assert threads_of(live) == {"stage one"}
    live.nodes["line"].put(*range(100))
    live.nodes["other"].put(*range(50))
    live.nodes["collector"].take(150)
    report = live.stop()
    assert (report.records, report.dropped, report.events) == (150, 0, [])
    assert report.edges["order.left"].taken == 100
    assert report.edges["order.right"].taken == 50
    assert {link.state for link in report.links.values()} == {LinkState.CLOSED}
    assert len([r for r in memory._records if r.topic in ("/numbers", "/others")]) == 150


def test_a_source_that_fails_is_reopened_and_the_other_goes_on_meanwhile(tmp_path):
    live = run_live(graph_of(tmp_path, SHARED))
    for end in ("cut", "burn"):
        live.nodes["line"].put(1, end)
        live.nodes["collector"].take(1)
        deadline_s = time.monotonic() + PATIENCE_S
        while live.report().links["line"].state is not LinkState.FAILED and time.monotonic() < deadline_s:
            time.sleep(0.005)
        live.nodes["other"].put(2)
        live.nodes["collector"].take(1)
        assert live.report().links["line"].state is LinkState.FAILED
        live.nodes["line"].put(3)
        live.nodes["collector"].take(1)
    report = live.stop()
    texts = [str(event) for event in report.events]
    assert "line: the line is dead: is it plugged in?; it is reopened" in texts
    assert "line: line.listen failed: KeyError: 'smoke'; it is reopened" in texts
    assert (report.links["line"].openings, report.links["other"].openings) == (3, 1)


def test_a_source_that_waits_to_be_reopened_delays_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr("flow.live.source.FIRST_PAUSE_S", 3600.0)
    live = run_live(graph_of(tmp_path, SHARED))
    live.nodes["line"].put(1, "cut")
    live.nodes["collector"].take(1)
    live.nodes["other"].put(*range(20))
    assert len(live.nodes["collector"].take(20)) == 20
    report = live.stop()
    assert (report.links["line"].openings, report.links["line"].state) == (1, LinkState.CLOSED)


def test_a_source_that_a_blocked_stage_keeps_from_being_polled_is_reported_as_such(tmp_path, monkeypatch):
    monkeypatch.setattr(PolledLine, "silent_after_s", 0.3)
    monkeypatch.setattr("flow.live.live.STATUS_S", 0.05)
    live = run_live(graph_of(tmp_path, SHARED.replace("Brittle", "Gate")))
    live.nodes["line"].put(1)
    gate = next(run for run in live._wiring.stages if run.stage.name == "brittle").stage._stage
    assert gate._entered.wait(PATIENCE_S)
    text = "line: is not read for 0.3 s: a stage in its thread computes for too long"
    deadline_s = time.monotonic() + PATIENCE_S
    while text not in [str(event) for event in live.report().events] and time.monotonic() < deadline_s:
        time.sleep(0.02)
    gate._open.set()
    events = [str(event) for event in live.stop().events]
    assert text in events
    assert not [event for event in events if "cable" in event]


def test_an_error_of_the_thread_itself_is_reported_and_closes_its_sources(tmp_path, monkeypatch):
    monkeypatch.setattr(SharedThread, "_poll", lambda *_: (_ for _ in ()).throw(OSError("no more files")))
    live = run_live(graph_of(tmp_path, SHARED))
    report = live.stop()
    text = "stage one: stage one failed: OSError: no more files: none of its stages and sources works any more"
    assert text in [str(event) for event in report.events]
    assert report.links["line"].state is LinkState.CLOSED


def test_what_was_received_before_the_stop_is_processed(tmp_path):
    live = run_live(graph_of(tmp_path, SHARED))
    live.nodes["line"].put(*range(200))
    live.nodes["collector"].take(1)
    report = live.stop()
    assert report.edges["brittle.number"].taken == report.records >= 1
    assert report.dropped == 0


def test_messages_of_another_thread_and_the_end_of_the_run_wake_a_waiting_thread(tmp_path, monkeypatch):
    monkeypatch.setattr("flow.live.shared_thread.WAIT_S", 3600.0)
    monkeypatch.setattr(Numbers, "wait_s", 3600.0)
    text = SHARED.replace("PolledLine, thread: one, config", "Line, config")
    live = run_live(graph_of(tmp_path, text))
    assert threads_of(live) == {"stage one", "listen other"}
    live.nodes["line"].put(1)
    live.nodes["collector"].take(1)
    for number in range(50):
        live.nodes["other"].put(number)
        live.nodes["collector"].take(1)
    report = live.stop()
    assert (report.edges["order.right"].taken, report.dropped, report.events) == (50, 0, [])
    assert report.links["line"].state is LinkState.CLOSED


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("PolledLine, thread: one, config", "Line, thread: one, config", "Line needs a thread of its own"),
        ("Brittle, thread: one", "Brittle, thread: one, low_priority: true", "this source would pause with it"),
        ("PolledLine, thread: one}", "PolledLine, thread: 1}", "must be a name as stages have, got 1"),
    ],
)
def test_a_thread_that_a_source_cannot_share_is_a_configuration_error(tmp_path, old, new, text):
    with pytest.raises(ConfigError, match=text):
        graph_of(tmp_path, SHARED.replace(old, new))
