"""Great-circle arcs: the fitted plane, its sigma, corners, and arcs that are one line."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_street import fisheye

from stages.vp.arcs import fit_arcs
from stages.vp.clustering import cluster
from stages.vp.edges import Chains
from stages.vp.pixel_rays import make_pixel_rays

LENS = fisheye(480)
EYE = make_pixel_rays(LENS, (480, 480), None, ())


def circle(normal, start_deg, stop_deg, count=None):
    """Rays along the great circle of a normal; angles from its highest point."""
    normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    x = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    count = count or round(abs(stop_deg - start_deg) * np.radians(1.0) / EYE.pixel_rad)
    angle = np.radians(np.linspace(start_deg, stop_deg, count))
    return np.outer(np.cos(angle), x) + np.outer(np.sin(angle), y)


def chains(*pieces, noise_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    points = [LENS.project(np.ascontiguousarray(p)) for p in pieces]
    points = [p + rng.normal(0, noise_px, p.shape) for p in points]
    return Chains(np.vstack(points).astype(np.float32), np.cumsum([0, *[len(p) for p in points]]))


def off_deg(a, b):
    return np.degrees(np.arccos(min(abs(float(np.dot(a, b))) / np.linalg.norm(a) / np.linalg.norm(b), 1.0)))


@pytest.mark.parametrize("normal", [(1, 0, 0), (0, 1, 0.2), (1, 1, 1), (0.3, -1, 2)])
def test_a_line_of_the_world_is_one_arc_even_beyond_90_deg_off_axis(normal):
    arcs = fit_arcs(chains(circle(normal, -20, 105)), EYE, 1.0, 14.0)
    assert len(arcs) == 1
    assert off_deg(arcs.normal[0], normal) < 0.01
    assert np.degrees(arcs.extent_rad[0]) == pytest.approx(125, abs=2)
    np.testing.assert_allclose(np.einsum("nej,nj->ne", arcs.ends, arcs.normal), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(arcs.ends, axis=2), 1)


def test_the_turn_of_a_short_arc_is_off_by_its_sigma():
    normal = np.array([1.0, 0.4, 0.3]) / np.linalg.norm([1.0, 0.4, 0.3])
    ratios = []
    for seed in range(200):
        arcs = fit_arcs(chains(circle(normal, 20, 35), noise_px=0.2, seed=seed), EYE, 1.0, 14.0)
        middle = arcs.ends[0].sum(axis=0)
        tangent = np.cross(arcs.normal[0], middle / np.linalg.norm(middle))
        turn = np.arcsin(float(tangent @ normal))
        ratios.append(turn / arcs.sigma_rad[0])
    assert 0.5 < np.std(ratios) < 1.2  # points of a real chain share their error, these do not


def test_a_corner_splits_a_chain_in_two():
    first = circle((1, 0, 0.5), -30, 0)
    corner = first[-1]
    other = np.cross(corner, [0.0, 1.0, 0.0])
    other /= np.linalg.norm(other)
    angle = np.radians(np.linspace(0, 30, 100))
    second = np.outer(np.cos(angle), corner) + np.outer(np.sin(angle), np.cross(other, corner))
    arcs = fit_arcs(chains(np.vstack([first, second[1:]])), EYE, 1.0, 14.0)
    assert len(arcs) == 2
    for normal in (other, (1, 0, 0.5)):
        assert min(off_deg(normal, found) for found in arcs.normal) < 0.1


def test_short_arcs_and_no_chains_give_nothing():
    assert len(fit_arcs(chains(circle((1, 0, 0), 0, 4)), EYE, 1.0, 14.0)) == 0
    none = Chains(np.empty((0, 2), dtype=np.float32), np.zeros(1, dtype=np.int64))
    arcs = fit_arcs(none, EYE, 1.0, 14.0)
    assert len(arcs) == 0
    assert len(cluster(arcs, EYE, 10)) == 0


def test_arcs_on_one_circle_are_one_line_and_others_are_not():
    normal = (1, 0.2, 0.1)
    pieces = [circle(normal, 0, 10), circle(normal, 14, 25), circle(normal, 60, 70), circle((1, 0.4, 0.1), 20, 30)]
    arcs = fit_arcs(chains(*pieces), EYE, 1.0, 14.0)
    lines = cluster(arcs, EYE, 10)
    assert len(arcs) == 4
    assert len(lines) == 3  # the third lies on the circle, too, but too far on
    extents = np.degrees(lines.extent_rad)
    assert extents[0] == pytest.approx(25, abs=3)
    assert (np.diff(extents) <= 0).all()
    assert lines.sigma_rad[0] < 0.5 * arcs.sigma_rad.min()
    assert len(cluster(arcs, EYE, 2)) == 2
