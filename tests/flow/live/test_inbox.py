"""An inbox: order, bounds, waiting and closing."""

from __future__ import annotations

import threading

from flow.config.edge import QueueSettings
from flow.live.inbox import Inbox
from tests.flow.live_toys import PATIENCE_S
from tests.flow.toys import Number


def number(value: float) -> Number:
    return Number(stamp_ns=0, value=value)


def taken(inbox: Inbox) -> list[tuple[int, float]]:
    found = []
    while (item := inbox.take()) is not None:
        found.append((item.port, item.message.value))
    return found


def awaited(inbox: Inbox):
    while (item := inbox.take()) is None:
        inbox.wakeup.wait([inbox], PATIENCE_S)
    return item


def test_messages_are_taken_in_the_order_of_putting_over_all_ports():
    inbox = Inbox([QueueSettings("drop_oldest", 10), QueueSettings("drop_oldest", 10)])
    for port, value in [(0, 1), (1, 2), (1, 3), (0, 4)]:
        inbox.put(port, value, 0, number(value))
    assert taken(inbox) == [(0, 1), (1, 2), (1, 3), (0, 4)]
    inbox.put(1, 5, 0, number(5))
    inbox.put(0, 6, 0, number(6))
    assert [item.message.value for item in inbox.take_all()] == [5, 6]


def test_a_flood_on_one_port_drops_nothing_of_another():
    inbox = Inbox([QueueSettings("drop_oldest", 3), QueueSettings("latest", 1)])
    inbox.put(1, 0, 0, number(-1))
    for value in range(10):
        inbox.put(0, value, 0, number(value))
    assert taken(inbox) == [(1, -1), (0, 7), (0, 8), (0, 9)]
    assert inbox.dropped == [7, 0]


def test_a_taker_waits_for_a_message_or_the_end():
    inbox = Inbox([QueueSettings("drop_oldest", 2)])
    found, ended = [], threading.Event()

    def take():
        found.append(awaited(inbox))
        inbox.wakeup.wait([inbox], PATIENCE_S)
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


def test_cleared_messages_count_as_dropped():
    inbox = Inbox([QueueSettings("drop_oldest", 5)])
    for value in range(3):
        inbox.put(0, value, 0, number(value))
    inbox.clear()
    assert (inbox.take(), inbox.dropped, inbox.waiting(0)) == (None, [3], 0)
