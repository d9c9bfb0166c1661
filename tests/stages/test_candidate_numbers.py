"""Candidate numbers: the looks at one never grow fewer, unless the detector was started afresh."""

from __future__ import annotations

import numpy as np

from stages.aim.targets import Targets
from stages.candidate_numbers import KEPT, CandidateNumbers
from stages.messages import Candidates

S = 1_000_000_000


def told(looks_by_number, t_s=0.0):
    n = len(looks_by_number)
    return Candidates(
        stamp_ns=round(t_s * S),
        candidate_id=np.array(list(looks_by_number), dtype=np.int64),
        xyz_vehicle_m=np.tile([0.0, 8.0, 10.0], (n, 1)),
        velocity_vehicle_mps=np.zeros((n, 3)),
        probability=np.full(n, 0.5),
        seen_ns=np.full(n, round(t_s * S)),
        looks=np.array(list(looks_by_number.values()), dtype=np.int64),
        reasons=("made",) * n,
    )


def test_fewer_looks_than_before_are_anothers_and_only_then():
    numbers = CandidateNumbers()
    heard = [{1: 3}, {1: 3, 2: 1}, {2: 5}, {}, {1: 4, 3: 1}, {1: 1}, {1: 2, 2: 1}]
    assert [numbers.hear(told(looks)) for looks in heard] == [False] * 5 + [True, False]


def test_memory_is_bounded():
    numbers = CandidateNumbers()
    assert not any(numbers.hear(told({k: 1})) for k in range(1, 2 * KEPT))
    assert len(numbers._looks) == KEPT


def test_a_new_candidate_is_not_left_alone_for_one_of_its_number_that_was():
    targets = Targets()
    targets.hear_candidates(told({1: 6}), 0.1)
    targets.leave(targets.known["candidate", 1], 0, rest_s=10.0)
    targets.hear_candidates(told({1: 7}, 1.0), 0.1)
    assert not targets.known
    targets.hear_candidates(told({1: 1}, 2.0), 0.1)
    assert list(targets.known) == [("candidate", 1)]
