"""The rerun of a recorded live run: the same messages and hash, whatever the threads did."""

from __future__ import annotations

import dataclasses
import threading

import pytest

from flow.graph import load_graph
from flow.link import LinkError, Record
from flow.live import Live
from flow.live.input_order import END_TOPIC, ORDER_TOPIC, OrderLog, read_orders
from flow.live.rerun import Rerun
from flow.replay import replay
from flow.taps import Digest
from tests.flow.live_toys import Memory, graph_of, run_live

TOYS = "tests.flow.live_toys"
RACE = f"""\
stages:
  brittle: {{use: {TOYS}.Brittle, inputs: {{number: {{from: line.number, policy: drop_oldest, depth: 5}}}}}}
  order: {{use: {TOYS}.Order, inputs: {{left: brittle.number, right: other.number}}}}
  again: {{use: {TOYS}.Order, inputs: {{left: {{from: order.number, policy: latest}}, right: brittle.number}}}}
links:
  line: {{use: {TOYS}.Line}}
  other: {{use: {TOYS}.OtherLine}}
"""


def race(graph, seconds_of=300):
    """Two sources flood a graph of small queues: its report, its hash and all records in recorded order."""
    memory, digest = Memory(), Digest()
    live = run_live(graph, [memory], digest=digest)
    senders = [
        threading.Thread(target=live.nodes["line"].put, args=(*range(seconds_of), 666, "refuse", *range(50), 999)),
        threading.Thread(target=live.nodes["other"].put, args=range(seconds_of)),
    ]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    report = live.report
    while report().links["line"].records < seconds_of + 53 or report().links["other"].records < seconds_of:
        threading.Event().wait(0.01)
    return live.stop(), digest.hexdigest(), memory._records


def rerun_of(graph, records, **kwargs):
    orders = read_orders(r for r in records if r.topic == ORDER_TOPIC)
    digest = Digest()
    rerun = Rerun(graph, orders, [digest], **kwargs)
    numbered = (dataclasses.replace(record, sequence=i) for i, record in enumerate(records))
    for record in sorted(numbered, key=lambda r: (r.arrival_ns, r.sequence)):
        rerun.feed(record)
    return rerun, rerun.finish(), digest.hexdigest()


def test_the_rerun_of_a_live_run_has_its_hash_with_all_drops_and_restarts(tmp_path):
    graph = graph_of(tmp_path, RACE)
    report, digest, records = race(graph)
    rerun, second, same = rerun_of(graph, records)
    assert same == digest
    assert second.messages == report.messages
    assert rerun.left == {}
    assert second.counters["brittle"] == report.counters["brittle"]
    assert second.nodes["brittle"].calls == report.nodes["brittle"].calls
    live = {(i.node, i.text, i.count) for i in report.events}
    assert {(i.node, i.text, i.count) for i in rerun.events.all} == live
    assert ("line", "no numbers here: is the counter plugged in?", 1) in live


def test_the_rerun_of_stages_that_share_a_thread_has_the_hash_too(tmp_path):
    for shared in ("brittle order again", "brittle again", "order again"):
        text = RACE
        for name in shared.split():
            text = text.replace(f"  {name}: {{use", f"  {name}: {{thread: one, use")
        graph = graph_of(tmp_path, text)
        _, digest, records = race(graph, 100)
        assert "stage one" in [thread.name for thread in Live(graph)._wiring.stage_threads]
        assert rerun_of(graph, records)[2] == digest


def test_the_recording_ends_with_the_hash(tmp_path):
    _, digest, records = race(graph_of(tmp_path, RACE), 20)
    assert records[-1].topic == END_TOPIC
    assert records[-1].data == b'{"output_hash": "%s"}' % digest.encode()


def test_each_of_two_live_runs_with_different_orders_is_repeated(tmp_path):
    graph = graph_of(tmp_path, RACE)
    for _ in range(3):
        _, digest, records = race(graph, 100)
        assert rerun_of(graph, records)[2] == digest


def test_without_drops_and_races_a_live_run_has_the_hash_of_its_replay(tmp_path):
    text = f"stages:\n  b: {{use: {TOYS}.Brittle, inputs: {{number: line.number}}}}\nlinks: {{line: {{use: {TOYS}.Line}}}}\n"
    graph = graph_of(tmp_path, text)
    memory, digest, replayed = Memory(), Digest(), Digest()
    live = run_live(graph, [memory], digest=digest)
    live.nodes["line"].put(*range(50), "end")
    while live.report().links["line"].records < 50:
        threading.Event().wait(0.01)
    live.stop()
    report = replay(graph, memory._records, [replayed])
    assert replayed.hexdigest() == digest.hexdigest()
    assert not report.unwired_topics  # the run's own records belong to no source


def test_a_killed_run_is_repeated_up_to_the_end_of_its_recording(tmp_path):
    graph = graph_of(tmp_path, RACE)
    report, _, records = race(graph)
    cut = []
    for record in records:
        if record.topic == ORDER_TOPIC:
            head, _, numbers = record.data.partition(b"\n")
            cut.append(dataclasses.replace(record, data=head + b"\n" + numbers[:30]))
        elif record.topic != END_TOPIC:
            cut.append(record)
    _, second, _ = rerun_of(graph, cut)
    assert 0 < second.messages["order.number"] < report.messages["order.number"]
    assert second.nodes["order"].calls < report.nodes["order"].calls


def test_messages_that_a_recording_lacks_are_reported(tmp_path):
    graph = graph_of(tmp_path, RACE)
    _, digest, records = race(graph)
    lacking = [r for r in records if r.topic != "/others" or r.arrival_ns % 20]
    rerun, _, other = rerun_of(graph, lacking)
    assert other != digest
    assert rerun.left


def test_another_graph_cannot_repeat_a_run(tmp_path):
    graph = graph_of(tmp_path, RACE)
    _, _, records = race(graph, 20)
    fewer = RACE.replace(", right: brittle.number", "")
    (tmp_path / "fewer.yaml").write_text(
        fewer.replace(f"{TOYS}.Order, inputs: {{left: {{from", f"{TOYS}.Brittle, inputs: {{number: {{from")
    )
    with pytest.raises(LinkError, match=r"'again' took \['left', 'right'\], in this graph it takes \['number'\]"):
        rerun_of(load_graph(tmp_path / "fewer.yaml"), records)
    (tmp_path / "none.yaml").write_text(RACE.replace("  again:", "  renamed:"))
    with pytest.raises(LinkError, match="the live run had stages that this graph does not have: again"):
        rerun_of(load_graph(tmp_path / "none.yaml"), records)


def test_an_input_order_is_decoded_as_it_was_encoded():
    log = OrderLog("track", ["pulses", "detections"])
    assert log.take(5) is None
    for port, number in [(0, 0), (0, 1), (1, 3), (0, 500), (0, 501)]:
        log.add(port, number)
    first = log.take(7)
    log.add(1, 4)
    log.add_finish()
    second = log.take(9)
    assert (first.topic, first.arrival_ns, first.stamp_ns) == (ORDER_TOPIC, 7, 7)
    order = read_orders([first, second])["track"]
    assert order.count == 7
    assert list(order.steps()) == [
        ("pulses", 0),
        ("pulses", 0),
        ("detections", 3),
        ("pulses", 498),
        ("pulses", 0),
        ("detections", 0),
        ("finish", 0),
    ]
    assert len(first.data.split(b"\n", 1)[1]) == 6  # a byte each, two for the large gap


def test_numbers_that_no_run_writes_raise():
    head = b'{"stage": "track", "ports": ["pulses", "finish"], "first": 0}\n'
    order = read_orders([Record(ORDER_TOPIC, 5, 5, head + b"\xff" * 1000 + b"\x01")])["track"]
    with pytest.raises(LinkError, match="a stage's input order has a number that no run writes"):
        list(order.steps())


def test_orders_after_a_lost_record_are_ignored():
    log = OrderLog("track", ["pulses"])
    pieces = []
    for number in range(3):
        log.add(0, number)
        pieces.append(log.take(number))
    order = read_orders([pieces[0], pieces[2]])["track"]
    assert (order.count, order.cut_off) == (1, True)


@pytest.mark.parametrize(
    "data", [b"", b"{}\n", b"[1]\n\x00", b"\xff\xfe\n", b'{"stage": "a", "ports": 3, "first": 0}\n\x00']
)
def test_what_is_no_input_order_raises(data):
    with pytest.raises(LinkError, match=r"/run/order at 5 ns is no input order"):
        read_orders([Record(ORDER_TOPIC, 5, 5, data)])
