"""Light of a scene from its weather: sun, sky gradient, clouds, haze.

Source: ours. Radiances are relative: 1 is a white, matt surface in full sun. Haze attenuates and adds light with the
extinction of the weather at 550 nm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.kernels.camera_paint import LOWEST_SKY_DEG, SKY_PX
from links.simulated.kernels.ray_casting import Array32
from links.simulated.world.weather import Weather
from stages.geometry.frames import Array64

WAVELENGTH_NM = 550.0
DAWN_DEG = (-8.0, 12.0)  # sun elevations between which daylight grows from almost none to full


@dataclass(frozen=True)
class Light:
    """Light sources of the scene."""

    sun_direction: Array64  # (3,) unit, world, towards the sun
    sun_rgb: Array64  # on a surface that faces it
    above_rgb: Array64  # ambient on a surface that faces up
    below_rgb: Array64  # ambient on a surface that faces down
    haze_rgb: Array64
    extinction_per_m: float
    sky: Array32  # (SKY_PX, SKY_PX, 3)


def light(weather: Weather, seed: int) -> Light:
    """The light of a weather; the seed draws the clouds."""
    rng = np.random.default_rng([seed, 20])
    elevation = math.radians(weather.sun_elevation_deg)
    azimuth = math.radians(weather.sun_azimuth_deg)
    up = max(math.sin(elevation), 0.0)
    sun_direction = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    day = float(_smooth((weather.sun_elevation_deg - DAWN_DEG[0]) / (DAWN_DEG[1] - DAWN_DEG[0]))) ** 2
    level = 0.004 + 0.996 * day
    overcast = weather.wetness
    reddened = np.array([1.0, 0.93 - 0.35 * (1 - up) ** 3, 0.84 - 0.6 * (1 - up) ** 3])
    sun_rgb = (up > 0) * (1 - overcast) * min(1.0, 4 * up) * reddened
    zenith = level * ((1 - overcast) * np.array([0.13, 0.24, 0.48]) + overcast * np.array([0.42, 0.44, 0.47]))
    horizon = level * ((1 - overcast) * np.array([0.52, 0.60, 0.68]) + overcast * np.array([0.36, 0.37, 0.39]))
    dusk = (1 - overcast) * (1 - day) * level * np.array([0.55, 0.22, 0.05])
    sky = _sky_map(sun_direction, sun_rgb, zenith, horizon + dusk, overcast, level, rng)
    above = 0.55 * zenith + 0.45 * horizon
    return Light(
        sun_direction=sun_direction,
        sun_rgb=sun_rgb,
        above_rgb=above,
        below_rgb=0.25 * above + 0.10 * sun_rgb * up,
        haze_rgb=0.9 * horizon,
        extinction_per_m=weather.extinction_per_m(WAVELENGTH_NM),
        sky=sky,
    )


def _sky_map(
    sun: Array64,
    sun_rgb: Array64,
    zenith: Array64,
    horizon: Array64,
    overcast: float,
    level: float,
    rng: np.random.Generator,
) -> Array32:
    """Radiance over the hemisphere, equidistant about the zenith: columns along x, rows along y."""
    grid = (np.arange(SKY_PX) + 0.5) / SKY_PX * 2 - 1
    x, y = np.meshgrid(grid, grid)
    off_zenith = np.minimum(np.hypot(x, y), 1.0) * math.radians(90 + LOWEST_SKY_DEG)
    phi = np.arctan2(y, x)
    direction = np.stack(
        [np.sin(off_zenith) * np.cos(phi), np.sin(off_zenith) * np.sin(phi), np.cos(off_zenith)], axis=2
    )
    height = np.clip(direction[:, :, 2], 0.0, 1.0)
    blend = (1 - height)[:, :, None] ** 3
    sky = zenith * (1 - blend) + horizon * blend
    to_sun = np.arccos(np.clip(direction @ sun, -1, 1))
    glow = 0.35 * np.exp(-to_sun / 0.12) + 0.12 * np.exp(-to_sun / 0.6)
    sky = sky + glow[:, :, None] * sun_rgb
    plane = 1.2 / (height + 0.18)  # clouds are a flat layer: smaller towards the horizon
    noise = noise_tile(rng)
    clouds = _lookup(noise, direction[:, :, 0] * plane, direction[:, :, 1] * plane)
    cover = _smooth((clouds - 0.50 + 0.25 * overcast) / 0.22) * _smooth(height / 0.12)
    white = level * (0.55 + 0.30 * (1 - overcast)) * (1.15 - 0.5 * clouds)
    cover = (cover * (0.85 - 0.45 * overcast))[:, :, None]
    sky = sky * (1 - cover) + cover * white[:, :, None] * np.array([1.0, 1.0, 1.02])
    disc = to_sun < math.radians(0.4)
    sky[disc] += 60.0 * sun_rgb
    return sky.astype(np.float32)


def noise_tile(rng: np.random.Generator, size: int = 256, falloff: float = 1.7) -> Array64:
    """A periodic tile of 1/f^falloff noise, scaled to [0, 1], for clouds, stains and asphalt."""
    f = np.fft.fftfreq(size)[:, None] ** 2 + np.fft.fftfreq(size)[None, :] ** 2
    f[0, 0] = np.inf
    spectrum = np.fft.fft2(rng.normal(size=(size, size))) * f ** (-falloff / 2)
    tile = np.fft.ifft2(spectrum).real
    order = np.argsort(np.argsort(tile.ravel()))
    return (order / order.max()).reshape(size, size)


def _lookup(tile: Array64, x: Array64, y: Array64) -> Array64:
    """The tile (one per 4 units) at (x, y), bilinear."""
    size = len(tile)
    u, v = x * size / 4, y * size / 4
    i, j = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    a, b = u - i, v - j
    i0, i1, j0, j1 = i % size, (i + 1) % size, j % size, (j + 1) % size
    top = tile[j0, i0] * (1 - a) + tile[j0, i1] * a
    low = tile[j1, i0] * (1 - a) + tile[j1, i1] * a
    return top * (1 - b) + low * b


def _smooth(t: float | Array64) -> NDArray[np.float64]:
    clipped = np.clip(t, 0.0, 1.0)
    return clipped * clipped * (3 - 2 * clipped)
