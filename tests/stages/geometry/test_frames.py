"""Angles and rotations of the frame table."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import heading_rad, rotation_z
from stages.kernels.geometry.so3 import exp_rotation


@pytest.mark.parametrize("yaw", [-3.0, 0.0, 2.5])
def test_the_heading_of_a_nearly_level_rotation(yaw):
    assert math.remainder(heading_rad(rotation_z(yaw)) - yaw, 2 * math.pi) == pytest.approx(0, abs=1e-12)
    tilted = rotation_z(yaw) @ exp_rotation(np.array([0.02, -0.03, 0.0]))
    assert math.remainder(heading_rad(tilted) - yaw, 2 * math.pi) == pytest.approx(0, abs=0.002)
