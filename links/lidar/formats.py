"""The packet format of a LiDAR model.

Source: ours.
"""

from __future__ import annotations

import functools

from links.lidar.hesai import HesaiFormat
from links.lidar.ouster import OusterFormat
from links.lidar.packet_format import PacketFormat
from links.lidar.velodyne import VelodyneFormat
from stages.geometry.lidar_models import LIDAR_MODELS, lidar_profile
from stages.geometry.rig_lidar import LidarBeams

AnyFormat = VelodyneFormat | HesaiFormat | OusterFormat


def packet_format(model: str, beams: LidarBeams | None = None) -> AnyFormat:
    """How packets of this model are read; an Ouster needs its beams."""
    profile = lidar_profile(model)
    if model.startswith("XT"):
        return HesaiFormat(profile, beams)
    if model.startswith("OS"):
        assert beams is not None, f"{model}: beams"
        return OusterFormat(profile, beams)
    return VelodyneFormat(profile)


def recognised_model(data: bytes) -> str | None:
    """The model that sent a data packet, where the packet tells it; None for an Ouster's and for anything else."""
    return next((form.profile.model for form in _same_for_all_units() if form.reject_reason(data) is None), None)


@functools.cache
def _same_for_all_units() -> tuple[AnyFormat, ...]:
    return tuple(packet_format(model) for model in LIDAR_MODELS if not model.startswith("OS"))


__all__ = ["AnyFormat", "PacketFormat", "packet_format", "recognised_model"]
