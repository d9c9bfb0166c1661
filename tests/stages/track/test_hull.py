"""What one look says of the centre: the posterior against brute force, what misses do, and de-skew."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.kernels.track.hull import (
    CELLS,
    DELAY_S,
    DEPTH,
    FALSE_RETURN,
    KIND,
    LASER,
    OCCLUDED,
    PASS_THROUGH,
    RETURN,
    A,
    B,
    basis,
    collect,
    posterior,
)
from stages.track.hull import COLUMNS, across

S_M = 0.1
P_0 = 0.8


def scan_pass(hits=(), misses=(), nearer=()):
    """Pulses at offsets (a, b) [m]."""
    rows = []
    for kind, offsets in ((RETURN, hits), (PASS_THROUGH, misses), (OCCLUDED, nearer)):
        for a, b in offsets:
            row = np.zeros(COLUMNS)
            row[[A, B, KIND]] = a, b, kind
            rows.append(row)
    return np.array(rows).reshape(-1, COLUMNS)


def solve(pulses, prior_sigma_m=0.15, half_m=0.6, misses=True, middle=(0.0, 0.0), prior=None):
    prior = np.eye(2) * prior_sigma_m**2 if prior is None else prior
    mean, covariance = np.empty(2), np.empty((2, 2))
    evidence, expected = posterior(pulses, prior, *middle, half_m, P_0, S_M, misses, mean, covariance)
    return mean, covariance, evidence, expected


def brute_force(pulses, prior, half_m=1.2, cells=481, misses=True):
    """The module's formula on a grid twenty times finer, in plain numpy."""
    axis = np.linspace(-half_m, half_m, cells)
    a, b = np.meshgrid(axis, axis, indexing="ij")
    at = np.stack([a, b], axis=-1)
    log = -0.5 * np.einsum("ijk,kl,ijl->ij", at, np.linalg.inv(prior), at)
    nothing = 0.0
    for pulse in pulses:
        p = P_0 * np.exp(-((pulse[A] - a) ** 2 + (pulse[B] - b) ** 2) / (2 * S_M**2))
        if pulse[KIND] == RETURN:
            log += np.log(p + FALSE_RETURN)
            nothing += math.log(FALSE_RETURN)
        elif pulse[KIND] == PASS_THROUGH and misses:
            log += np.log(1 - p)
    w = np.exp(log - log.max())
    total = w.sum()
    mean = np.array([(w * a).sum(), (w * b).sum()]) / total
    da, db = a - mean[0], b - mean[1]
    covariance = (
        np.array([[(w * da * da).sum(), (w * da * db).sum()], [(w * da * db).sum(), (w * db * db).sum()]]) / total
    )
    cell = (axis[1] - axis[0]) ** 2
    density = total * cell / (2 * math.pi * math.sqrt(np.linalg.det(prior)))
    return mean, covariance, log.max() + math.log(density) - nothing


LOOKS = {
    "one hit": scan_pass(hits=[(0.1, 0.05)]),
    "a stroke with its ends": scan_pass(
        hits=[(-0.05, 0.1), (0.02, 0.1), (0.09, 0.1)], misses=[(-0.12, 0.1), (0.16, 0.1)]
    ),
    "misses only": scan_pass(misses=[(0.0, 0.0), (0.05, 0.0), (-0.05, 0.02)]),
    "two beams": scan_pass(
        hits=[(0.0, -0.1), (0.07, -0.1), (0.03, 0.12)], misses=[(0.1, 0.12), (-0.08, 0.12), (0.14, -0.1)]
    ),
}


@pytest.mark.parametrize("name", LOOKS)
@pytest.mark.parametrize(
    "prior", [np.eye(2) * 0.15**2, np.array([[0.04, 0.012], [0.012, 0.01]])], ids=["round", "long"]
)
def test_mean_covariance_and_evidence_are_those_of_a_finer_grid(name, prior):
    mean, covariance, evidence, _ = solve(LOOKS[name], prior=prior)
    fine_mean, fine_covariance, fine_evidence = brute_force(LOOKS[name], prior)
    step = 2 * 0.6 / (CELLS - 1)
    np.testing.assert_allclose(mean, fine_mean, atol=0.01)
    np.testing.assert_allclose(covariance, fine_covariance, atol=step**2)
    assert evidence == pytest.approx(fine_evidence, abs=0.1)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_when_nothing_was_measured_the_prior_stays():
    prior = np.array([[0.02, 0.005], [0.005, 0.01]])
    for pulses in (scan_pass(), scan_pass(nearer=[(0.0, 0.0), (0.1, 0.1)])):
        mean, covariance, evidence, expected = solve(pulses, prior=prior)
        np.testing.assert_allclose(mean, 0.0, atol=1e-9)
        np.testing.assert_allclose(covariance, prior, atol=2e-3)
        assert evidence == pytest.approx(0.0, abs=0.05)
        assert expected == 0.0


def test_misses_on_one_side_shift_the_estimate_away_from_them():
    hits = [(0.0, 0.0), (0.03, 0.0)]
    without, with_ = solve(scan_pass(hits=hits))[0], solve(scan_pass(hits=hits, misses=[(0.07, 0.0), (0.1, 0.0)]))[0]
    assert with_[0] < without[0] - 0.01
    assert abs(with_[1]) < 1e-6


def test_misses_at_both_ends_of_a_stroke_make_it_surer_along_it_and_without_them_hits_speak_alone():
    pulses = LOOKS["a stroke with its ends"]
    hits_only = pulses[pulses[:, KIND] == RETURN]
    mean, covariance, *_ = solve(pulses, misses=False)
    np.testing.assert_allclose(mean, solve(hits_only)[0])
    np.testing.assert_allclose(covariance, solve(hits_only)[1])
    assert solve(pulses)[1][A, A] < 0.9 * covariance[A, A]


def test_passing_through_the_middle_speaks_against_a_drone_and_hits_for_it():
    assert solve(LOOKS["misses only"], prior_sigma_m=0.05)[2] < -1.0
    assert solve(LOOKS["one hit"])[2] > 2.0
    assert solve(LOOKS["two beams"])[2] > solve(LOOKS["one hit"])[2] + 3.0


def test_the_expected_hits_are_those_of_the_mean():
    pulses = scan_pass(hits=[(0.0, 0.0)], misses=[(0.1, 0.0), (5.0, 0.0)], nearer=[(0.0, 0.0)])
    mean, _, _, expected = solve(pulses, prior_sigma_m=0.01, half_m=0.05)
    np.testing.assert_allclose(mean, 0.0, atol=5e-3)
    assert expected == pytest.approx(P_0 * (1 + math.exp(-0.5)), abs=0.03)


def test_turning_the_look_turns_the_answer():
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    pulses = LOOKS["two beams"]
    turned = pulses.copy()
    turned[:, :2] = pulses[:, :2] @ turn.T
    np.testing.assert_allclose(solve(turned)[0], turn @ solve(pulses)[0], atol=1e-9)
    np.testing.assert_allclose(solve(turned)[1], turn @ solve(pulses)[1] @ turn.T, atol=1e-9)


@pytest.mark.parametrize("line", [(1.0, 0, 0), (0, 0, 1.0), (0, 0, -1.0), (0.6, -0.48, 0.64)])
def test_the_two_ways_across_a_line_of_sight_are_level_and_square(line):
    ax, ay, bx, by, bz = basis(*line)
    R = np.array([line, (ax, ay, 0.0), (bx, by, bz)])
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


ORIGIN = np.array([0.0, 0.0, 0.35])
CENTRE = np.add(ORIGIN, [0.0, 15.0, 0.0])
LINE = np.array([0.0, 1.0, 0.0])
NO_MOTION = np.zeros(3)


def collected(positions, ranges, stamps_ns=None, velocity=NO_MOTION, gate_m=1.0, depth_m=0.6, room=64):
    """Pulses towards places (n, 3), of which a range may be given, or None: as far as the place."""
    away = np.asarray(positions, dtype=np.float64) - ORIGIN
    length = np.linalg.norm(away, axis=1)
    ranges = [length[i] if r is None else r for i, r in enumerate(ranges)]
    stamps = np.zeros(len(away), dtype=np.int64) if stamps_ns is None else np.asarray(stamps_ns, dtype=np.int64)
    found = np.full((room, COLUMNS), np.nan)
    direction = (away / length[:, np.newaxis]).astype(np.float32)
    n = collect(
        stamps,
        direction,
        np.array(ranges, dtype=np.float32),
        np.arange(len(ranges), dtype=np.uint8),
        ORIGIN,
        CENTRE,
        velocity,
        0,
        gate_m,
        depth_m,
        LINE,
        across(LINE),
        found,
    )
    return found[:n]


def test_each_pulse_is_measured_across_and_along_the_line_of_sight():
    ax, ay, *_ = basis(*LINE)
    level = np.array([ax, ay, 0.0])
    positions = [CENTRE + 0.3 * level, np.add(CENTRE, [0, 0, 0.2]), np.add(CENTRE, [0, 0.1, 0]), CENTRE + 0.4 * level]
    found = collected(positions, [None, None, None, 0.0])
    np.testing.assert_allclose(found[:, A], [0.3, 0, 0, 0.4], atol=1e-5)
    np.testing.assert_allclose(found[:, B], [0, 0.2, 0, 0], atol=1e-5)
    np.testing.assert_allclose(found[:3, DEPTH], [0, 0, 0.1], atol=1e-5)
    assert found[:, KIND].tolist() == [RETURN, RETURN, RETURN, PASS_THROUGH]
    assert found[3, DEPTH] == math.inf
    assert found[:, LASER].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("range_m", "kind"), [(0.0, PASS_THROUGH), (30.0, PASS_THROUGH), (15.5, RETURN), (14.5, RETURN), (15.7, PASS_THROUGH), (14.3, OCCLUDED)]
)
def test_a_return_counts_by_how_deep_it_lies(range_m, kind):
    assert collected([CENTRE], [range_m])[0, KIND] == kind


def test_pulses_beyond_reach_or_the_other_way_are_left_out_and_room_is_kept():
    assert (
        len(collected([np.add(CENTRE, [1.1, 0, 0]), 2 * ORIGIN - CENTRE, np.add(CENTRE, [0, 0, -0.9])], [0.0] * 3)) == 1
    )
    assert len(collected([CENTRE] * 10, [0.0] * 10, room=4)) == 4


def test_hits_on_a_flying_drone_fall_onto_its_centre_when_de_skewed():
    velocity = np.array([6.0, -3.0, 2.0])
    stamps_ns = np.linspace(-20e6, 20e6, 9).astype(np.int64)  # 0.24 m of flight
    positions = CENTRE + np.outer(stamps_ns * 1e-9, velocity)
    found = collected(positions, [None] * 9, stamps_ns, velocity)
    np.testing.assert_allclose(found[:, [A, B, DEPTH]], 0.0, atol=2e-3)
    np.testing.assert_allclose(found[:, DELAY_S], stamps_ns * 1e-9)
    smeared = collected(positions, [None] * 9, stamps_ns)
    assert np.ptp(smeared[:, A]) == pytest.approx(0.24, abs=0.01)
