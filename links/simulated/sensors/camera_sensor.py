"""From radiance to JPEG: vignetting, dirt, lens flare, exposure, photon and read noise, gamma.

Source: EMVA Standard 1288 release 4.0, section 2 (electrons are Poisson, so their variance is their mean; read noise
adds; full well clips); Hullin et al., ACM Trans. Graphics 30 (2011) 108, for flare (ghosts lie on the line through the
images of sun and axis; their sizes and strengths, and the dirt, are ours); ITU-R BT.709-style power of 1/2.2 for gamma.
Numbers of a small global-shutter sensor.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from links.simulated.kernels.camera_image import STEPS, digitise
from links.simulated.kernels.ray_casting import Array32
from stages.geometry.frames import Array64

GREY = 0.22  # target of the auto exposure: mean as a fraction of saturation
ELECTRONS_PER_S = 1e7  # at radiance 1, white in full sun: full well in 1 ms
GAMMA = 2.2
GHOSTS = (  # position on the line from the centre to the sun, radius as a share of the image, colour
    (-0.30, 0.020, (0.6, 1.0, 0.7)),
    (-0.55, 0.045, (1.0, 0.7, 0.5)),
    (-0.90, 0.070, (0.5, 0.7, 1.0)),
    (0.45, 0.030, (0.9, 0.9, 0.6)),
)
EDGE_RAD = math.radians(1.5)  # width of the soft rim of the lens


class SensorSettings(StrictModel):
    """The image sensor and its exposure control."""

    exposure_ms: float | None = Field(default=None, gt=0, le=60)  # null: automatic
    max_exposure_ms: float = Field(default=15.0, gt=0, le=60)  # limit of the automatic exposure; above it, gain
    max_gain: float = Field(default=16.0, ge=1)
    full_well_e: float = Field(default=10_000, ge=500)
    read_noise_e: float = Field(default=4.0, ge=0)
    shot_noise: bool = True
    vignetting: float = Field(default=0.4, ge=0, lt=1)  # fraction of light lost at the rim
    jpeg_quality: int = Field(default=90, ge=10, le=100)


def auto_exposure(settings: SensorSettings, mean_radiance: float) -> tuple[float, float]:
    """Exposure [s] and gain that bring the mean radiance to GREY; gain is used only at the longest exposure."""
    wanted_s = GREY * settings.full_well_e / (max(mean_radiance, 1e-6) * ELECTRONS_PER_S)
    if settings.exposure_ms is not None:
        exposure_s = 1e-3 * settings.exposure_ms
    else:
        exposure_s = min(max(wanted_s, 2e-5), 1e-3 * settings.max_exposure_ms)
    return exposure_s, min(max(wanted_s / exposure_s, 1.0), settings.max_gain)


def transmission(off_axis_rad: Array64, limit_rad: float, vignetting: float) -> Array32:
    """Fraction of light (n,) that passes the lens: 1 - vignetting (theta / limit)^2, with a soft rim."""
    rim = np.clip((limit_rad - off_axis_rad) / EDGE_RAD, 0.0, 1.0)
    return ((1 - vignetting * (off_axis_rad / limit_rad) ** 2) * rim).astype(np.float32)


def dirt(rows: NDArray[np.intp], columns: NDArray[np.intp], size_px: int, spots: int, rng: Generator) -> Array32:
    """Fraction of light (n,) that passes a dirty lens at pixels: soft spots, and one scratch or hair per four spots."""
    clean = np.ones(len(rows))
    for k in range(spots):
        at, radius = rng.uniform(0.1, 0.9, 2) * size_px, size_px * rng.uniform(0.004, 0.03)
        x, y = columns - at[0], rows - at[1]
        if k % 4 == 3:
            angle, bend = rng.uniform(0, math.pi), rng.normal(0, 0.8)
            along = x * math.cos(angle) + y * math.sin(angle)
            across = y * math.cos(angle) - x * math.sin(angle) - bend * along**2 / size_px
            reach = size_px * rng.uniform(0.03, 0.12)
            shape = np.exp(-((across / (0.0018 * size_px)) ** 2)) * (np.abs(along) < reach)
        else:
            stretch = rng.uniform(0.6, 1.6)
            shape = np.exp(-((((x * stretch) ** 2 + (y / stretch) ** 2) / radius**2) ** 1.5))
        clean *= 1.0 - rng.uniform(0.2, 0.7) * shape
    return clean.astype(np.float32)


def flare(image: Array32, sun_px: Array64, centre_px: Array64, strength: float, sun_rgb: Array64) -> None:
    """Add glare and streaks about the sun's image (2,) column, row, and ghosts, to a radiance image (h, w, 3)."""
    size = image.shape[0]
    row, column = np.mgrid[0:size, 0 : image.shape[1]].astype(np.float32)
    x, y = column - sun_px[0], row - sun_px[1]
    r = np.hypot(x, y) / size
    light = 0.8 * np.exp(-r / 0.02) + 0.10 * np.exp(-r / 0.15)
    for angle in np.radians(np.arange(8.0, 180.0, 30.0)):
        across = (y * math.cos(angle) - x * math.sin(angle)) / (0.002 * size)
        light += 0.35 * np.exp(-(across**2)) * np.exp(-r / 0.10)
    image += strength * light[:, :, None] * sun_rgb.astype(np.float32)
    for share, radius, rgb in GHOSTS:
        at = centre_px + share * (sun_px - centre_px)
        away = np.hypot(column - at[0], row - at[1]) / (radius * size)
        disc = np.clip(8.0 * (1.0 - away), 0.0, 1.0) * (0.4 + 0.6 * np.minimum(away, 1.0) ** 2)
        image += 0.12 * strength * disc[:, :, None] * (np.array(rgb) * sun_rgb).astype(np.float32)


def develop(
    radiance: Array32, settings: SensorSettings, exposure_s: float, gain: float, rng: Generator
) -> NDArray[np.uint8]:
    """8-bit image (h, w, 3) from the radiance behind the lens."""
    noise = rng.standard_normal(radiance.shape, dtype=np.float32)
    code = np.rint(255 * (np.arange(STEPS) / (STEPS - 1)) ** (1 / GAMMA)).astype(np.uint8)
    return digitise(
        radiance, noise, ELECTRONS_PER_S * exposure_s, settings.full_well_e, settings.read_noise_e,
        1.0 if settings.shot_noise else 0.0, gain, code,
    )  # fmt: skip


def encode_jpeg(image_rgb: NDArray[np.uint8], quality: int) -> bytes:
    """The image as JPEG."""
    ok, data = cv2.imencode(".jpg", image_rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"OpenCV could not encode an image of shape {image_rgb.shape}")
    return data.tobytes()
