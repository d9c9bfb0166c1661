"""A spinning LiDAR, pulse by pulse: each pulse has its own pose, spreads into a footprint, and is detected or not.

Source: `stages/geometry/lidar_models.py` (timing, beams, footprint, limits); VLP-16 user manual 63-9243 (1 m between
two returns). Range noise is that of real captures of a VLP-16 (7 mm median on flat patches). The patterns of sub-rays
are ours. So is the detection: received power against a threshold set by the range at which half of the pulses on a 10 %
target return.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from links.lidar import AnyFormat, packet_format
from links.lidar.ouster import OusterFormat
from links.simulated.kernels import lidar as kernels
from links.simulated.kernels.lidar import APERTURE_M, PULSE_LENGTH_M, echoes, sees_edge
from links.simulated.kernels.ray_casting import Array32
from links.simulated.world.weather import RainClutter, Weather
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarProfile
from stages.kernels.lidar.packets import ORIGIN_M, RANGE_UNIT_M, Z_OFFSET_M

VLP16 = packet_format("VLP-16")


@dataclass(frozen=True, eq=False)
class Pattern:
    """Sub-rays of one pulse: offsets (k, 2) in half footprints, along and across the scan, and power shares (k,)."""

    offsets: Array64
    shares: Array64


COARSE = Pattern(
    np.array([(0.0, 0.0), (-0.6, -0.6), (-0.6, 0.6), (0.6, -0.6), (0.6, 0.6)]),
    np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6]),
)
FINE = Pattern(
    np.array([(u, v) for u in np.linspace(-6 / 7, 6 / 7, 7) for v in np.linspace(-0.8, 0.8, 5)]), np.full(35, 1 / 35)
)
DIAGONAL = Pattern(np.array([(0.0, 0.0), (-0.6, -0.6), (0.6, 0.6)]), np.array([1 / 3, 1 / 3, 1 / 3]))
MEDIUM = Pattern(
    np.array([(u, v) for u in np.linspace(-0.8, 0.8, 5) for v in (-2 / 3, 0.0, 2 / 3)]), np.full(15, 1 / 15)
)

FOOTPRINTS = {"dense": (COARSE, FINE), "sparse": (DIAGONAL, MEDIUM)}
"""By `LidarSettings.footprint`: the pattern of every pulse, and of one at an edge. Near a drone or bird it is FINE."""

COARSE_SPREAD_M = 0.3  # a pulse whose coarse sub-rays differ by more is at an edge and is cast again


def _is_dense(footprint: str) -> bool:
    return footprint == "dense"  # scenario files leave out a setting that they do not use


class LidarSettings(StrictModel):
    """Settings and errors of the sensor."""

    return_mode: Literal["strongest", "last", "dual"] = "strongest"
    footprint: Annotated[Literal["dense", "sparse"], Field(exclude_if=_is_dense)] = "dense"  # sparse: half the time
    rotor_rpm: float = Field(default=600.0, ge=300, le=1200)
    range_at_10_percent_m: float | None = Field(
        default=None, gt=1
    )  # half of the pulses on a 10 % target return; None: model's
    power_spread_db: float = Field(default=1.0, gt=0)  # spread of the received power between pulses, one sigma
    range_noise_m: float = Field(default=0.008, ge=0)  # one sigma on a strong return
    weak_range_noise_m: float = Field(default=0.02, ge=0)  # added at the threshold; falls with power
    laser_bias_m: float = Field(default=0.01, ge=0)  # one sigma over the lasers, constant in a run
    range_offset_m: Annotated[float, Field(ge=-0.5, le=0.5, exclude_if=operator.not_)] = 0.0  # common to all lasers
    dropout: float = Field(default=0.005, ge=0, lt=1)  # probability that a pulse is lost for no modelled reason
    min_range_m: float | None = None  # None: the model's
    max_range_m: float | None = None

    def of_model(self, profile: LidarProfile) -> LidarSettings:
        """The same with the model's limits where none are set."""
        names = ("range_at_10_percent_m", "min_range_m", "max_range_m")
        return self.model_copy(update={n: getattr(profile, n) for n in names if getattr(self, n) is None})


class Environment(Protocol):
    """The environment of the LiDAR. Rays are grouped in pulses: (n, k, 3) with one time per pulse."""

    def cast(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32, max_range_m: float
    ) -> tuple[Array32, Array32, NDArray[np.uint8]]:
        """Range (n, k) [m] (inf: no hit), returned fraction (n, k), and number of the drone hit (n, k), 0: none."""
        ...

    def near_small_body(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32
    ) -> NDArray[np.bool_]:
        """Pulses (n,) whose axis, (n, 3), passes a drone or a bird so closely that it may hit it."""
        ...


@dataclass(frozen=True)
class Pulses:
    """Measurements of pulses: one row of returns, or two in dual mode (strongest, last)."""

    range_m: Array64  # (returns, n), a multiple of the packet's unit, 0: no return
    reflectivity: NDArray[np.uint8]  # (returns, n)
    drone_share: Array64  # (returns, n) truth, not sent: fraction of the return's power from a drone
    drone: NDArray[np.uint8]  # (returns, n) truth, not sent: number of that drone; 0: none

    def hits(self, drone: int) -> NDArray[np.bool_]:
        """Pulses (n,) with a return that has most of its power from this drone."""
        return np.asarray(((self.drone_share > 0.5) & (self.drone == drone)).any(axis=0))


class Lidar:
    """The sensor: rotor, lasers and noise. Pulses must be fired in order of time."""

    def __init__(
        self, settings: LidarSettings, start_ns: int, seed: int, weather: Weather | None = None, form: AnyFormat = VLP16
    ) -> None:
        weather = weather or Weather()
        profile = form.profile
        settings = settings.of_model(profile)
        self.settings, self.form = settings, form
        assert settings.min_range_m is not None
        assert settings.max_range_m is not None
        assert settings.range_at_10_percent_m is not None
        self.min_range_m, self.max_range_m = settings.min_range_m, settings.max_range_m
        self._footprint_rad = profile.footprint_rad
        self._firing_ns = np.array(profile.firing_ns, dtype=np.int64)
        self._range_step_m = float(form.scales[RANGE_UNIT_M])
        fixed, self._noise, self._loss = (np.random.default_rng([seed, 2, i]) for i in range(3))
        self._start_ns = start_ns
        self._rotor_phase_rad = fixed.uniform(0, 2 * np.pi)
        self._rotor_radps = settings.rotor_rpm / 60 * 2 * np.pi * (1 + fixed.normal(0, 3e-4))
        self._patterns = FOOTPRINTS[settings.footprint]
        self._bias_m = fixed.normal(0, settings.laser_bias_m, profile.lasers) + settings.range_offset_m
        self._threshold = 0.10 / settings.range_at_10_percent_m**2
        self._extinction_per_m = weather.extinction_per_m()
        self._drops = None
        if weather.rain_mmph > 0:
            self._drops = RainClutter(weather, self._threshold, self.min_range_m, APERTURE_M, self._footprint_rad)
            self._rain = np.random.default_rng([seed, 12])

    def azimuth_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """Rotor angle [0, 2 pi): 0 along +y_lidar, positive towards +x_lidar. Its speed varies by about 0.02 %.

        An Ouster fires at the columns of its encoder: the rotor turns evenly, and column 0 is at 90 deg.
        """
        if isinstance(self.form, OusterFormat):
            column = np.rint((stamp_ns - self._start_ns) / self.form.column_ns)
            return np.mod(np.pi / 2 + 2 * np.pi * column / self.form.beams.columns, 2 * np.pi)
        t = (stamp_ns - self._start_ns) * 1e-9
        wander = 2e-3 * np.sin(2 * np.pi * 0.11 * t)
        return np.mod(self._rotor_phase_rad + self._rotor_radps * t + wander, 2 * np.pi)

    def fire(
        self, pulse_ns: NDArray[np.int64], R_world_lidar: Array64, t_world_lidar_m: Array64, environment: Environment
    ) -> Pulses:
        """Fire pulses at times (n,), all lasers in turn, from poses (n, 3, 3), (n, 3)."""
        s, count = self.settings, len(pulse_ns)
        laser = np.arange(count) % self.form.profile.lasers
        turns = self.form.profile.turns_while_firing
        rotor = self.azimuth_rad(pulse_ns if turns else pulse_ns - self._firing_ns[laser])
        normal = self._noise.normal(size=(count, 4)).T  # drawn per pulse, so that batching does not matter
        threshold = self._threshold * 10 ** (-0.1 * s.power_spread_db * normal[0])
        threshold[self._loss.uniform(size=count) < s.dropout] = np.inf

        drops = np.full((2, count), np.inf) if self._drops is None else np.array(self._drops.draw(self._rain, count))

        coarse, at_edges = self._patterns
        origins, directions = sub_rays(rotor, laser, R_world_lidar, t_world_lidar_m, coarse.offsets, self.form)
        hits = environment.cast(pulse_ns, origins, directions, self.max_range_m + PULSE_LENGTH_M)
        ranges, power, drone_power, drone = self._received(hits, coarse.shares, threshold, drops)
        edge = sees_edge(hits[0], COARSE_SPREAD_M)
        small = environment.near_small_body(pulse_ns, origins[:, 0], directions[:, 0])
        again = ((edge | small, FINE),) if at_edges is FINE else ((small, FINE), (edge & ~small, at_edges))
        for of_pulse, pattern in again:
            some = np.nonzero(of_pulse)[0]
            if len(some):
                poses = R_world_lidar[some], t_world_lidar_m[some]
                rays = sub_rays(rotor[some], laser[some], *poses, pattern.offsets, self.form)
                hits = environment.cast(pulse_ns[some], *rays, self.max_range_m + PULSE_LENGTH_M)
                finer = self._received(hits, pattern.shares, threshold[some], drops[:, some])
                ranges[:, some], power[:, some], drone_power[:, some], drone[:, some] = finer

        margin = np.maximum(power / self._threshold, 1.0)
        sigma = np.sqrt(s.range_noise_m**2 + s.weak_range_noise_m**2 / margin)
        measured = ranges + self.form.scales[ORIGIN_M] + self._bias_m[laser] + sigma * normal[1 : 1 + len(ranges)]
        measured = np.rint(measured / self._range_step_m) * self._range_step_m
        lit = (power > 0) & (measured >= self.min_range_m) & (measured <= self.max_range_m)
        shade = np.clip(np.rint(100 * power * ranges**2 * (1 + 0.05 * normal[3])), 1, 255)
        share = np.divide(drone_power, power, out=np.zeros_like(power), where=lit)
        return Pulses(np.where(lit, measured, 0.0), np.where(lit, shade, 0).astype(np.uint8), share, drone)

    def _received(
        self,
        hits: tuple[Array32, Array32, NDArray[np.uint8]],
        shares: Array64,
        threshold: Array64,
        drops: Array64,
    ) -> tuple[Array64, Array64, Array64, NDArray[np.uint8]]:
        """`echoes` with weather: Beer-Lambert in both directions, and the nearest bright drop of each pulse (2, n)."""
        ranges, fractions, drone = hits
        if self._extinction_per_m > 0:
            reach = np.where(np.isfinite(ranges), ranges, 0.0)
            fractions = fractions * np.exp(-2 * self._extinction_per_m * reach).astype(np.float32)
        if self._drops is not None:
            before = drops[0] < ranges.max(axis=1)  # a nearer surface hides the drop
            near = np.where(before, drops[0], np.inf)
            ranges = np.column_stack([ranges, near]).astype(np.float32)
            back = np.where(before, drops[1] * np.where(before, near, 0.0) ** 2, 0.0)
            fractions = np.column_stack([fractions, back]).astype(np.float32)
            drone = np.column_stack([drone, np.zeros(len(drone), dtype=np.uint8)])
            shares = np.append(shares, 1.0)
        return echoes(ranges, fractions, drone, shares, threshold, self.min_range_m, self.settings.return_mode)


def sub_rays(
    azimuth_rad: Array64,
    laser: NDArray[np.intp],
    R_world_lidar: Array64,
    t_world_lidar_m: Array64,
    offsets: Array64,
    form: AnyFormat = VLP16,
) -> tuple[Array32, Array32]:
    """Origins and unit directions (n, k, 3), world frame, of the sub-rays of pulses (n,), from the rotor's angles."""
    vertical_offset_m = form.pulses[: form.profile.lasers, Z_OFFSET_M][laser]
    origin_m = form.scales[ORIGIN_M] * np.column_stack([np.sin(azimuth_rad), np.cos(azimuth_rad)])
    return kernels.sub_rays(
        azimuth_rad + form.azimuth_offset_rad[laser],
        form.elevation_rad[laser],
        vertical_offset_m,
        origin_m,
        R_world_lidar,
        t_world_lidar_m,
        offsets,
        form.profile.footprint_rad,
    )
