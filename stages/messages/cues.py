"""Cues about where the drone is, from sensors other than LiDAR and cameras: GNSS, ranging, barometer.

None of them is needed, and none is accepted as a position: they direct the search and are evidence with a cap
(`stages/cues`).

Source: ours.
"""

from __future__ import annotations

import enum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Mat3, Message, PerPointF64, Shape, Vec3, message


@message(schema=110)
class DroneGnss(Message):
    """Position of the drone by its own GNSS receiver, as measured: it never contains a pose that grd sent."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float  # above mean sea level
    sigma_m: float | None  # horizontal, one sigma, as the receiver reports it; None: not reported
    sigma_up_m: float | None


@message(schema=111)
class DroneGlobalPosition(Message):
    """Position by the autopilot's estimator in geographic coordinates. See stages/messages/autopilot.py."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float  # above mean sea level
    altitude_above_home_m: float
    independent: bool = False  # of poses that grd sent


@message(schema=112)
class VehicleGnss(Message):
    """Position of the vehicle by its GNSS receiver, and its heading if the receiver has two antennas or a compass."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float  # above mean sea level
    sigma_m: float | None  # horizontal, one sigma; None: not reported
    sigma_up_m: float | None
    yaw_enu_rad: float | None  # of the vehicle's x axis, counter-clockwise from east; None: not measured
    yaw_sigma_rad: float | None


@message(schema=113)
class UwbRange(Message):
    """Distance between the ranging devices of vehicle and drone."""

    range_m: float
    sigma_m: float | None  # None: not reported


class CueKind(enum.Enum):
    """What a cue measures of the drone's position relative to the vehicle, in the axes of frame map."""

    POSITION = 0  # x, y, z
    LEVEL_AND_HEIGHT = 1  # horizontal distance, z: the direction of north in frame map is unknown
    RANGE = 2  # distance
    HEIGHT = 3  # z


@message(schema=116)
class DroneCue(Message):
    """One measurement of the drone's position relative to the vehicle's origin, in the axes of frame map."""

    source: str  # gnss, uwb, altitude
    kind: CueKind
    value_m: PerPointF64  # (n,) as `kind` says
    covariance_m2: Annotated[NDArray[np.float64], Shape("n", "n")]  # of the noise, which averages out
    bias_covariance_m2: Annotated[NDArray[np.float64], Shape("n", "n")]  # of the part that changes slowly
    bias_time_s: float  # correlation time of that part
    yaw_sigma_rad: float  # of the rotation of a POSITION about the vertical; it changes slowly, too
    reference_map_m: Vec3  # offset from the vehicle's origin to the point from which a RANGE is measured; else zero


@message(schema=115)
class CueState(Message):
    """State of one cue after its newest measurement, compared with the drone that the LiDAR found, if any.

    stamp_ns: that of the measurement.
    """

    source: str
    trusted: bool  # False: it contradicts the drone that the LiDAR found, and is not used
    reason: str
    bias_m: PerPointF64  # (n,) estimate of the slowly changing error
    bias_sigma_m: float  # largest
    offset_m: float  # distance between measurement and LiDAR, without correction of the bias; NaN: no drone found
    xyz_vehicle_m: Vec3 | None  # position of the drone by this cue, bias corrected; None: no position, or not trusted
    covariance_m2: Mat3 | None


@message(schema=117)
class CueFactor(Message):
    """What the fusion did with one measurement of a cue.

    stamp_ns: that of the measurement.
    """

    source: str
    used: bool  # it entered the graph
    contradicts: bool  # the estimate, the IMU or the drone's motion: the cue must show again that it is of the drone
    reason: str
    bias_m: PerPointF64  # (n,) estimate of the slowly changing error, in the graph
    bias_sigma_m: float  # largest
    offset_m: float  # distance between measurement and estimate, without correction of the bias
