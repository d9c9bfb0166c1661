"""Messages derived from the fisheye images: vanishing directions, rotations, visual motion. P IV, V."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Mat3, Message, PerPointBool, PerPointF64, PerPointI64, Points64, Shape, Vec3, message


class CameraMount(enum.Enum):
    """The body a camera is mounted on; its directions are given in that body's axes."""

    VEHICLE = "vehicle"
    DRONE = "drone"


@dataclass(frozen=True, slots=True)
class WeightedAnswers:
    """Answers that fit the lines of an image about equally well, best first: a vertical and a horizontal pair each."""

    up: Annotated[NDArray[np.float64], Shape("a", 3)]  # (a, 3) unit vector, axes of the mount
    sigma_rad: Annotated[NDArray[np.float64], Shape("a")]  # (a,) of the vertical, per axis
    probability: Annotated[NDArray[np.float64], Shape("a")]  # (a,) their sum is 1
    # (a, m) of each line in each answer: 0 along the vertical, 1 and 2 along the horizontal pair; -1: none
    line_direction: Annotated[NDArray[np.int64], Shape("a", "m")]


@message(schema=118)
class VanishingDirections(Message):
    """Vanishing directions of one image and the lines that support them; stamp_ns is the image's. P IV, V.C.

    Axes are those of `camera_mount` (x forward, y left, z up), not of the lens. The sign of a direction is arbitrary.
    A message without directions is normal: `reason` states why. It may have several weighted answers instead.
    """

    camera_mount: CameraMount
    direction: Points64  # (n, 3) unit; the vertical first, if present
    sigma_rad: PerPointF64  # (n,) 1 sigma of each direction, per axis
    is_vertical: PerPointBool  # (n,)
    frame: PerPointI64  # (n,) index of its horizontal pair, 0 the strongest; -1: the vertical
    line_normal: Annotated[NDArray[np.float64], Shape("m", 3)]  # (m, 3) unit normals of the lines' great circles
    line_end: Annotated[NDArray[np.float64], Shape("m", 2, 3)]  # (m, 2, 3) unit rays of each line's end points
    # (m,) 1 sigma of the normal's rotation about the ray to the line's middle
    line_sigma_rad: Annotated[NDArray[np.float64], Shape("m")]
    line_direction: Annotated[NDArray[np.int64], Shape("m")]  # (m,) index of its direction; -1: none
    reason: str
    answers: WeightedAnswers | None = None  # where the image has no single answer; there are no directions then


class BranchState(enum.Enum):
    """Whether the 90 deg yaw ambiguity of the street is resolved."""

    NONE = 0  # no rotation available
    AMBIGUOUS = 1  # known up to multiples of 90 deg, or of 180 deg
    RESOLVED = 2
    OPEN = 3  # known up to multiples of 90 deg; the stage leaves the branch to the heading


@message(schema=91)
class RelativeRotation(Message):
    """R_vehicle_drone by both cameras; stamp_ns is the images'. P IV.

    The lines of two images may match at several yaws. Each match leaves the yaw open by multiples of 90 deg: branch k
    of a match is Rz(k 90 deg) R_vehicle_drone where the vehicle is level.
    """

    rotations: Annotated[NDArray[np.float64], Shape("n", 3, 3)]  # R_vehicle_drone, most probable first; empty: none
    covariances_rad2: Annotated[NDArray[np.float64], Shape("n", 3, 3)]  # of phi in R exp(phi), drone axes
    probabilities: PerPointF64  # (n,) that a match is right, on any branch; 1 - sum: that none is
    branch_probability: Annotated[NDArray[np.float64], Shape(4)]  # of branch k of the first match
    state: BranchState
    switches: int  # changes of the published branch since the start; each one is a jump
    reason: str  # what the matches rest on, or why there is none

    @property
    def R_vehicle_drone(self) -> Mat3 | None:
        """Branch 0 of the most probable match; None: no match."""
        return self.rotations[0] if len(self.rotations) else None

    @property
    def covariance_rad2(self) -> Mat3 | None:
        """Covariance of the most probable match; None: no match."""
        return self.covariances_rad2[0] if len(self.rotations) else None

    @staticmethod
    def one(
        stamp_ns: int,
        R_vehicle_drone: Mat3,
        covariance_rad2: Mat3,
        branch_probability: NDArray[np.float64],
        state: BranchState,
        switches: int,
        reason: str,
    ) -> RelativeRotation:
        """A message with a single match."""
        return RelativeRotation(
            stamp_ns=stamp_ns,
            rotations=R_vehicle_drone[None],
            covariances_rad2=covariance_rad2[None],
            probabilities=branch_probability.sum(keepdims=True),
            branch_probability=branch_probability,
            state=state,
            switches=switches,
            reason=reason,
        )

    @staticmethod
    def none(stamp_ns: int, reason: str, switches: int = 0) -> RelativeRotation:
        """A message without a match, with the reason."""
        return RelativeRotation(
            stamp_ns=stamp_ns,
            rotations=np.zeros((0, 3, 3)),
            covariances_rad2=np.zeros((0, 3, 3)),
            probabilities=np.zeros(0),
            branch_probability=np.zeros(4),
            state=BranchState.NONE,
            switches=switches,
            reason=reason,
        )


@message(schema=43)
class VisualMotion(Message):
    """Motion of the drone's camera between two images, in drone axes; stamp_ns is the later image's. P V.E.

    p_from = R_from_to p_to + |t| direction_from. One camera does not determine the length |t|.
    """

    from_ns: int  # the earlier image's stamp
    R_from_to: Mat3
    covariance_rad2: Mat3  # of phi in R exp(phi), drone axes at the later image
    direction_from: Vec3 | None  # unit; None: no translation observed
    direction_sigma_rad: float | None
    matches: int  # inlier features
    reason: str


@message(schema=44)
class FollowedFeatures(Message):
    """Features tracked from an earlier image to this one; stamp_ns is this image's. P V.B, V.E."""

    frame_id: str  # the camera
    from_ns: int  # the earlier image's stamp
    pixel_from: Annotated[NDArray[np.float64], Shape("n", 2)]  # column, row in the earlier image
    pixel_to: Annotated[NDArray[np.float64], Shape("n", 2)]
    residual_rad: PerPointF64  # epipolar error of each under the estimated camera motion
    agrees: PerPointBool  # inlier of that motion
