"""MapNorth: a heading and a course grow old, and the more precise of both is used."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.cues.map_north import KEPT_NS, MapNorth
from tests.stages.made import START_NS

SECOND_NS = 1_000_000_000
DEG = math.radians(1.0)


def test_a_heading_grows_uncertain_by_the_drift_of_the_odometry_and_expires():
    north = MapNorth(0.3)
    north.add_heading(START_NS, 0.5, 0.2, DEG)
    assert north.yaw(START_NS) == pytest.approx((0.3, DEG))
    assert north.yaw(START_NS + 30 * SECOND_NS) == pytest.approx((0.3, math.hypot(DEG, 0.5 * DEG)))  # 1 deg a minute
    assert north.yaw(START_NS + KEPT_NS + 1) is None


def test_a_course_grows_uncertain_and_expires_and_a_newer_heading_takes_over():
    north = MapNorth(0.1)
    for x_m in (0.0, 20.0):
        north.add_position(START_NS, np.array([x_m, 0.0]), np.array([0.0, x_m]))
    yaw, sigma = north.yaw(START_NS) or (0.0, 0.0)
    assert yaw == pytest.approx(-math.pi / 2)
    assert (north.yaw(START_NS + 60 * SECOND_NS) or (0.0, 0.0))[1] == pytest.approx(math.hypot(sigma, DEG))
    assert north.yaw(START_NS + KEPT_NS + 1) is None
    north.add_heading(START_NS + KEPT_NS, 0.5, 0.2, 3.0 * DEG)
    assert north.yaw(START_NS + KEPT_NS + 1) == pytest.approx((0.3, 3.0 * DEG))
