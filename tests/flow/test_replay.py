"""The deterministic runner: order of events, hashes, taps, errors."""

from __future__ import annotations

import pytest

from flow.graph import load_graph
from flow.link import LinkError, Record, Tap
from flow.message import Message
from flow.ports import RunError
from flow.replay import replay
from flow.taps import Digest
from tests.flow.toys import GRAPH


class Log(Tap):
    """Keeps its messages."""

    def __init__(self) -> None:
        super().__init__()
        self.seen = []

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        self.seen.append((output, arrival_ns, message))


def graph_of(tmp_path, text=GRAPH):
    (tmp_path / "x.yaml").write_text(text)
    return load_graph(tmp_path / "x.yaml")


def numbers(*values, topic="/numbers"):
    return [Record(topic, 1000 + 10 * i, 500 + 10 * i, str(v).encode(), i) for i, v in enumerate(values)]


def test_producers_run_before_consumers_and_ports_in_their_order(tmp_path):
    log = Log()
    report = replay(graph_of(tmp_path), numbers(3), [log])
    assert [(name, getattr(m, "total", getattr(m, "value", None))) for name, _, m in log.seen] == [
        ("numbers.number", 3.0),
        ("double.number", 6.0),  # double ranks before add, though add.left was fed first
        ("add.sum", 3.0),
        ("add.sum", 9.0),
        ("add.text", None),
    ]
    assert report.messages == {"numbers.number": 1, "double.number": 1, "add.sum": 2, "add.text": 1}
    assert report.counters == {"double": {"doubled": 1}}


def test_a_message_keeps_its_stamp_and_the_tap_sees_the_arrival(tmp_path):
    log = Log()
    replay(graph_of(tmp_path), numbers(1, 2), [log])
    assert [(t, m.stamp_ns) for name, t, m in log.seen if name == "double.number"] == [(1000, 500), (1010, 510)]


def test_two_replays_have_one_hash_and_a_changed_bit_another(tmp_path):
    def digest(records):
        tap = Digest()
        replay(graph_of(tmp_path), records, [tap])
        return tap.hexdigest()

    records = numbers(*range(50))
    assert digest(records) == digest(records)
    assert digest(records) != digest(numbers(*range(49), 48.000000000000007))
    later = [*records[:-1], Record("/numbers", records[-1].arrival_ns + 1, records[-1].stamp_ns, b"49", 49)]
    assert digest(records) != digest(later)


def test_stages_start_empty_in_every_replay(tmp_path):
    graph = graph_of(tmp_path)
    for _ in range(2):
        log = Log()
        replay(graph, numbers(1), [log])
        assert log.seen[-1][2].words == "adder ends with 3.0"


def test_an_empty_record_gives_no_message_and_unknown_topics_are_counted(tmp_path):
    records = [Record("/numbers", 1, 1, b""), Record("/other", 2, 2, b"x"), Record("/other", 3, 3, b"x")]
    report = replay(graph_of(tmp_path), records)
    assert report.messages["numbers.number"] == 0
    assert report.unwired_topics == {"/other": 2}
    assert report.records == 3


def test_an_empty_recording_runs_to_its_end(tmp_path):
    log = Log()
    report = replay(graph_of(tmp_path), [], [log])
    assert (report.records, [m.words for _, _, m in log.seen]) == (0, ["adder ends with 0"])


def test_a_sink_is_not_called_in_a_replay(tmp_path):
    text = GRAPH + "  printer: {use: tests.flow.toys.Printer, inputs: {sum: add.sum}}\n"
    assert replay(graph_of(tmp_path, text), numbers(1)).messages["add.sum"] == 2


def test_a_stage_that_raises_is_named_with_port_and_time(tmp_path):
    text = GRAPH.replace("double.number\n", "double.number\n      words: words.text\n")
    graph = graph_of(tmp_path, text + "  words: {use: tests.flow.toys.Words}\n")
    with pytest.raises(RunError, match=r"add\.words failed at 0\.000001 s: ZeroDivisionError: on request") as caught:
        replay(graph, numbers("fail", topic="/words"))
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_a_links_own_error_reaches_the_user_as_it_is(tmp_path):
    with pytest.raises(LinkError, match=r"^no numbers here: is the counter plugged in\?$"):
        replay(graph_of(tmp_path), [Record("/numbers", 1, 1, b"refuse")])


def test_records_that_a_source_rejects_are_reported_and_the_replay_continues(tmp_path):
    report = replay(graph_of(tmp_path), numbers("refuse", 1, "refuse", "refuse", 2))
    assert report.messages["numbers.number"] == 2
    assert [str(i) for i in report.events] == ["numbers: no numbers here: is the counter plugged in? (3 times)"]


def test_a_source_that_rejects_all_records_ends_a_replay(tmp_path, monkeypatch):
    monkeypatch.setattr("flow.replay.MAX_REFUSALS", 3)
    taken = []
    with pytest.raises(LinkError, match="no numbers here"):
        replay(graph_of(tmp_path), (taken.append(r) or r for r in numbers(*["refuse"] * 9)))
    assert len(taken) == 3
    assert replay(graph_of(tmp_path), numbers(1, *["refuse"] * 9)).messages["numbers.number"] == 1


def test_a_tap_that_raises_ends_a_replay(tmp_path):
    class Broken(Tap):
        def see(self, output: str, message: Message, arrival_ns: int) -> None:
            raise LinkError("full")

    with pytest.raises(LinkError, match="full"):
        replay(graph_of(tmp_path), numbers(1, 2), [Broken()])


@pytest.mark.parametrize(
    ("stage", "text"),
    [
        ("WrongArray", r"double\.sum: Sum\.last: declared float32 \(n,\), got float64 \(2,\)"),
        ("Undeclared", r"double\.number gave a Text, which its annotation does not declare"),
    ],
)
def test_a_stage_with_undeclared_outputs_ends_the_replay(stage, text, tmp_path):
    graph = graph_of(tmp_path, GRAPH.split("  add:")[0].replace("Double", stage) + GRAPH[GRAPH.index("links:") :])
    with pytest.raises(RunError, match=text):
        replay(graph, numbers(1))


def test_compute_time_is_counted_per_node(tmp_path):
    report = replay(graph_of(tmp_path), numbers(1, 2, 3))
    assert report.nodes["add"].calls == 7  # left and right three times, finish once
    assert 0 < report.nodes["add"].compute.percentile_ns(50) <= report.nodes["add"].compute.max_ns
