"""The packet format of a LiDAR model.

Source: ours.
"""

from __future__ import annotations

import functools

from links.lidar.hesai import HesaiFormat
from links.lidar.ouster import OusterFormat
from links.lidar.reject_reason import PacketRejectReason
from links.lidar.velodyne import VelodyneFormat
from stages.geometry.lidar_models import LIDAR_MODELS, lidar_profile
from stages.geometry.rig_lidar import LidarBeams

NOT_THE_MODEL = (PacketRejectReason.LENGTH, PacketRejectReason.POSITION, PacketRejectReason.MODEL)
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
    """The model that sent a data packet, where the packet names it; None for an Ouster's and for anything else."""
    for form in _same_for_all_units():
        reason = form.reject_reason(data)
        if reason is None or (isinstance(form, VelodyneFormat) and reason not in NOT_THE_MODEL):
            return form.profile.model
    return None


@functools.cache
def _same_for_all_units() -> tuple[AnyFormat, ...]:
    return tuple(packet_format(model) for model in LIDAR_MODELS if not model.startswith("OS"))
