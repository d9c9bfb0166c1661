"""Colours of the viewer, packed as Rerun wants them (0xRRGGBBAA): scenery is cold and dim, answers are warm and bright.

Source: ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DRONE = 0xFFC83DFF  # the tracked drone
DRONE_VEIL = 0xFFC83D80  # what belongs to it and must not hide it
ACCEPTED = 0x4DE38AFF  # a candidate taken for a drone
REFUSED = 0xE0707090  # a candidate refused
FAN = 0x5AA9FF60  # where the LiDAR looks now
NEUTRAL = 0x9AA4B2FF
GOOD = 0x3FB871FF
BAD = 0xD9534FFF
AXES = np.array([0xFF6B6BFF, 0x6BD66BFF, 0x6BA8FFFF], dtype=np.uint32)  # x, y, z as everywhere in Rerun

_STOPS_RGB = np.array([[38, 52, 92], [45, 98, 146], [72, 160, 180], [150, 208, 200], [225, 240, 235]], dtype=np.float64)


def _ramp() -> NDArray[np.uint32]:
    at = np.linspace(0, len(_STOPS_RGB) - 1, 256)
    rgb = np.stack([np.interp(at, np.arange(len(_STOPS_RGB)), _STOPS_RGB[:, c]) for c in range(3)], axis=1)
    r, g, b = rgb.round().astype(np.uint32).T
    return (r << 24) | (g << 16) | (b << 8) | np.uint32(255)


_HEIGHT_RAMP = _ramp()


def by_height(z_m: NDArray[np.float32], low_m: float = -2.0, high_m: float = 25.0) -> NDArray[np.uint32]:
    """Packed colour (n,) of heights (n,): dark blue at `low_m`, nearly white from `high_m`."""
    index = np.clip((z_m - low_m) / (high_m - low_m) * 255, 0, 255).astype(np.uint8)
    return _HEIGHT_RAMP[index]
