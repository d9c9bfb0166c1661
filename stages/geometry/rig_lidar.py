"""The LiDAR in the rig file: its model, its mount, and the beams of this unit.

Source: ours.
"""

from __future__ import annotations

import math
import operator
from typing import Annotated, Literal

from pydantic import Field, model_validator

from flow.stage import StrictModel
from stages.geometry.frames import LidarMount
from stages.geometry.lidar_models import LidarModel, LidarProfile, lidar_profile

OusterProfile = Literal["LEGACY", "RNG19_RFL8_SIG16_NIR16", "RNG15_RFL8_NIR8", "RNG19_RFL8_SIG16_NIR16_DUAL"]


class LidarBeams(StrictModel):
    """Beams of one unit, as measured by the manufacturer, in the packet's order; for an Ouster also its packets."""

    elevation_deg: tuple[float, ...]
    azimuth_deg: tuple[float, ...]  # offsets, positive in the sense of rotation
    origin_mm: Annotated[float, Field(ge=0, le=100)] = 0.0  # Ouster: lidar_origin_to_beam_origin_mm
    columns: Literal[512, 1024, 2048] = 1024  # Ouster: per turn
    spin_hz: Literal[10, 20] = 10  # Ouster
    columns_per_packet: Annotated[int, Field(ge=1, le=128)] = 16  # Ouster
    packets: OusterProfile = "LEGACY"  # Ouster: udp_profile_lidar
    serial: Annotated[int | None, Field(exclude_if=operator.not_)] = (
        None  # packets of another unit are refused; None: not checked
    )

    @property
    def return_mode(self) -> Literal["strongest", "dual"]:
        """Ouster: the returns that its packets hold."""
        return "dual" if self.packets.endswith("_DUAL") else "strongest"


class RigLidar(StrictModel):
    """`rig.lidar`: an Ouster needs its `beams`; a Velodyne has none, a Hesai XT may have them."""

    model: LidarModel = "VLP-16"
    mount: LidarMount = LidarMount()
    beams: Annotated[LidarBeams | None, Field(exclude_if=operator.not_)] = None

    @model_validator(mode="after")
    def _beams_fit(self) -> RigLidar:
        count = self.profile.lasers
        if self.beams is None:
            if self.model.startswith("OS"):
                raise ValueError(
                    f"beams: each {self.model} has its own: `grd import METADATA.json -o beams.yaml` writes them from "
                    "the sensor's metadata (http://SENSOR/api/v1/sensor/metadata)"
                )
        elif {len(self.beams.elevation_deg), len(self.beams.azimuth_deg)} != {count}:
            raise ValueError(
                f"beams: the {self.model} has {count} lasers, not {len(self.beams.elevation_deg)}: of another sensor?"
            )
        elif not self.model.startswith(("OS", "XT")):
            raise ValueError(f"beams: all units of the {self.model} have the same: leave them out")
        return self

    @property
    def profile(self) -> LidarProfile:
        """Datasheet of the model."""
        return lidar_profile(self.model)

    @property
    def elevation_rad(self) -> tuple[float, ...]:
        """Elevation of each laser."""
        return tuple(math.radians(w) for w in (self.beams or self.profile).elevation_deg)

    @property
    def azimuth_offset_rad(self) -> tuple[float, ...]:
        """Azimuth offset of each laser."""
        profile = self.profile
        offsets_deg = self.beams.azimuth_deg if self.beams else profile.azimuth_deg or (0.0,) * profile.lasers
        return tuple(math.radians(offset) for offset in offsets_deg)

    @property
    def azimuth_delay_ns(self) -> tuple[int, ...]:
        """Time from each laser's azimuth to its pulse."""
        profile = self.profile
        return (0,) * profile.lasers if profile.turns_while_firing else profile.firing_ns
