"""What several stages ask of a slice's pulses."""

from __future__ import annotations

import numpy as np
import pytest

from stages.pulses import mean_direction


@pytest.mark.parametrize("n", [1, 3, 384])
def test_the_mean_direction_is_numpys_to_the_last_bit(n):
    direction = np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32)
    mean = mean_direction(direction)
    assert mean.dtype == np.float64
    np.testing.assert_array_equal(mean, direction.mean(axis=0).astype(np.float64))
