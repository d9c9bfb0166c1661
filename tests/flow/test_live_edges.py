"""How messages wait on an edge: what a configuration may say, its defaults, and the inbox that keeps to it."""

from __future__ import annotations

import threading

import pytest

from flow.edge import DEPTH, Waiting, usual_waiting
from flow.graph import load_graph
from flow.inbox import Inbox
from flow.problem import ConfigError
from stages.messages import DepthImage, Image, LidarFirings, SweptPulses, VanishingDirections
from tests.flow.live_toys import PATIENCE_S
from tests.flow.toys import GRAPH, Number

LEFT = "left: numbers.number"


def waiting_of(tmp_path, left: str) -> Waiting:
    (tmp_path / "x.yaml").write_text(GRAPH.replace(LEFT, f"left: {left}"))
    (edge,) = (e for e in load_graph(tmp_path / "x.yaml").edges if e.name == "add.left")
    return edge.waiting


@pytest.mark.parametrize(
    ("declared", "waiting"),
    [
        ("numbers.number", Waiting("drop_oldest", DEPTH, 100.0)),
        ("{from: numbers.number}", Waiting("drop_oldest", DEPTH, 100.0)),
        ("{from: numbers.number, policy: latest}", Waiting("latest", 1, 100.0)),
        ("{from: numbers.number, policy: drop_oldest, depth: 7}", Waiting("drop_oldest", 7, 100.0)),
        ("{from: numbers.number, depth: 64, deadline_ms: 20}", Waiting("drop_oldest", 64, 20.0)),
    ],
)
def test_an_edge_declares_how_messages_wait(tmp_path, declared, waiting):
    assert waiting_of(tmp_path, declared) == waiting


def test_only_the_newest_picture_waits_and_no_slice_of_the_lidar_is_lost_lightly():
    assert {usual_waiting(kind).policy for kind in (Image, DepthImage)} == {"latest"}
    for kind in (LidarFirings, SweptPulses, VanishingDirections):
        assert usual_waiting(kind) == Waiting("drop_oldest", DEPTH)
    assert DEPTH > 754 / 2  # half a second of packets


@pytest.mark.parametrize(
    ("declared", "problem"),
    [
        ("{policy: latest}", "x.yaml:9: stages.add.inputs.left: must say 'from: node.output', got None."),
        (
            "{from: numbers.number, policy: newest}",
            "x.yaml:9: stages.add.inputs.left.policy: must be 'latest' or 'drop_oldest', got 'newest'.",
        ),
        (
            "{from: numbers.number, policy: drop_oldst}",
            "x.yaml:9: stages.add.inputs.left.policy: must be 'latest' or 'drop_oldest', got 'drop_oldst'. "
            "Did you mean 'drop_oldest'?",
        ),
        (
            "{from: numbers.number, depht: 3}",
            "x.yaml:9: stages.add.inputs.left.depht: unknown key 'depht'; there is 'from', 'policy', 'depth' or "
            "'deadline_ms'. Did you mean 'depth'?",
        ),
        (
            "{from: numbers.number, policy: latest, depth: 3}",
            "x.yaml:9: stages.add.inputs.left.depth: 'latest' keeps one message: leave depth out, or take 'drop_oldest'.",
        ),
        (
            "{from: numbers.nmber}",
            "x.yaml:9: stages.add.inputs.left: 'numbers' has no output 'nmber'. Did you mean 'number'?",
        ),
        *[
            (
                f"{{from: numbers.number, depth: {depth}}}",
                f"x.yaml:9: stages.add.inputs.left.depth: must be a whole number from 1 to 100000, got {said}.",
            )
            for depth, said in [
                ("0", "0"),
                ("1.5", "1.5"),
                ("many", "'many'"),
                ("true", "True"),
                ("1000000", "1000000"),
            ]
        ],
        *[
            (
                f"{{from: numbers.number, deadline_ms: {ms}}}",
                f"x.yaml:9: stages.add.inputs.left.deadline_ms: must be a number above 0, up to 60000, got {said}.",
            )
            for ms, said in [("0", "0"), ("-1", "-1"), (".nan", "nan"), ("soon", "'soon'")]
        ],
    ],
)
def test_what_an_edge_cannot_say_is_an_error_at_its_place(tmp_path, declared, problem):
    (tmp_path / "x.yaml").write_text(GRAPH.replace(LEFT, f"left: {declared}"))
    with pytest.raises(ConfigError) as caught:
        load_graph(tmp_path / "x.yaml")
    assert [str(p).replace(f"{tmp_path}/", "") for p in caught.value.problems] == [problem]


def test_a_thread_has_a_name_as_stages_have(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH.replace("  double:\n", "  double:\n    thread: No 1\n"))
    with pytest.raises(
        ConfigError, match=r"x\.yaml:3: stages\.double\.thread: must be a name as stages have, got 'No 1'"
    ):
        load_graph(tmp_path / "x.yaml")


def test_an_optional_input_that_an_included_file_wires_can_be_unwired(tmp_path):
    (tmp_path / "below.yaml").write_text(
        GRAPH.replace(LEFT, f"{LEFT}\n      words: words.text") + "  words: {use: tests.flow.toys.Words}\n"
    )
    (tmp_path / "x.yaml").write_text("include: below.yaml\nstages: {add: {inputs: {words: null}}}\n")
    assert "add.words" not in [edge.name for edge in load_graph(tmp_path / "x.yaml").edges]


def number(value: float) -> Number:
    return Number(stamp_ns=0, value=value)


def taken(inbox: Inbox) -> list[tuple[int, float]]:
    found = []
    while (item := inbox.take()) is not None:
        found.append((item.port, item.message.value))
    return found


def awaited(inbox: Inbox):
    while (item := inbox.take()) is None:
        inbox.bell.wait([inbox], PATIENCE_S)
    return item


def test_messages_are_taken_in_the_order_of_putting_over_all_ports():
    inbox = Inbox([Waiting("drop_oldest", 10), Waiting("drop_oldest", 10)])
    for port, value in [(0, 1), (1, 2), (1, 3), (0, 4)]:
        inbox.put(port, value, 0, number(value))
    assert taken(inbox) == [(0, 1), (1, 2), (1, 3), (0, 4)]
    inbox.put(1, 5, 0, number(5))
    inbox.put(0, 6, 0, number(6))
    assert [item.message.value for item in inbox.take_all()] == [5, 6]


def test_a_flood_on_one_port_drops_nothing_of_another():
    inbox = Inbox([Waiting("drop_oldest", 3), Waiting("latest", 1)])
    inbox.put(1, 0, 0, number(-1))
    for value in range(10):
        inbox.put(0, value, 0, number(value))
    assert taken(inbox) == [(1, -1), (0, 7), (0, 8), (0, 9)]
    assert inbox.dropped == [7, 0]


def test_who_takes_waits_for_a_message_or_the_end():
    inbox = Inbox([Waiting("drop_oldest", 2)])
    found, ended = [], threading.Event()

    def take():
        found.append(awaited(inbox))
        inbox.bell.wait([inbox], PATIENCE_S)
        found.append(inbox.take())
        ended.set()

    threading.Thread(target=take, daemon=True).start()
    inbox.put(0, 0, 7, number(1))
    while not found:
        threading.Event().wait(0.001)
    inbox.close()
    assert ended.wait(PATIENCE_S)
    assert (found[0].arrival_ns, found[1]) == (7, None)
    assert inbox.done


def test_what_is_cleared_counts_as_dropped():
    inbox = Inbox([Waiting("drop_oldest", 5)])
    for value in range(3):
        inbox.put(0, value, 0, number(value))
    inbox.clear()
    assert (inbox.take(), inbox.dropped, inbox.waiting(0)) == (None, [3], 0)
