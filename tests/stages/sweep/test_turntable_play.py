"""Gear play: the turntable lags by half of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import LidarMount
from stages.sweep.turntable import Turntable
from tests.stages.made import MS, START_NS, servo

HALF = math.radians(0.2)


def angles(mount, positions):
    table = Turntable(mount, 0.1, 0.6)
    for k, position in enumerate(positions):
        table.add(servo(START_NS + 10 * k * MS, position))
    return table.turns(START_NS + 10 * MS * np.arange(len(positions)))[:, 0]


def test_the_table_follows_half_the_play_behind_and_waits_at_a_turn_back():
    found = angles(LidarMount(servo_play_deg=0.4), [0.0, 0.1, 0.2, 0.2 - HALF, 0.1])
    assert found == pytest.approx([0.0, 0.1 - HALF, 0.2 - HALF, 0.2 - HALF, 0.1 + HALF])


def test_the_play_is_the_servos_whatever_the_sign():
    found = angles(LidarMount(servo_play_deg=0.4, servo_sign=-1), [0.0, 0.1, 0.0])
    assert found == pytest.approx([0.0, -0.1 + HALF, -HALF])


def test_no_play_is_the_position_itself_and_is_not_written():
    assert angles(LidarMount(), [0.0, 0.1, 0.05]) == pytest.approx([0.0, 0.1, 0.05])
    assert "servo_play_deg" not in LidarMount().model_dump()
    assert LidarMount(servo_play_deg=0.4).model_dump()["servo_play_deg"] == 0.4
