"""Another host's time in ours: nothing before an answer, never more certain than the exchange allows."""

from __future__ import annotations

import random

from links.zenoh.peer_clock import MAX_UNCERTAINTY_NS, PeerClock

RUN, OTHER_RUN = 7, 8
OURS, THEIRS = 1_800_000_000_000_000_000, 1_700_000_000_000_000_000
MS = 1_000_000


def test_the_difference_is_the_middle_of_an_exchange_and_wrong_by_half_of_it():
    clock = PeerClock()
    clock.answered(RUN, OURS, THEIRS + 3 * MS, OURS + 10 * MS)
    assert clock.difference is not None
    assert clock.difference.offset_ns == OURS - THEIRS + 2 * MS
    assert clock.difference.uncertainty_ns == 5 * MS


def test_nothing_is_told_before_an_answer_or_of_another_run():
    clock = PeerClock()
    assert clock.heard(RUN, THEIRS, OURS) is None
    clock.answered(RUN, OURS, THEIRS, OURS + MS)
    assert clock.heard(RUN, THEIRS, OURS + MS) is not None
    assert clock.heard(OTHER_RUN, THEIRS, OURS + MS) is None


def test_a_host_that_started_anew_is_known_by_its_new_clock_alone():
    clock = PeerClock()
    clock.answered(RUN, OURS, THEIRS, OURS + MS)
    clock.answered(OTHER_RUN, OURS + 5 * MS, 1000, OURS + 6 * MS)
    assert clock.heard(RUN, THEIRS + 6 * MS, OURS + 7 * MS) is None
    difference = clock.heard(OTHER_RUN, 1000 + 2 * MS, OURS + 8 * MS)
    assert difference is not None
    assert abs(difference.offset_ns - (OURS + 5 * MS - 1000)) <= difference.uncertainty_ns
    assert clock.restarts == 1


def test_a_difference_that_is_known_too_badly_is_not_used():
    clock = PeerClock()
    late_ns = 2 * MAX_UNCERTAINTY_NS + 2 * MS
    clock.answered(RUN, OURS, THEIRS + late_ns // 2, OURS + late_ns)
    assert clock.difference is not None
    assert clock.heard(RUN, THEIRS + late_ns, OURS + 2 * late_ns) is None


def test_the_truth_stays_within_what_is_said_on_a_line_whose_delays_differ():
    """Clocks 50 ppm apart, 1 to 40 ms each way, for ten minutes; the answers stop after five: it is known less well."""
    random.seed(4)
    clock = PeerClock()
    said_ns = []
    for step in range(1200):
        ours_ns = OURS + step * 500 * MS
        theirs_ns = THEIRS + step * 500 * MS + round(step * 500 * MS * 50e-6)
        there_ns, back_ns = (round(random.uniform(1, 40) * MS) for _ in range(2))
        if step < 600:
            clock.answered(RUN, ours_ns, theirs_ns + there_ns, ours_ns + there_ns + back_ns)
        difference = clock.heard(RUN, theirs_ns, ours_ns + back_ns)
        if difference is not None:
            assert abs(difference.offset_ns - (ours_ns - theirs_ns)) <= difference.uncertainty_ns + 3000
            said_ns.append(difference.uncertainty_ns)
    assert len(said_ns) > 1150
    assert said_ns[600] < 4 * MS
    assert said_ns[-1] > 8 * MS
