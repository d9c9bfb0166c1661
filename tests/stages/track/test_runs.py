"""Runs of returns longer than the drone's width are masked as walls."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.kernels.track.hull import DEPTH, GAP_RETURN, KIND, LASER, OCCLUDED, PASS_THROUGH, RETURN, A
from stages.kernels.track.runs import mask_walls
from stages.track.hull import COLUMNS

SPAN_M = 0.5


def scan_pass(depths, laser=0, spacing_m=0.07):
    """Consecutive pulses of one laser with these depths [m], inf without a return; RETURN within 0.6 m."""
    pulses = np.zeros((len(depths), COLUMNS))
    pulses[:, A] = spacing_m * (np.arange(len(depths)) - 0.5 * len(depths))
    pulses[:, DEPTH] = depths
    pulses[:, LASER] = laser
    pulses[:, KIND] = np.where(np.abs(depths) < 0.6, RETURN, PASS_THROUGH)
    return pulses


def hits(pulses):
    mask_walls(pulses, SPAN_M)
    return np.nonzero(pulses[:, KIND] == RETURN)[0].tolist()


def test_a_drone_in_front_of_the_sky_or_a_wall_keeps_its_returns():
    for behind_m in (math.inf, 3.0, 0.5):
        assert hits(scan_pass([behind_m] * 14 + [0.0, 0.05, -0.05, 0.1, 0.0] + [behind_m] * 14)) == [14, 15, 16, 17, 18]


def test_a_wall_at_the_drones_range_gives_no_information():
    pulses = scan_pass([0.0] * 20)
    assert hits(pulses) == []
    assert (pulses[:, KIND] == OCCLUDED).all()
    assert hits(scan_pass(np.linspace(-3.0, 3.0, 25))) == []  # also a slanted one


def test_an_object_that_touches_a_wall_is_part_of_it():
    assert hits(scan_pass([0.2] * 9 + [0.0] * 5 + [0.2] * 9)) == []


@pytest.mark.parametrize("hole", [2, 9])
def test_only_a_wide_hole_ends_a_run(hole):
    """A few missing returns do not end a run."""
    depths = [0.0] * 8 + [math.inf] * hole + [0.0] * 8
    assert (hits(scan_pass(depths)) == []) == (hole == 2)


def test_each_laser_has_its_own_runs():
    wall, drone = scan_pass([0.0] * 20, laser=3), scan_pass([math.inf] * 8 + [0.0] * 4 + [math.inf] * 8, laser=5)
    both = np.stack([wall, drone], axis=1).reshape(-1, COLUMNS)  # fired in turn
    mask_walls(both, SPAN_M)
    assert set(both[both[:, KIND] == RETURN][:, LASER]) == {5.0}
    assert (both[:, KIND] == RETURN).sum() == 4


@pytest.mark.parametrize(
    ("left_m", "right_m", "kind"),
    [(-5.0, -4.0, GAP_RETURN), (-5.0, 6.0, RETURN), (math.inf, -4.0, RETURN), (math.inf, math.inf, RETURN)],
)
def test_a_short_run_between_nearer_returns_is_a_gap_return_and_at_one_edge_a_return(left_m, right_m, kind):
    depths = [-5.0] * 6 + [left_m] + [0.3] * 3 + [right_m] + [-4.0] * 6
    pulses = scan_pass(depths)
    pulses[np.array(depths) < -0.6, KIND] = OCCLUDED
    mask_walls(pulses, SPAN_M)
    assert set(pulses[7:10, KIND]) == {kind}


def test_a_gap_return_may_have_a_hole_and_a_long_run_is_a_wall():
    for depths, kind in (
        ([-5.0, 0.1, 0.1, math.inf, 0.1, -5.0], GAP_RETURN),
        ([-5.0] + [0.1] * 20 + [-5.0], OCCLUDED),
    ):
        pulses = scan_pass(depths)
        pulses[[0, -1], KIND] = OCCLUDED
        mask_walls(pulses, SPAN_M)
        assert set(pulses[1:-1, KIND]) - {PASS_THROUGH} == {kind}


def test_no_pulses_are_accepted():
    mask_walls(np.empty((0, COLUMNS)), SPAN_M)
