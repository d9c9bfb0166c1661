"""From radiance to JPEG: vignetting, exposure, photon and read noise, gamma.

Source: EMVA Standard 1288 release 4.0, section 2 (electrons are Poisson, so their variance is their mean; read noise
adds; full well clips); ITU-R BT.709-style power of 1/2.2 for gamma. Numbers of a small global-shutter sensor.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from links.simulated.kernels.camera_image import STEPS, digitise
from links.simulated.kernels.ray_casting import Array32
from stages.geometry.frames import Array64

GREY = 0.22  # target of the auto exposure: mean as a fraction of saturation
ELECTRONS_PER_S = 1e7  # at radiance 1, white in full sun: full well in 1 ms
GAMMA = 2.2
EDGE_RAD = math.radians(1.5)  # width of the soft rim of the lens


class SensorSettings(BaseModel):
    """The image sensor and its exposure control."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

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
