"""What several stages ask of a slice's pulses."""

from __future__ import annotations

import numpy as np
import pytest

from stages.kernels.sweep.pulses import mean_direction
from tests.stages.caster import SIDEWAYS, dithering, pulses_seen, together
from tests.stages.made import PACKET_NS, START_NS


@pytest.mark.parametrize("n", [1, 3, 384])
def test_the_mean_direction_is_numpys_to_the_last_bit(n):
    direction = np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32)
    mean = mean_direction(direction)
    assert mean.dtype == np.float64
    np.testing.assert_array_equal(mean, direction.mean(axis=0).astype(np.float64))


@pytest.mark.parametrize("packets", [1, 2, 4])
def test_the_middle_of_a_slice_is_half_its_time_from_its_start(packets):
    first = next(together(pulses_seen([], dithering(SIDEWAYS), 0.02), packets))
    assert first.middle_ns == pytest.approx(START_NS + packets * PACKET_NS / 2, abs=PACKET_NS / 20)
