"""Colours of the viewer, packed as 0xRRGGBBAA: cold and dim for raw data, warm and bright for results.

Source: ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DRONE = 0xFFC83DFF  # the tracked drone
DRONE_TRANSLUCENT = 0xFFC83D80  # its ellipsoid and other entities that must not hide it
ACCEPTED = 0x4DE38AFF  # an accepted candidate
REJECTED = 0xE0707090  # a rejected candidate
CANDIDATE = 0xB58CFFFF  # an undecided candidate
COASTING = 0xFF9F43FF  # a drone without current returns, predicted
FAN = 0x5AA9FF60  # the plane of the LiDAR's beams
NEUTRAL = 0x9AA4B2FF
GOOD = 0x3FB871FF
BAD = 0xD9534FFF
VERTICAL = 0x64B5FFFF  # the vertical and the lines along it
UNASSIGNED = 0x9AA4B290  # a line without a direction
PAIRS = ((0xFF9F43FF, 0xFFD9A6FF), (0x3FD07AFF, 0xB4F2CBFF), (0xE86AD0FF, 0xF6BFEAFF), (0xF2E03AFF, 0xFAF3AEFF))
"""Horizontal pairs of directions, strongest first: one hue each, saturated for one direction, pale for the other."""
AXES = np.array([0xFF6B6BFF, 0x6BD66BFF, 0x6BA8FFFF], dtype=np.uint32)  # x, y, z, as in Rerun

LOG_ODDS_SPAN = 5.0  # log-odds of the ends of the colour ramp: 0.7 %, 99.3 %


def _ramp(stops_rgb: list[list[int]]) -> NDArray[np.uint32]:
    stops = np.array(stops_rgb, dtype=np.float64)
    at = np.linspace(0, len(stops) - 1, 256)
    rgb = np.stack([np.interp(at, np.arange(len(stops)), stops[:, c]) for c in range(3)], axis=1)
    r, g, b = rgb.round().astype(np.uint32).T
    return (r << 24) | (g << 16) | (b << 8) | np.uint32(255)


_HEIGHT_RAMP = _ramp([[38, 52, 92], [45, 98, 146], [72, 160, 180], [150, 208, 200], [225, 240, 235]])
_PROBABILITY_RAMP = _ramp([[224, 112, 112], [181, 140, 255], [77, 227, 138]])


def by_height(z_m: NDArray[np.float32], low_m: float = -2.0, high_m: float = 25.0) -> NDArray[np.uint32]:
    """Packed colour (n,) of heights (n,): dark blue at `low_m`, nearly white from `high_m`."""
    index = np.clip((z_m - low_m) / (high_m - low_m) * 255, 0, 255).astype(np.uint8)
    return _HEIGHT_RAMP[index]


def by_probability(probability: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Packed colour (n,) of probabilities (n,), linear in the log-odds: red at 0, violet at 0.5, green at 1."""
    clipped = np.clip(probability, 1e-9, 1 - 1e-9)
    log_odds = np.log(clipped / (1 - clipped))
    index = np.clip((log_odds + LOG_ODDS_SPAN) / (2 * LOG_ODDS_SPAN) * 255, 0, 255).astype(np.uint8)
    return _PROBABILITY_RAMP[index]
