"""Movers of a varied sky and the village, the second generator: speeds, extents, reproducibility."""

from __future__ import annotations

import functools
from collections import Counter

import numpy as np
import pytest

from links.simulated.matrix.flights import Cell
from links.simulated.matrix.matrix import Conditions, cells, scenario_of
from links.simulated.world.procedural import SceneSettings, build_world
from links.simulated.world.procedural.village import MANNERS, village_movers
from links.simulated.world.sky_movers import draw_sky

TIMES_S = np.arange(0.0, 20.0, 0.05)


def speeds_mps(mover):
    return np.linalg.norm(np.diff(mover.poses(TIMES_S)[1], axis=0), axis=1) / 0.05


@functools.cache
def skies(count=6):
    return [mover for seed in range(count) for mover in draw_sky(np.random.default_rng(seed), 8)]


def test_no_mover_is_faster_than_it_states():
    """The ray caster relies on the bound."""
    for mover in [*skies(), *village_movers(np.random.default_rng(1), 8)]:
        assert speeds_mps(mover).max() <= mover.speed_mps, mover.name


def test_a_varied_sky_has_birds_that_glide_straight_at_the_speeds_of_drones():
    birds = [m for m in skies() if m.name == "bird"]
    straight = [m for m in birds if len(m.path.waypoints) == 2]
    slow = [m for m in straight if 2.0 <= np.median(speeds_mps(m)) <= 8.0]
    assert len(slow) > 8
    assert any(len(m.meshes) == 1 for m in slow)  # without a wing beat
    assert min(np.median(speeds_mps(m)) for m in birds) < 1.0  # hovers


def test_a_varied_sky_has_other_kinds_than_birds():
    kinds = Counter(mover.name for mover in skies())
    assert set(kinds) == {"bird", "insect", "kite", "bag", "balloon"}


def test_shapes_are_indices_of_meshes():
    for mover in [*skies(2), *village_movers(np.random.default_rng(1), 8)]:
        shape = mover.shape(TIMES_S)
        assert shape.min() >= 0
        assert shape.max() < len(mover.meshes)


@pytest.mark.parametrize("settings", [SceneSettings(kind="village"), SceneSettings(kind="campus", sky="varied")])
def test_the_same_seed_gives_the_same_world(settings):
    one, again, other = (build_world(settings, 1.8, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.mesh.vertices_m, again.mesh.vertices_m)
    for a, b in zip(one.movers, again.movers, strict=True):
        np.testing.assert_array_equal(a.poses(TIMES_S)[1], b.poses(TIMES_S)[1])
    assert one.mesh.vertices_m.shape != other.mesh.vertices_m.shape


def test_the_village_keeps_the_vehicles_path_free_and_has_movers_of_every_manner():
    path = np.column_stack([np.linspace(0, 60, 40), np.zeros(40)])
    world = build_world(SceneSettings(kind="village"), 1.8, 5, path)
    v = world.mesh.vertices_m
    above_road = (np.abs(v[:, 1]) < 1.0) & (v[:, 0] > 0) & (v[:, 0] < 60) & (v[:, 2] > -1.5) & (v[:, 2] < 3.0)
    assert not above_road.any()
    assert {m.name for m in village_movers(np.random.default_rng(2), 40)} == set(MANNERS)


def test_village_cells_are_made_only_when_named():
    assert not any(cell.scene == "village" for cell in cells())
    assert len(cells(["village-*"])) == 24
    assert {cell.motion for cell in cells(["village-*"])} == {"wander", "hover", "empty"}


def test_a_wandering_drone_flies_at_the_cells_range_and_some_are_fast():
    tops = []
    for seed in range(1, 6):
        scenario = scenario_of(Cell("village", 20, "wander", "parked"), seed, Conditions(varied_sky=True))
        position, velocity, _, _ = scenario.drone.path.at(TIMES_S[TIMES_S < 12.0])
        assert 10 < np.linalg.norm(position - [0, 0, 0.35], axis=1).mean() < 32
        tops.append(np.linalg.norm(velocity, axis=1).max())
    assert max(tops) > 4
    assert max(tops) < 18


def test_a_sky_as_usual_leaves_scenario_files_as_they_were():
    scenario = scenario_of(Cell("campus", 20, "hover", "parked"), 1)
    assert "sky" not in scenario.as_yaml()
    assert "sky: varied" in scenario_of(Cell("campus", 20, "hover", "parked"), 1, Conditions(varied_sky=True)).as_yaml()
