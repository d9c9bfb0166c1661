"""Messages that were lost between two hosts are counted by the numbers that they carry."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from links.zenoh.peer_clock import PeerClock
from links.zenoh.receiver import Receiver, ReceiverSettings
from links.zenoh.wire import Envelope


@pytest.fixture
def receiver():
    return Receiver(ReceiverSettings.model_construct(topic="/zenoh/beats", sender="drone", session=None))


def hear(receiver, *numbers, run=1, key="beat"):
    connection = SimpleNamespace(clocks={"drone": PeerClock()})
    for number in numbers:
        data = SimpleNamespace(to_bytes=Envelope(run, number, 0, 0).pack)
        receiver._taken(connection, key, SimpleNamespace(attachment=data, payload=data))
    return receiver.counters["lost"]


def test_each_number_that_is_left_out_is_one_lost(receiver):
    assert hear(receiver, 5, 6, 7) == 0  # before the first one nobody was here to hear
    assert hear(receiver, 8, 11) == 2
    assert hear(receiver, 12, 20) == 2 + 7


def test_outputs_are_counted_each_for_itself(receiver):
    assert hear(receiver, 1, 2, key="beat") == 0
    assert hear(receiver, 50, 51, key="picture") == 0
    assert hear(receiver, 3, key="beat") == 0


def test_a_host_that_starts_anew_has_lost_nothing(receiver):
    assert hear(receiver, 100, 101) == 0
    assert hear(receiver, 200, 201, run=2) == 0
    assert hear(receiver, 204, run=2) == 2


def test_one_that_comes_twice_or_late_is_no_loss(receiver):
    assert hear(receiver, 3, 3, 2, 3) == 0
