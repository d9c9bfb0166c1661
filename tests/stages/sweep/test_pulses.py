"""What several stages ask of a slice's pulses."""

from __future__ import annotations

import numpy as np
import pytest

from stages.kernels.sweep.pulses import cone_of
from tests.stages.caster import SIDEWAYS, dithering, pulses_seen, together
from tests.stages.made import PACKET_NS, START_NS


@pytest.mark.parametrize("n", [1, 3, 384])
def test_the_cone_around_directions_just_includes_them_all(n):
    direction = np.random.default_rng(n).normal(size=(n, 3)) * 0.3 + (1.0, 2.0, -1.0)
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    axis, half_rad = cone_of(direction)
    mean = direction.astype(np.float64).mean(axis=0)
    np.testing.assert_allclose(axis, mean / np.linalg.norm(mean), atol=1e-12)
    assert half_rad == pytest.approx(np.arccos(np.clip(direction @ axis, -1, 1)).max(), abs=1e-3)


def test_the_cone_around_opposite_directions_includes_everything():
    axis, half_rad = cone_of(np.array([[1, 0, 0], [-1, 0, 0]], dtype=np.float32))
    assert (axis.tolist(), half_rad) == ([0.0, 0.0, 0.0], np.pi)


@pytest.mark.parametrize("packets", [1, 2, 4])
def test_the_middle_of_a_slice_is_half_its_time_from_its_start(packets):
    first = next(together(pulses_seen([], dithering(SIDEWAYS), 0.02), packets))
    assert first.middle_ns == pytest.approx(START_NS + packets * PACKET_NS / 2, abs=PACKET_NS / 20)
