"""LiDAR returns and pulses in the vehicle frame, and depth images of a sweep. P III.A, III.B."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Message, PerPointF32, PerPointI64, PerPointU8, Points32, Shape, Vec3, message

DepthPixels = Annotated[NDArray[np.float32], Shape("h", "w")]


@message(schema=21)
class SweptPoints(Message):
    """Returns in the vehicle frame, each at its own time; stamp_ns is the first pulse's of the slice."""

    point_stamp_ns: PerPointI64
    xyz_vehicle_m: Points32
    laser: PerPointU8
    reflectivity: PerPointU8
    turntable_rad: PerPointF32  # turntable angle at the pulse, after sign, zero and time offset
    pulses: int  # laser pulses fired in this slice, including those without a return
    origin_vehicle_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # origin of the beams, mid-slice
    unplaced: int = 0  # returns omitted because the turntable angle at their time is not known
    reason: str = ""  # why returns were omitted; empty if none were


@message(schema=22)
class SweptPulses(Message):
    """All laser pulses of a slice in the vehicle frame, including those without a return, which show free space.

    One row per pulse, in firing order, with the nearer of two returns; stamp_ns is the first pulse's. The slice is
    empty where the turntable angle is not known.
    """

    point_stamp_ns: PerPointI64  # firing time of each pulse
    direction_vehicle: Points32  # unit vectors
    range_m: PerPointF32  # along the direction, from origin_vehicle_m; 0: no return
    laser: PerPointU8
    reflectivity: PerPointU8
    turntable_rad: float  # turntable angle, mid-slice; NaN: not known
    origin_vehicle_m: tuple[float, float, float]  # origin of the beams, mid-slice

    @property
    def middle_ns(self) -> int:
        """Firing time of the middle pulse: the vehicle's pose at that time is used for the whole slice."""
        return int(self.point_stamp_ns[self.point_stamp_ns.size // 2])


@message(schema=23)
class DepthImage(Message):
    """Depth image of one whole sweep: a pinhole camera at the turntable, looking up. P III.A.

    stamp_ns is the sweep's end.
    Pixel (row v, column u) looks along (x, y, 1) with x = (u + 0.5 - w/2) / focal_px, y = (v + 0.5 - h/2) / focal_px,
    in axes parallel to the vehicle's. Depth is z over the origin.
    """

    start_ns: int
    depth_m: DepthPixels  # z of the nearest return, 0: none
    focal_px: float  # plane height / pixel size on that plane
    origin_vehicle_m: Vec3  # centre of projection
    points: int  # returns inside the image
    returns: int  # returns of the whole sweep
    turned_rad: float  # servo travel of the sweep; 0 for a fixed LiDAR
    lost_packets: int = 0  # LiDAR packets missing within the sweep


@message(schema=24)
class ScoreImage(Message):
    """Score per pixel of a DepthImage by the paper's detector: lower is better, NaN is no candidate. P III.B."""

    score: DepthPixels
