"""Stages of low priority: they pause while other queues overflow, and no longer."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from flow.config.edge import QueueSettings
from flow.config_error import ConfigError
from flow.graph import load_graph
from flow.live.backpressure import FIRST_PAUSE_S, MAX_PAUSE_S, MonitoredQueue, Throttle
from flow.live.inbox import Inbox
from flow.stage import Stage
from stages.messages import Image
from tests.flow.live_toys import PATIENCE_S, Memory, graph_of, run_live
from tests.flow.toys import Number

ROOT = Path(__file__).resolve().parents[3]
IMAGE_STAGES = ("vp_vehicle", "vp_drone", "ego", "drone_odometry")
DEPTH = 8
LIVE = f"""\
stages:
  gate:
    use: tests.flow.live.test_backpressure.Slow
    inputs: {{number: {{from: line.number, depth: {DEPTH}}}}}
  images:
    use: tests.flow.toys.Double
    inputs: {{number: {{from: others.number, policy: latest}}}}
    low_priority: true
links:
  line: {{use: tests.flow.live_toys.Line}}
  others: {{use: tests.flow.live_toys.OtherLine}}
"""


class Slow(Stage):
    """Cannot keep up."""

    def on_number(self, number: Number) -> None:
        del number
        time.sleep(0.4)


def numbers(inbox: Inbox, count: int) -> None:
    for i in range(count):
        inbox.put(0, i, 0, Number(stamp_ns=i, value=float(i)))


@pytest.fixture
def inbox() -> Inbox:
    return Inbox([QueueSettings("drop_oldest", DEPTH)])


def test_pauses_grow_while_a_queue_is_half_full_and_then_shrink_to_none(inbox):
    throttle = Throttle([MonitoredQueue("gate.number", inbox, 0, DEPTH)])
    assert (throttle.next_pause_s(), throttle.overloaded()) == (0.0, None)
    numbers(inbox, DEPTH // 2)
    assert throttle.overloaded() == "gate.number"
    assert [throttle.next_pause_s() for _ in range(5)] == [
        FIRST_PAUSE_S,
        2 * FIRST_PAUSE_S,
        4 * FIRST_PAUSE_S,
        MAX_PAUSE_S,
        MAX_PAUSE_S,
    ]
    inbox.take_all()
    pauses = [throttle.next_pause_s() for _ in range(12)]
    assert pauses == sorted(pauses, reverse=True)
    assert pauses[0] < MAX_PAUSE_S
    assert pauses[-1] == 0.0


def test_messages_dropped_between_two_images_cause_a_pause_although_the_queue_is_empty(inbox):
    throttle = Throttle([MonitoredQueue("gate.number", inbox, 0, DEPTH)])
    throttle.next_pause_s()
    numbers(inbox, DEPTH + 1)
    inbox.take_all()
    assert throttle.next_pause_s() == FIRST_PAUSE_S
    assert throttle.next_pause_s() < FIRST_PAUSE_S  # it is not counted twice


def run_overloaded(tmp_path) -> tuple[int, list[str]]:
    """Of 40 images, one each 20 ms, the number that the stage took while another queue was full; and all events."""
    memory = Memory()
    live = run_live(graph_of(tmp_path, LIVE), [memory])
    try:
        live.nodes["line"].put(*range(3 * DEPTH))
        until = time.monotonic() + PATIENCE_S
        while live.report().edges["gate.number"].dropped == 0:
            assert time.monotonic() < until
            time.sleep(0.005)
        for i in range(40):
            live.nodes["others"].put(i)
            time.sleep(0.02)
        taken = live.report().edges["images.number"].taken
        return taken, [str(event) for event in live.report().events]
    finally:
        live.stop()


def test_it_takes_fewer_images_while_another_stage_loses_messages_and_that_is_reported(tmp_path):
    taken, events = run_overloaded(tmp_path)
    assert 1 <= taken < 12
    assert any("images: takes fewer images: this host is too slow for all stages" in text for text in events)


def test_a_configuration_declares_low_priority(tmp_path):
    assert {spec.name for spec in graph_of(tmp_path, LIVE).nodes.values() if spec.low_priority} == {"images"}
    (tmp_path / "x.yaml").write_text(LIVE.replace("low_priority: true", "low_priority: 3\n    thread: gate"))
    with pytest.raises(ConfigError, match=r"x.yaml:8: stages.images.low_priority: must be true or false, got 3\."):
        load_graph(tmp_path / "x.yaml")
    (tmp_path / "x.yaml").write_text(LIVE.replace("low_priority: true", "low_priority: true\n    thread: gate"))
    with pytest.raises(ConfigError, match="'images' has low_priority and the same thread, 'gate': both would pause"):
        load_graph(tmp_path / "x.yaml")


def test_in_field_yaml_exactly_the_stages_of_images_have_low_priority():
    graph = load_graph(ROOT / "configs" / "field.yaml")
    images = {edge.consumer for edge in graph.edges if edge.message is Image and edge.consumer in graph.nodes}
    stages = {name for name in images if graph.nodes[name].kind == "stages"}
    assert {spec.name for spec in graph.nodes.values() if spec.low_priority} == stages == set(IMAGE_STAGES)
