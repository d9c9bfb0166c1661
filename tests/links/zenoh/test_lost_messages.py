"""Lost messages between two hosts are counted by their numbers."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from links.zenoh.envelope import Envelope
from links.zenoh.peer_clock import PeerClock
from links.zenoh.receiver import Receiver, ReceiverSettings


@pytest.fixture
def receiver():
    return Receiver(ReceiverSettings.model_construct(topic="/zenoh/beats", sender="drone", session=None))


def receive(receiver, *numbers, run=1, key="beat"):
    connection = SimpleNamespace(clocks={"drone": PeerClock()})
    for number in numbers:
        data = SimpleNamespace(to_bytes=Envelope(run, number, 0, 0).pack)
        receiver._record(connection, key, SimpleNamespace(attachment=data, payload=data))
    return receiver.counters["lost"]


def test_gap_in_numbers_is_counted_as_lost(receiver):
    assert receive(receiver, 5, 6, 7) == 0  # messages before the first one were not expected
    assert receive(receiver, 8, 11) == 2
    assert receive(receiver, 12, 20) == 2 + 7


def test_each_output_has_its_own_numbers(receiver):
    assert receive(receiver, 1, 2, key="beat") == 0
    assert receive(receiver, 50, 51, key="image") == 0
    assert receive(receiver, 3, key="beat") == 0


def test_restart_of_the_peer_is_no_loss(receiver):
    assert receive(receiver, 100, 101) == 0
    assert receive(receiver, 200, 201, run=2) == 0
    assert receive(receiver, 204, run=2) == 2


def test_repeated_or_late_message_is_no_loss(receiver):
    assert receive(receiver, 3, 3, 2, 3) == 0
