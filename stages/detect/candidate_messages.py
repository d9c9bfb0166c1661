"""Messages of the detector: promising candidates, and the result of a search with its summary.

Source: ours.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from stages.detect.candidate import Candidate
from stages.detect.trained.features import NAMES
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.geometry.trajectory import positions_in_vehicle
from stages.messages import CandidateEvidence, CandidateLog, Candidates, Detections


class Classified(NamedTuple):
    """A candidate's newest classification, at its last observation."""

    number: int
    seen_ns: int
    xyz_map_m: Array64  # (3,)
    log_odds: float
    features: Array64


def candidate_log(
    classified: Iterable[Classified], trail: VehicleTrajectory, now_ns: int, detector_instance: int
) -> CandidateLog:
    """The classified candidates of a slice."""
    listed = list(classified)
    seen_ns = np.array([c.seen_ns for c in listed], dtype=np.int64)
    xyz_map_m = np.array([c.xyz_map_m for c in listed]).reshape(-1, 3)
    return CandidateLog(
        stamp_ns=now_ns,
        candidate_id=np.array([c.number for c in listed], dtype=np.int64),
        seen_ns=seen_ns,
        xyz_vehicle_m=positions_in_vehicle(*trail.at_each(seen_ns), xyz_map_m),
        probability=np.array([probability(c.log_odds) for c in listed], dtype=np.float64),
        features=np.array([c.features for c in listed]),
        feature_names=NAMES,
        detector_instance=detector_instance,
    )


def probability(log_odds: float) -> float:
    """Probability of log-odds."""
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -500.0), 500.0)))


def log_odds_of(p: float) -> float:
    """Log-odds of a probability."""
    return math.log(p / (1.0 - p))


def candidates_message(
    table: list[Candidate],
    trail: VehicleTrajectory,
    now_ns: int,
    detector_instance: int,
    at_most: int,
    accept_probability: float,
    expected_mps: Array64,
    spread_mps: float,
    reported_mps: float,
) -> Candidates:
    """The candidates as predicted if they are drones, most probable first; see `Candidate.predict_as_drone`.

    `reported_mps`: the level speed that the drone reports, 0 without telemetry.
    """
    listed = sorted(table, key=lambda c: -c.log_odds)[:at_most]
    undirected_speed_mps = [reported_mps if c.scan_passes == 1 else 0.0 for c in listed]
    spreads_mps = [0.0 if wander else spread_mps for wander in undirected_speed_mps]
    drones = [c.predict_as_drone(now_ns, expected_mps, spread) for c, spread in zip(listed, spreads_mps, strict=True)]
    positions = [trail.to_vehicle(now_ns, *drone) for drone in drones]
    return Candidates(
        stamp_ns=now_ns,
        candidate_id=np.array([c.number for c in listed], dtype=np.int64),
        xyz_vehicle_m=np.array([xyz for xyz, _ in positions]).reshape(-1, 3),
        velocity_vehicle_mps=np.array([v for _, v in positions]).reshape(-1, 3),
        probability=np.array([probability(c.log_odds) for c in listed], dtype=np.float64),
        seen_ns=np.array([c.seen_ns for c in listed], dtype=np.int64),
        scan_passes=np.array([c.scan_passes for c in listed], dtype=np.int64),
        reasons=tuple(c.reason for c in listed),
        accept_probability=accept_probability,
        undirected_speed_mps=np.array(undirected_speed_mps, dtype=np.float64),
        detector_instance=detector_instance,
    )


def detections_message(
    table: Iterable[Candidate],
    trail: VehicleTrajectory,
    start_ns: int,
    end_ns: int,
    rejected: Counter[str],
    at_most: int,
) -> Detections:
    """The result of a search from start_ns to end_ns: candidates at their last observation, accepted ones first.

    An accepted candidate that was not announced is included even if its last observation precedes start_ns.
    """
    recent = (c for c in table if c.seen_ns >= start_ns or (c.accepted and not c.announced))
    listed = sorted(recent, key=lambda c: (not c.accepted, -c.log_odds))[:at_most]
    positions = [trail.to_vehicle(c.seen_ns, c.xyz_m, c.velocity_mps) for c in listed]
    xyz_vehicle_m = np.array([xyz for xyz, _ in positions]).reshape(-1, 3)
    accepted = sum(c.accepted for c in listed)
    if accepted:
        x, y, z = xyz_vehicle_m[0]
        summary = (
            f"drone at ({x:.2f}, {y:.2f}, {z:.2f}) m, {100 * probability(listed[0].log_odds):.1f} %: {listed[0].reason}"
        )
        summary += f"; {accepted - 1} more" if accepted > 1 else ""
    else:
        why = ", ".join(f"{n} x '{reason}'" for reason, n in rejected.most_common(3) if n)
        summary = f"no drone: {sum(rejected.values())} short returns rejected at once ({why or 'none'})"
        if listed:
            summary += f"; the best candidate, {100 * probability(listed[0].log_odds):.1f} %: {listed[0].reason}"
    return Detections(
        stamp_ns=end_ns,
        xyz_vehicle_m=xyz_vehicle_m,
        accepted=np.array([c.accepted for c in listed], dtype=np.bool_),
        reasons=tuple(c.reason for c in listed),
        summary=summary,
        evidence=CandidateEvidence(
            start_ns=start_ns,
            candidate_id=np.array([c.number for c in listed], dtype=np.int64),
            seen_ns=np.array([c.seen_ns for c in listed], dtype=np.int64),
            velocity_vehicle_mps=np.array([v for _, v in positions]).reshape(-1, 3),
            log_odds=np.array([c.log_odds for c in listed], dtype=np.float64),
            probability=np.array([probability(c.log_odds) for c in listed], dtype=np.float64),
        ),
    )
