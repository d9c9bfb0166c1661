"""What waits for a line: the newest, within its bound and its time."""

from __future__ import annotations

import pytest
from crossing_toys import Beat, Picture
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


def test_the_newest_only_waits_and_what_it_replaced_is_counted(clock):
    newest = OutputQueue("grd/a/b/c/d", Picture, 1, 10**8)
    for number in range(5):
        newest.put(beat(number))
    assert newest._take().number == 4
    assert newest.counts.dropped == 4


def test_what_waited_longer_than_its_deadline_is_dropped_but_never_the_newest(clock):
    queue = OutputQueue("grd/a/b/c/d", Beat, 100, 50)
    for number, at_ns in enumerate((0, 10, 60, 70)):
        clock[0] = at_ns
        queue.put(beat(number))
    clock[0] = 100
    assert [queue._take().number, queue._take().number] == [2, 3]
    assert (queue.counts.late, queue.counts.dropped) == (2, 0)
    queue.put(beat(9))
    clock[0] = 10_000
    assert queue._take().number == 9  # told once, when it changed: it is still so


def test_messages_of_a_fixed_size_overtake_the_others():
    assert OutputQueue("k", Beat, 1, 1)._small
    assert not OutputQueue("k", Picture, 1, 1)._small


@given(st.binary(max_size=64))
def test_an_envelope_is_of_its_size_or_none(data):
    read = read_envelope(data)
    assert (read is not None) == (len(data) == 32)
    assert read is None or read.pack() == data


def test_an_envelope_comes_back():
    assert read_envelope(Envelope(2**64 - 1, 3, -4, 5).pack()) == Envelope(2**64 - 1, 3, -4, 5)
    assert read_envelope(None) is None
