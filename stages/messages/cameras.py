"""What both fisheyes tell of rotations and motions. P IV, V."""

from __future__ import annotations

import enum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Mat3, Message, PerPointBool, PerPointF64, PerPointI64, Points64, Shape, Vec3, message


class CameraMount(enum.Enum):
    """What a camera is mounted on, and in whose axes its directions are told."""

    VEHICLE = "vehicle"
    DRONE = "drone"


@message(schema=41)
class VanishingDirections(Message):
    """Directions in which a picture's straight lines run, and the lines; stamp_ns is the picture's. P IV, V.C.

    Axes are the camera_mount's (x forward, y left, z up), not the lens's. A direction's sign means nothing.
    No directions is a normal answer: `reason` says why.
    """

    camera_mount: CameraMount
    direction: Points64  # (n, 3) unit; the vertical first where there is one
    sigma_rad: PerPointF64  # (n,) of each direction, one axis, 1 sigma
    is_vertical: PerPointBool  # (n,)
    frame: PerPointI64  # (n,) which horizontal pair it belongs to, 0 the strongest; -1: the vertical
    line_normal: Annotated[NDArray[np.float64], Shape("m", 3)]  # unit normals of the lines' great circles
    line_end: Annotated[NDArray[np.float64], Shape("m", 2, 3)]  # unit rays of each line's two ends
    line_sigma_rad: Annotated[
        NDArray[np.float64], Shape("m")
    ]  # (m,) how far the normal may be turned about the ray to the line's middle
    line_direction: Annotated[NDArray[np.int64], Shape("m")]  # index of its direction; -1: none
    reason: str


class BranchState(enum.Enum):
    """How well it is known which of the street's four directions is which."""

    NONE = 0  # no rotation now
    AMBIGUOUS = 1  # up to a quarter turn, or half of one
    RESOLVED = 2


@message(schema=42)
class RelativeRotation(Message):
    """How the drone is turned in the vehicle's axes, up to the street's symmetry; stamp_ns is the pictures'. P IV.

    Branch k is turned further by k * 90 deg about the world's vertical: Rz(k 90 deg) R_vehicle_drone where the vehicle
    stands level. Branch 0 is the most probable and given here. What the probabilities leave to 1: none is right.
    """

    R_vehicle_drone: Mat3 | None  # None: no rotation now, `reason` says why
    covariance_rad2: Mat3 | None  # of phi in R exp(phi), the drone's axes
    branch_probability: Annotated[NDArray[np.float64], Shape(4)]  # of branch k
    state: BranchState
    switches: int  # how often the branch given out has changed since the start: a change is a jump
    reason: str


@message(schema=43)
class VisualMotion(Message):
    """How the drone's camera moved from one picture to a later one, told in the drone's axes. P V.E.

    p_from = R_from_to p_to + |t| direction: the length is not known from one camera. stamp_ns is the later picture's.
    """

    from_ns: int
    R_from_to: Mat3
    covariance_rad2: Mat3  # of phi in R exp(phi), axes of the later picture's drone
    direction_from: Vec3 | None  # unit; None: no motion seen beyond the rotation
    direction_sigma_rad: float | None
    matches: int  # features that agree
    reason: str


@message(schema=44)
class FollowedFeatures(Message):
    """Features of a camera followed from an earlier picture to this one; stamp_ns is this picture's. P V.B, V.E."""

    frame_id: str  # which camera
    from_ns: int  # the earlier picture's stamp
    pixel_from: Annotated[NDArray[np.float64], Shape("n", 2)]  # column, row in the earlier picture
    pixel_to: Annotated[NDArray[np.float64], Shape("n", 2)]
    residual_rad: PerPointF64  # by how much each misses the camera's motion that was found
    agrees: PerPointBool  # with that motion
