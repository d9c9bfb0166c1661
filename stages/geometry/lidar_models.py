"""Profiles of the spinning LiDARs: beams, firing times, units, return modes, limits, by model.

Lasers are listed in the packet's order. Elevations are above the plane across the spin axis, azimuth offsets grow in
the sense of rotation, clockwise seen from +z. An Ouster's elevations are nominal: each unit has its own
(`stages/geometry/rig_lidar.py`).

Sources: the page of each model's manual, `LidarProfile.source`. Footprints of the Velodyne models: VLS-128 user manual
63-9483, table F-1 (https://www.easymanua.ls/velodyne/vls-128/manual?p=115), the same family's optics. Not read in a
manual: every `range_at_10_percent_m`; limits, accuracy and footprint of the Hesai XT and the Ouster. The simulated
sensor uses them; the decoders need none of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

LidarModel = Literal[
    "VLP-16",
    "Puck Hi-Res",
    "VLP-32C",
    "HDL-32E",
    "XT16",
    "XT32",
    "OS0-32",
    "OS0-64",
    "OS0-128",
    "OS1-32",
    "OS1-64",
    "OS1-128",
]
LIDAR_MODELS: tuple[LidarModel, ...] = get_args(LidarModel)


@dataclass(frozen=True)
class LidarProfile:
    """Datasheet of one model, in the datasheet's units."""

    model: str
    source: str  # URL of the manual
    elevation_deg: tuple[float, ...]
    firing_ns: tuple[int, ...]  # from the first laser of a firing sequence to each
    sequence_ns: int  # from one firing sequence to the next; the longest of its modes
    range_unit_mm: int
    min_range_m: float
    max_range_m: float
    range_sigma_m: float  # constant error of a unit's range, one sigma: the stated accuracy as a uniform distribution
    footprint_rad: tuple[float, float]  # divergence, full angle along the scan and across it
    spin_hz: tuple[float, float]
    return_modes: tuple[str, ...]
    product_id: int | None = None  # in the packets
    azimuth_deg: tuple[float, ...] = ()  # offset of each laser; none
    vertical_offset_mm: tuple[float, ...] = ()  # of each laser's origin along the spin axis; none
    origin_mm: float = 0.0  # horizontal distance of the lasers' origins from the spin axis
    range_at_10_percent_m: float = 65.0  # half of the pulses on a 10 % target return
    turns_while_firing: bool = True  # a packet's azimuth is that of the first laser; False: of all lasers

    @property
    def lasers(self) -> int:
        """Number of lasers."""
        return len(self.elevation_deg)

    @property
    def beam_spacing_rad(self) -> float:
        """Mean angle between adjacent beams."""
        return math.radians((max(self.elevation_deg) - min(self.elevation_deg)) / (self.lasers - 1))


def lidar_profile(model: str) -> LidarProfile:
    """The profile of a model; KeyError for an unknown one."""
    return _PROFILES[model]


_UNIFORM_3_CM = 0.03 / math.sqrt(3)

_VLP_32C_DEG = (
    *(-25.0, -1.0, -1.667, -15.639, -11.31, 0.0, -0.667, -8.843),
    *(-7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4.0),
    *(-4.667, 1.667, 1.0, -3.667, -3.333, 3.333, 2.333, -2.667),
    *(-3.0, 7.0, 4.667, -2.333, -2.0, 15.0, 10.333, -1.333),
)
_HDL_32E_DEG = tuple(w for k in range(16) for w in (round(-92 / 3 + 4 * k / 3, 2), round(-28 / 3 + 4 * k / 3, 2)))


def _from_focus(distance_mm: float, elevation_deg: tuple[float, ...]) -> tuple[float, ...]:
    """Vertical offsets of beams that cross in one point at a distance from the spin axis."""
    return tuple(-distance_mm * math.tan(math.radians(w)) for w in elevation_deg)


def _ouster(model: str, lasers: int, half_fov_deg: float, origin_mm: float, min_range_m: float) -> LidarProfile:
    return LidarProfile(
        model=f"{model}-{lasers}",
        source="https://ouster.com/sensor-docs/fw-user-manual/docs/sensor-data/lidar-data",
        elevation_deg=tuple(float(w) for w in np.linspace(half_fov_deg, -half_fov_deg, lasers)),
        firing_ns=(0,) * lasers,  # all lasers of a column fire at once
        sequence_ns=195_313,  # mode 512x10
        range_unit_mm=1,
        min_range_m=min_range_m,
        max_range_m=75.0 if model == "OS0" else 170.0,
        range_sigma_m=_UNIFORM_3_CM,
        footprint_rad=(6.1e-3, 6.1e-3) if model == "OS0" else (3.1e-3, 3.1e-3),  # 0.35 and 0.18 deg
        spin_hz=(10.0, 20.0),
        return_modes=("strongest",),
        origin_mm=origin_mm,
        range_at_10_percent_m=35.0 if model == "OS0" else 90.0,
        turns_while_firing=False,
    )


_VLP_16 = LidarProfile(
    model="VLP-16",  # and Puck LITE: the same angles and product id
    source="https://www.easymanua.ls/velodyne/vlp-16/manual?p=54",  # table 9-1
    elevation_deg=(-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15),
    vertical_offset_mm=(11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2),
    firing_ns=tuple(2_304 * k for k in range(16)),
    sequence_ns=55_296,
    range_unit_mm=2,
    min_range_m=0.5,
    max_range_m=105.0,
    range_sigma_m=_UNIFORM_3_CM,
    footprint_rad=(3.0e-3, 1.5e-3),
    spin_hz=(5.0, 20.0),
    return_modes=("strongest", "last", "dual"),
    product_id=0x22,
)
_XT16 = LidarProfile(
    model="XT16",
    source="https://www.manualslib.com/manual/2964355/Hesai-Pandarxt-16.html",  # appendices I and II
    elevation_deg=tuple(float(15 - 2 * k) for k in range(16)),
    firing_ns=tuple(3_024 * k for k in range(16)),
    sequence_ns=50_000,
    range_unit_mm=4,
    min_range_m=0.05,
    max_range_m=120.0,
    range_sigma_m=0.01 / math.sqrt(3),
    footprint_rad=(1.5e-3, 1.5e-3),
    spin_hz=(5.0, 20.0),
    return_modes=("strongest", "last", "dual"),
    range_at_10_percent_m=80.0,
    turns_while_firing=False,
)
_PROFILES: dict[str, LidarProfile] = {
    profile.model: profile
    for profile in (
        _VLP_16,
        replace(
            _VLP_16,
            model="Puck Hi-Res",  # same manual and table
            elevation_deg=tuple(round(w, 3) for k in range(8) for w in (-10 + 4 * k / 3, 2 / 3 + 4 * k / 3)),
            vertical_offset_mm=(7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7, 3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4),
            product_id=0x24,
        ),
        replace(
            _VLP_16,
            model="VLP-32C",
            source="https://docslib.org/doc/7045953/vlp-32c-user-manual-63-9325-rev",  # tables 9-2 and 9-6
            elevation_deg=_VLP_32C_DEG,
            azimuth_deg=(
                *(1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4),
                *(1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
            ),
            vertical_offset_mm=_from_focus(42.4, _VLP_32C_DEG),  # envelope drawing 86-0130: distance of the focal point
            firing_ns=tuple(2_304 * (k // 2) for k in range(32)),  # lasers fire in pairs
            range_unit_mm=4,
            max_range_m=200.0,
            product_id=0x28,
        ),
        replace(
            _VLP_16,
            model="HDL-32E",
            source="https://manualsdump.com/amp/en/manuals/275446/20",  # appendices B and E
            elevation_deg=_HDL_32E_DEG,
            vertical_offset_mm=_from_focus(28.96, _HDL_32E_DEG),
            firing_ns=tuple(1_152 * k for k in range(32)),
            sequence_ns=46_080,
            max_range_m=100.0,
            range_sigma_m=0.02 / math.sqrt(3),
            product_id=0x21,
        ),
        _XT16,
        replace(
            _XT16,
            model="XT32",
            source="https://manualshive.com/en/manual/hesai/pandarxt/2127257?page=34",  # section 3.1, appendices I, II
            elevation_deg=tuple(float(15 - k) for k in range(32)),
            firing_ns=tuple(1_512 * k for k in range(32)),
        ),
        *(_ouster("OS0", lasers, 45.0, 27.67, 0.3) for lasers in (32, 64, 128)),
        *(_ouster("OS1", lasers, 22.5, 15.806, 0.3) for lasers in (32, 64, 128)),
    )
}
