"""Physical features of a candidate: the input of the trained model, and the columns of a run's candidate log.

`features_of` is a pure function of a candidate's history. A feature that is not available (no telemetry, too few
observations for a speed) is NaN; so are those by the IMU while telemetry is compared, which was made with the same IMU.
VERSION changes with the list or the meaning of a feature.

Each that a model uses is monotone: what has no sign by physics, as the range, climb or age of a candidate, tells more
of the flights of a simulator than of the candidate. The range is logged only. What counts against a drone chord by
chord or pass by pass is a share of them: their number would grow with the length of the flight.

Features depend on the model of the run, which decides which candidates are kept and counted. Train on replays with the
model that the new one replaces, then again on replays with the new one.

Source: ours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stages.detect.candidate import Candidate
from stages.detect.flight import Motion, straight_flight
from stages.detect.motion_log_ratios import MotionLogRatios
from stages.geometry.frames import Array64
from stages.kernels.detect.first_observations import NONE_M, PULSE_RAD

VERSION = 8
WIRE_M, SINGLE_RETURN_WIRE_M = 20.0, 30.0  # to these ranges a wire returns pulses; several a scan pass, and one
NOT_DISPLACED_NATS = 3.0  # cap of the log ratio over a static object that may seem to move as far


class Feature(NamedTuple):
    """A feature: `monotone` +1 or -1, whether it makes a drone more or less probable by physics.

    0 for the range, which no model uses.
    """

    name: str
    monotone: int
    text: str
    group: str  # of features that an ablation leaves out together


FEATURES: tuple[Feature, ...] = (
    Feature("range_m", 0, "range", "range"),
    Feature("existence_nats", 1, "existence by returns and pass-throughs", "existence"),
    Feature("false_per_s", -1, "false returns at this range", "existence"),
    Feature("scan_passes", 1, "scan passes with a return", "existence"),
    Feature("first_returns", 1, "returns of the first scan pass", "returns"),
    Feature("return_ratio", 1, "returns over those of a beam across the drone", "returns"),
    Feature("return_count_nats", 1, "returns of each scan pass, as a drone's and not a wire's", "returns"),
    Feature("free_sectors", 1, "sectors around it that pulses flew through", "surroundings"),
    Feature("least_free", 1, "scan passes in which its least observed sector was free", "surroundings"),
    Feature("neighbour_score", -1, "objects next to it", "surroundings"),
    Feature("isolated_score", 1, "recent scan passes without a neighbour", "surroundings"),
    Feature("large_object_m", 1, "distance to a wall, crown or trunk", "surroundings"),
    Feature("large_object_share", -1, "share of scan passes next to a large object", "surroundings"),
    Feature("too_long_share", -1, "share of scan passes in which it was longer than the drone", "shape"),
    Feature("rough_share", 1, "share of chords that are not smooth and round", "shape"),
    Feature("relative_speed_mps", -1, "speed relative to the vehicle", "motion"),
    Feature("acceleration_mps2", -1, "acceleration", "motion"),
    Feature("fastest_mps", -1, "highest speed that it significantly had", "motion"),
    Feature("hardest_mps2", -1, "highest acceleration that it significantly had", "motion"),
    Feature("top_mps", -1, "speed that it reaches, with its turn", "motion"),
    Feature("calm_s", 1, "time in which it flew more calmly than a bird cruises", "motion"),
    Feature("straight_mps", 1, "mean speed along its path", "motion"),
    Feature("straight_sigmas", 1, "mean speed along its path, in its sigmas", "motion"),
    Feature("moves", 1, "it moved over ground", "motion"),
    Feature("near_rejected", -1, "a rejected object near it", "surroundings"),
    Feature("revisited", -1, "a rejected object at its position", "surroundings"),
    Feature("passes_since_reacquired", 1, "scan passes since it was reacquired", "telemetry"),
    Feature("over_static_nats", 1, "moves as the drone's odometry, not as a static object", "telemetry"),
    Feature("over_bird_nats", 1, "moves as the drone's odometry, not as a bird", "telemetry"),
    Feature("over_balloon_nats", 1, "moves as the drone's odometry, not as a balloon", "telemetry"),
    Feature("displaced_nats", 1, "moves as the drone's odometry, farther than a static one seems to", "telemetry"),
    Feature("imu_over_static_nats", 1, "accelerates as the drone's IMU, not as a static object", "imu"),
    Feature("imu_over_bird_nats", 1, "accelerates as the drone's IMU, not as a bird", "imu"),
    Feature("imu_over_balloon_nats", 1, "accelerates as the drone's IMU, not as a balloon", "imu"),
)
GROUPS = tuple(dict.fromkeys(feature.group for feature in FEATURES))
NAMES = tuple(feature.name for feature in FEATURES)
TELEMETRY = NAMES.index("over_static_nats")  # NaN: not compared with telemetry
FREE_SPACE = tuple(
    NAMES.index(name) for name in ("free_sectors", "least_free", "neighbour_score", "isolated_score")
)  # measured around a candidate
NO_TELEMETRY = (math.nan,) * 4
NO_IMU = NO_TELEMETRY[1:]


def features_of(c: Candidate, span_m: float, motion_known: bool) -> Array64:
    """Features (len(FEATURES),) of a candidate; NaN: not available. `first_features` gives those of one observation.

    `span_m`: of the drone; `motion_known`: whether positions in frame map are those over ground.
    """
    passes, free = float(c.scan_passes), c.free.tolist()
    m, slower = c.motion or NOT_MEASURED, c.slower_motion or NOT_MEASURED
    speed, sigmas = straight_flight(c.path_ns, c.path_m, c.range_m)
    ratios, imu = c.log_ratios, c.imu_log_ratios
    since = math.nan if not c.reacquired_at else passes - c.reacquired_at
    telemetry = NO_TELEMETRY if ratios is None else (*ratios[:3], displaced_nats(c, ratios))
    return np.array(
        [
            c.range_m,
            c.existence_nats,
            c.false_per_s,
            passes,
            c.first_returns,
            c.returns / c.observations * PULSE_RAD * c.range_m / span_m,
            c.return_count_nats,
            sum([times >= 1.0 for times in free]),
            min(free),
            c.neighbour_score,
            c.isolated_score,
            min(c.large_object_m, NONE_M),
            c.large_object_passes / c.observations,
            min(c.too_long_passes / passes, 1.0),
            (c.rough_chords + 1.0) / (c.round_chords + c.rough_chords + 2.0),  # by Laplace's rule of succession
            slower.speed_mps,
            m.acceleration_mps2,
            c.fastest_mps,
            c.hardest_mps2,
            slower.top_mps,
            c.calm_s,
            speed,
            sigmas,
            c.moves(motion_known),
            c.near_rejected,
            c.revisited,
            since,
            *telemetry,
            *(NO_IMU if imu is None else imu[:3]),
        ],
        dtype=np.float64,
    )


def displaced_nats(c: Candidate, ratios: MotionLogRatios) -> float:
    """Log ratio [nats] of telemetry over the static object that would be visible at the candidate's range.

    A wire to `WIRE_M`, or to `SINGLE_RETURN_WIRE_M` if the candidate returns singly; beyond, a static object. A lamp
    whose pole is invisible, or a wire, may seem to move (`Candidate.apparent_motion_m`): a drone's odometry that moved
    less is little evidence, unless the candidate agreed with it in open air before.
    """
    wire = c.range_m < (SINGLE_RETURN_WIRE_M if c.returns_singly else WIRE_M)
    nats = ratios.over_wire if wire else ratios.over_static
    moved = ratios.displacement_m > c.apparent_motion_m
    return max(nats if moved else min(nats, NOT_DISPLACED_NATS), c.flight_log_ratio)


NOT_MEASURED = Motion(math.nan, math.nan, math.nan, math.nan)
