"""The output queue drops old messages by depth and deadline."""

from __future__ import annotations

import pytest
from example_nodes import Beat, Image
from hypothesis import given
from hypothesis import strategies as st

from links.zenoh import output_queue
from links.zenoh.envelope import Envelope, read_envelope
from links.zenoh.output_queue import OutputQueue


def beat(number):
    return Beat(stamp_ns=number, number=number, monotonic=0, earlier_ns=0)


@pytest.fixture
def clock(monkeypatch):
    now = [0]
    monkeypatch.setattr(output_queue, "now_ns", lambda: now[0])
    return now


def test_latest_keeps_one_message_and_counts_replaced_ones(clock):
    newest = OutputQueue("grd/a/b/c/d", Image, 1, 10**8)
    for number in range(5):
        newest.put(beat(number))
    assert newest._take().number == 4
    assert newest.counts.dropped == 4


def test_messages_beyond_the_deadline_are_dropped_except_the_newest(clock):
    queue = OutputQueue("grd/a/b/c/d", Beat, 100, 50)
    for number, at_ns in enumerate((0, 10, 60, 70)):
        clock[0] = at_ns
        queue.put(beat(number))
    clock[0] = 100
    assert [queue._take().number, queue._take().number] == [2, 3]
    assert (queue.counts.late, queue.counts.dropped) == (2, 0)
    queue.put(beat(9))
    clock[0] = 10_000
    assert queue._take().number == 9  # the newest is always sent


def test_messages_of_fixed_size_are_small():
    assert OutputQueue("k", Beat, 1, 1)._small
    assert not OutputQueue("k", Image, 1, 1)._small


@given(st.binary(max_size=64))
def test_only_bytes_of_the_envelope_size_are_an_envelope(data):
    read = read_envelope(data)
    assert (read is not None) == (len(data) == 32)
    assert read is None or read.pack() == data


def test_envelope_round_trip():
    assert read_envelope(Envelope(2**64 - 1, 3, -4, 5).pack()) == Envelope(2**64 - 1, 3, -4, 5)
    assert read_envelope(None) is None
