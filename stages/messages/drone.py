"""Where the drone may be, and where it is, by the LiDAR. P III.B, III.C."""

from __future__ import annotations

import enum

from flow.message import Mat3, Message, PerPointBool, PerPointF64, PerPointI64, Points64, Vec3, message


@message(schema=31)
class Detections(Message):
    """Drone candidates of one search, best first. A list that is empty or wholly refused is a normal answer.

    stamp_ns: up to when was searched. The paper's detector judges whole sweeps by e = e_inner + e_outer, lower is
    better; the detector by evidence judges as data arrive and states a probability.
    """

    xyz_vehicle_m: Points64  # at seen_ns
    score: PerPointF64  # e, or ln of the odds that it is a drone
    e_inner: PerPointF64  # paper only, else 0
    e_outer: PerPointF64
    accepted: PerPointBool
    reasons: tuple[str, ...]  # one per candidate: why it was accepted or refused
    verdict: str  # one sentence for people: "drone at ..." or "no drone: ..."
    start_ns: int | None = None  # since when was searched; None: since the depth image's start
    seen_ns: PerPointI64 | None = None  # when each was seen last; None: at some time in the sweep
    velocity_vehicle_mps: Points64 | None = None
    probability: PerPointF64 | None = (
        None  # that it is a drone, as the detector judges; None: the score says nothing of it
    )
    candidate_id: PerPointI64 | None = None  # the same thing keeps its number


@message(schema=32)
class Candidates(Message):
    """What may be a drone right now and is worth another look, most probable first; told when it changes."""

    candidate_id: PerPointI64  # the same as in Detections
    xyz_vehicle_m: Points64  # predicted at stamp_ns
    velocity_vehicle_mps: Points64
    probability: PerPointF64
    seen_ns: PerPointI64
    looks: PerPointI64  # turns of the rotor in which it was hit
    reasons: tuple[str, ...]  # what speaks for and against, one each
    wander_mps: PerPointF64 | None = None  # level speed it says it has and heading unknown, beyond velocity_vehicle_mps
    detector_life: int = 0  # another one: it was started afresh, its numbers are of other things


class TrackingState(enum.Enum):
    """What the tracker is doing."""

    SEARCHING = 0  # no drone known
    CANDIDATE = 1  # something that may be one is being looked at
    TRACKING = 2
    COASTING = 3  # not seen now, predicted; the covariance grows
    LOST = 4  # had one, has none


@message(schema=33)
class DroneFix(Message):
    """Where the LiDAR saw the drone; stamp_ns is the weighted mean time of the returns used. P III.C."""

    xyz_vehicle_m: Vec3
    covariance_m2: Mat3
    hits: int  # returns used
    iterations: int
    shift_m: float  # last mean shift step
    track_id: int = 1  # which drone
    velocity_vehicle_mps: Vec3 | None = None  # relative to the vehicle; None: not estimated
    bias_covariance_m2: Mat3 | None = (
        None  # what of covariance_m2 is the same from fix to fix: calibration; None: not told
    )


@message(schema=34)
class TrackState(Message):
    """A track's state after each frame, with the reason for it in words, and where it is predicted at stamp_ns."""

    state: TrackingState
    reason: str
    hits: int  # returns within the radius in the frame just ended
    frame_s: float  # how long that frame was
    track_id: int = 1  # which drone; one that was lost and found elsewhere has a new number
    xyz_vehicle_m: Vec3 | None = None  # None: not predicted
    velocity_vehicle_mps: Vec3 | None = None
    covariance_m2: Mat3 | None = None  # of the position
