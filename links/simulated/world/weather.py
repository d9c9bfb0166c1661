"""Weather: the effect of rain, haze and sun on light. Settings for every sensor, and the physics for the LiDAR.

Source: haze: Kim, McArthur, Korevaar, Proc. SPIE 4214 (2001), extinction at a wavelength from visibility; rain: ITU-R
P.1814, 1.076 R^0.67 dB/km; drop sizes: Marshall and Palmer (1948), N(D) = 8000 exp(-4.1 R^-0.21 D) per m^3 and mm.
A drop reflects like a Lambertian disc of its size with reflectivity 0.025: Fresnel's 0.02 at the front and, through
the drop as a lens, 0.02 / 4 (1 + (n / (2 - n))^2) at the back, with n = 1.33. The overlap of a near drop's light with
the receiver, which is next to the laser, is assumed. Haze attenuates; its backscatter is not modelled.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator
from pydantic import Field

from flow.stage import StrictModel
from stages.geometry.frames import Array64

LIDAR_NM = 903.0
NEPER_PER_DB = math.log(10) / 10
DROP_REFLECTIVITY = 0.025
SOAKED_MMPH = 2.0  # from this rain rate on, surfaces are fully wet
OVERLAP_M = 3.0  # assumed: below this range the receiver gets (range / OVERLAP_M)^2 of the light
CLUTTER_REACH_M = 12.0  # drops beyond this range are too weak to detect


class Weather(StrictModel):
    """The weather of a scenario; the default is a dry, clear day."""

    rain_mmph: float = Field(default=0.0, ge=0, le=150)
    visibility_m: float | None = Field(default=None, ge=20)  # where contrast falls to 2 %; null: clear air
    sun_elevation_deg: float = Field(default=45.0, ge=-18, le=90)  # 5 and below is dusk
    sun_azimuth_deg: float = 120.0  # counter-clockwise from the world x axis

    @property
    def wetness(self) -> float:
        """How wet surfaces are: 0 dry, 1 fully wet."""
        return min(1.0, self.rain_mmph / SOAKED_MMPH)

    def extinction_per_m(self, wavelength_nm: float = LIDAR_NM) -> float:
        """Extinction by haze and rain; a path transmits exp(-extinction * length) (Beer-Lambert)."""
        rain = 1.076 * self.rain_mmph**0.67 * NEPER_PER_DB / 1000 if self.rain_mmph > 0 else 0.0
        return rain + (0.0 if self.visibility_m is None else haze_extinction_per_m(self.visibility_m, wavelength_nm))


def haze_extinction_per_m(visibility_m: float, wavelength_nm: float) -> float:
    """3.91 / V (wavelength / 550 nm)^-q. q falls from 1.6 in clear air to 0 in fog, which is grey."""
    km = visibility_m / 1000
    if km > 50:
        q = 1.6
    elif km > 6:
        q = 1.3
    elif km > 1:
        q = 0.16 * km + 0.34
    else:
        q = max(0.0, km - 0.5)
    return 3.91 / visibility_m * (wavelength_nm / 550) ** -q


class RainClutter:
    """Rain drops bright enough for a return of their own, along one kind of beam."""

    def __init__(
        self,
        weather: Weather,
        threshold: float,
        near_m: float,
        aperture_m: tuple[float, float],
        spread_rad: tuple[float, float],
    ) -> None:
        """`threshold`: minimum detectable power, as reflectivity / range^2; `spread_rad`: full angles of the beam."""
        self._slope_per_mm = 4.1 * weather.rain_mmph**-0.21 if weather.rain_mmph > 0 else math.inf
        self._range_m = np.linspace(near_m, CLUTTER_REACH_M, 400)
        beam_m2 = (aperture_m[0] + spread_rad[0] * self._range_m) * (aperture_m[1] + spread_rad[1] * self._range_m)
        received = np.minimum(self._range_m / OVERLAP_M, 1) ** 2 * DROP_REFLECTIVITY / self._range_m**2
        received *= np.exp(-2 * weather.extinction_per_m() * self._range_m)
        drop_m2 = threshold * beam_m2 / received  # the smallest detectable
        self._least_mm = 1000 * np.sqrt(4 * drop_m2 / math.pi)
        per_m = beam_m2 * 8000 / self._slope_per_mm * np.exp(-self._slope_per_mm * self._least_mm)
        steps = (per_m[1:] + per_m[:-1]) / 2 * np.diff(self._range_m)
        self._count = np.concatenate([[0.0], np.cumsum(steps)])
        self._threshold = threshold

    @property
    def expected(self) -> float:
        """Mean number of such drops in one pulse."""
        return float(self._count[-1])

    def draw(self, rng: Generator, pulses: int) -> tuple[Array64, Array64]:
        """The nearest bright drop in each pulse: range (n,) [m], inf without one, and received power (n,).

        Drops are a Poisson process in range, so the first one is where the expected count reaches -ln(u).
        """
        draws = rng.uniform(size=(pulses, 2))  # the same number per pulse, so that batching does not matter
        reached = -np.log1p(-draws[:, 0])
        hit = reached < self.expected
        range_m = np.where(hit, np.interp(reached, self._count, self._range_m), np.inf)
        least_mm = np.interp(np.where(hit, range_m, 0.0), self._range_m, self._least_mm)
        size_mm = least_mm - np.log1p(-draws[:, 1]) / self._slope_per_mm
        return range_m, np.where(hit, self._threshold * (size_mm / least_mm) ** 2, 0.0)
