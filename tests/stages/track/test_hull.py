"""The posterior of the centre against brute force, the effect of pass-throughs, and de-skew."""

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


def scan_pass(hits=(), pass_throughs=(), nearer=()):
    """Pulses at offsets (a, b) [m]."""
    rows = []
    for kind, offsets in ((RETURN, hits), (PASS_THROUGH, pass_throughs), (OCCLUDED, nearer)):
        for a, b in offsets:
            row = np.zeros(COLUMNS)
            row[[A, B, KIND]] = a, b, kind
            rows.append(row)
    return np.array(rows).reshape(-1, COLUMNS)


def solve(pulses, prior_sigma_m=0.15, half_m=0.6, pass_throughs=True, middle=(0.0, 0.0), prior=None):
    prior = np.eye(2) * prior_sigma_m**2 if prior is None else prior
    mean, covariance = np.empty(2), np.empty((2, 2))
    ratio, expected = posterior(pulses, prior, *middle, half_m, P_0, S_M, pass_throughs, mean, covariance)
    return mean, covariance, ratio, expected


def brute_force(pulses, prior, half_m=1.2, cells=481, pass_throughs=True):
    """The module's formula on a twenty times finer grid, in numpy."""
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
        elif pulse[KIND] == PASS_THROUGH and pass_throughs:
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


SCAN_PASSES = {
    "one return": scan_pass(hits=[(0.1, 0.05)]),
    "a chord with its ends": scan_pass(
        hits=[(-0.05, 0.1), (0.02, 0.1), (0.09, 0.1)], pass_throughs=[(-0.12, 0.1), (0.16, 0.1)]
    ),
    "pass-throughs only": scan_pass(pass_throughs=[(0.0, 0.0), (0.05, 0.0), (-0.05, 0.02)]),
    "two beams": scan_pass(
        hits=[(0.0, -0.1), (0.07, -0.1), (0.03, 0.12)], pass_throughs=[(0.1, 0.12), (-0.08, 0.12), (0.14, -0.1)]
    ),
}


@pytest.mark.parametrize("name", SCAN_PASSES)
@pytest.mark.parametrize(
    "prior", [np.eye(2) * 0.15**2, np.array([[0.04, 0.012], [0.012, 0.01]])], ids=["round", "long"]
)
def test_mean_covariance_and_likelihood_ratio_are_those_of_a_finer_grid(name, prior):
    mean, covariance, ratio, _ = solve(SCAN_PASSES[name], prior=prior)
    fine_mean, fine_covariance, fine_evidence = brute_force(SCAN_PASSES[name], prior)
    step = 2 * 0.6 / (CELLS - 1)
    np.testing.assert_allclose(mean, fine_mean, atol=0.01)
    np.testing.assert_allclose(covariance, fine_covariance, atol=step**2)
    assert ratio == pytest.approx(fine_evidence, abs=0.1)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_without_a_measurement_the_prior_stays():
    prior = np.array([[0.02, 0.005], [0.005, 0.01]])
    for pulses in (scan_pass(), scan_pass(nearer=[(0.0, 0.0), (0.1, 0.1)])):
        mean, covariance, ratio, expected = solve(pulses, prior=prior)
        np.testing.assert_allclose(mean, 0.0, atol=1e-9)
        np.testing.assert_allclose(covariance, prior, atol=2e-3)
        assert ratio == pytest.approx(0.0, abs=0.05)
        assert expected == 0.0


def test_pass_throughs_on_one_side_shift_the_estimate_away_from_them():
    hits = [(0.0, 0.0), (0.03, 0.0)]
    without, with_ = (
        solve(scan_pass(hits=hits))[0],
        solve(scan_pass(hits=hits, pass_throughs=[(0.07, 0.0), (0.1, 0.0)]))[0],
    )
    assert with_[0] < without[0] - 0.01
    assert abs(with_[1]) < 1e-6


def test_pass_throughs_at_both_ends_of_a_chord_reduce_the_covariance_along_it():
    pulses = SCAN_PASSES["a chord with its ends"]
    hits_only = pulses[pulses[:, KIND] == RETURN]
    mean, covariance, *_ = solve(pulses, pass_throughs=False)
    np.testing.assert_allclose(mean, solve(hits_only)[0])
    np.testing.assert_allclose(covariance, solve(hits_only)[1])
    assert solve(pulses)[1][A, A] < 0.9 * covariance[A, A]


def test_pass_throughs_are_evidence_against_a_drone_and_returns_for_it():
    assert solve(SCAN_PASSES["pass-throughs only"], prior_sigma_m=0.05)[2] < -1.0
    assert solve(SCAN_PASSES["one return"])[2] > 2.0
    assert solve(SCAN_PASSES["two beams"])[2] > solve(SCAN_PASSES["one return"])[2] + 3.0


def test_the_expected_returns_are_those_at_the_mean():
    pulses = scan_pass(hits=[(0.0, 0.0)], pass_throughs=[(0.1, 0.0), (5.0, 0.0)], nearer=[(0.0, 0.0)])
    mean, _, _, expected = solve(pulses, prior_sigma_m=0.01, half_m=0.05)
    np.testing.assert_allclose(mean, 0.0, atol=5e-3)
    assert expected == pytest.approx(P_0 * (1 + math.exp(-0.5)), abs=0.03)


def test_the_posterior_rotates_with_the_scan_pass():
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    pulses = SCAN_PASSES["two beams"]
    turned = pulses.copy()
    turned[:, :2] = pulses[:, :2] @ turn.T
    np.testing.assert_allclose(solve(turned)[0], turn @ solve(pulses)[0], atol=1e-9)
    np.testing.assert_allclose(solve(turned)[1], turn @ solve(pulses)[1] @ turn.T, atol=1e-9)


@pytest.mark.parametrize("line", [(1.0, 0, 0), (0, 0, 1.0), (0, 0, -1.0), (0.6, -0.48, 0.64)])
def test_the_axes_across_a_line_of_sight_are_horizontal_and_orthogonal(line):
    ax, ay, bx, by, bz = basis(*line)
    R = np.array([line, (ax, ay, 0.0), (bx, by, bz)])
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


ORIGIN = np.array([0.0, 0.0, 0.35])
CENTRE = np.add(ORIGIN, [0.0, 15.0, 0.0])
LINE = np.array([0.0, 1.0, 0.0])
NO_MOTION = np.zeros(3)


def collected(positions, ranges, stamps_ns=None, velocity=NO_MOTION, gate_m=1.0, depth_m=0.6, room=64):
    """Collected pulses towards positions (n, 3), each with a range; None: the distance of the position."""
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
    ("range_m", "kind"),
    [(0.0, PASS_THROUGH), (30.0, PASS_THROUGH), (15.5, RETURN), (14.5, RETURN), (15.7, PASS_THROUGH), (14.3, OCCLUDED)],
)
def test_the_kind_of_a_pulse_depends_on_its_depth(range_m, kind):
    assert collected([CENTRE], [range_m])[0, KIND] == kind


def test_pulses_beyond_the_gate_or_in_the_opposite_direction_are_omitted():
    assert (
        len(collected([np.add(CENTRE, [1.1, 0, 0]), 2 * ORIGIN - CENTRE, np.add(CENTRE, [0, 0, -0.9])], [0.0] * 3)) == 1
    )
    assert len(collected([CENTRE] * 10, [0.0] * 10, room=4)) == 4


def test_de_skewed_returns_of_a_flying_drone_lie_at_its_centre():
    velocity = np.array([6.0, -3.0, 2.0])
    stamps_ns = np.linspace(-20e6, 20e6, 9).astype(np.int64)  # 0.24 m of flight
    positions = CENTRE + np.outer(stamps_ns * 1e-9, velocity)
    found = collected(positions, [None] * 9, stamps_ns, velocity)
    np.testing.assert_allclose(found[:, [A, B, DEPTH]], 0.0, atol=2e-3)
    np.testing.assert_allclose(found[:, DELAY_S], stamps_ns * 1e-9)
    smeared = collected(positions, [None] * 9, stamps_ns)
    assert np.ptp(smeared[:, A]) == pytest.approx(0.24, abs=0.01)
