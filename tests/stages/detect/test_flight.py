"""Whether a candidate has moved, or a beam that follows it has walked along what stands."""

from __future__ import annotations

import numpy as np
import pytest

from stages.detect.flight import moves

TENTH_NS = 100_000_000
PLACE_M = np.array([-16.0, -22.9, 8.3])


def moved(displacement_m: float, range_m: float, looks: int = 14) -> bool:
    """By looks a tenth of a second apart, without a pause, over a way along y."""
    path_ns = [k * TENTH_NS for k in range(looks)]
    path_m = [PLACE_M - np.array([0.0, displacement_m * k / (looks - 1), 0.0]) for k in range(looks)]
    return moves(path_ns, path_m, range_m, True)


@pytest.mark.parametrize(("displacement_m", "range_m"), [(1.0, 29.5), (1.4, 40.0), (0.2, 10.0)])
def test_what_is_met_along_a_lamps_arm_has_not_moved(displacement_m, range_m):
    """A lamp 29.5 m away, its arm 1 m long, was taken for a drone that flies at 0.9 m/s."""
    assert not moved(displacement_m, range_m)


@pytest.mark.parametrize(("displacement_m", "range_m"), [(2.0, 29.5), (2.0, 40.0), (0.8, 10.0), (1.2, 19.0)])
def test_what_goes_farther_than_that_has(displacement_m, range_m):
    assert moved(displacement_m, range_m)
