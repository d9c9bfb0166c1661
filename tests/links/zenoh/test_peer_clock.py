"""Clock offset of a peer: unknown before a reply, and within its uncertainty."""

from __future__ import annotations

import random

from links.zenoh.peer_clock import MAX_UNCERTAINTY_NS, PeerClock

RUN, OTHER_RUN = 7, 8
LOCAL_NS, PEER_NS = 1_800_000_000_000_000_000, 1_700_000_000_000_000_000
MS = 1_000_000


def test_offset_is_the_middle_of_the_exchange_with_half_of_it_as_uncertainty():
    clock = PeerClock()
    clock.on_reply(RUN, LOCAL_NS, PEER_NS + 3 * MS, LOCAL_NS + 10 * MS)
    assert clock.offset is not None
    assert clock.offset.offset_ns == LOCAL_NS - PEER_NS + 2 * MS
    assert clock.offset.uncertainty_ns == 5 * MS


def test_offset_is_unknown_before_a_reply_and_for_another_run():
    clock = PeerClock()
    assert clock.on_message(RUN, PEER_NS, LOCAL_NS) is None
    clock.on_reply(RUN, LOCAL_NS, PEER_NS, LOCAL_NS + MS)
    assert clock.on_message(RUN, PEER_NS, LOCAL_NS + MS) is not None
    assert clock.on_message(OTHER_RUN, PEER_NS, LOCAL_NS + MS) is None


def test_restarted_peer_has_a_new_offset():
    clock = PeerClock()
    clock.on_reply(RUN, LOCAL_NS, PEER_NS, LOCAL_NS + MS)
    clock.on_reply(OTHER_RUN, LOCAL_NS + 5 * MS, 1000, LOCAL_NS + 6 * MS)
    assert clock.on_message(RUN, PEER_NS + 6 * MS, LOCAL_NS + 7 * MS) is None
    offset = clock.on_message(OTHER_RUN, 1000 + 2 * MS, LOCAL_NS + 8 * MS)
    assert offset is not None
    assert abs(offset.offset_ns - (LOCAL_NS + 5 * MS - 1000)) <= offset.uncertainty_ns
    assert clock.restarts == 1


def test_offset_with_large_uncertainty_is_not_used():
    clock = PeerClock()
    late_ns = 2 * MAX_UNCERTAINTY_NS + 2 * MS
    clock.on_reply(RUN, LOCAL_NS, PEER_NS + late_ns // 2, LOCAL_NS + late_ns)
    assert clock.offset is not None
    assert clock.on_message(RUN, PEER_NS + late_ns, LOCAL_NS + 2 * late_ns) is None


def test_error_is_within_the_uncertainty_with_asymmetric_delays():
    """Ten minutes with 50 ppm of drift and 1 to 40 ms in each direction; replies stop after five minutes."""
    random.seed(4)
    clock = PeerClock()
    uncertainties_ns = []
    for step in range(1200):
        local_ns = LOCAL_NS + step * 500 * MS
        peer_ns = PEER_NS + step * 500 * MS + round(step * 500 * MS * 50e-6)
        there_ns, back_ns = (round(random.uniform(1, 40) * MS) for _ in range(2))
        if step < 600:
            clock.on_reply(RUN, local_ns, peer_ns + there_ns, local_ns + there_ns + back_ns)
        offset = clock.on_message(RUN, peer_ns, local_ns + back_ns)
        if offset is not None:
            assert abs(offset.offset_ns - (local_ns - peer_ns)) <= offset.uncertainty_ns + 3000
            uncertainties_ns.append(offset.uncertainty_ns)
    assert len(uncertainties_ns) > 1150
    assert uncertainties_ns[600] < 4 * MS
    assert uncertainties_ns[-1] > 8 * MS
