"""What the detector tells of its candidates: those worth another look, and the answer of a search, in words.

Source: ours.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable

import numpy as np

from stages.detect.candidate import Candidate
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import Candidates, Detections


def probability(odds: float) -> float:
    """P of ln odds."""
    return 1.0 / (1.0 + math.exp(-min(max(odds, -500.0), 500.0)))


def odds_of(p: float) -> float:
    """ln odds of a probability."""
    return math.log(p / (1.0 - p))


def candidates_message(
    bank: list[Candidate],
    trail: VehicleTrajectory,
    now_ns: int,
    detector_instance: int,
    at_most: int,
    usual_mps: Array64,
    spread_mps: float,
    said_mps: float,
) -> Candidates:
    """The candidates where they are if they are drones, most probable first; see `Candidate.as_drone`.

    `said_mps`: the level speed that the drone says it has, 0 when it is silent.
    """
    listed = sorted(bank, key=lambda c: -c.odds)[:at_most]
    undirected_speed_mps = [said_mps if c.hit_looks == 1 else 0.0 for c in listed]
    spreads_mps = [0.0 if wander else spread_mps for wander in undirected_speed_mps]
    drones = [c.as_drone(now_ns, usual_mps, spread) for c, spread in zip(listed, spreads_mps, strict=True)]
    seen = [trail.to_vehicle(now_ns, *drone) for drone in drones]
    return Candidates(
        stamp_ns=now_ns,
        candidate_id=np.array([c.number for c in listed], dtype=np.int64),
        xyz_vehicle_m=np.array([xyz for xyz, _ in seen]).reshape(-1, 3),
        velocity_vehicle_mps=np.array([v for _, v in seen]).reshape(-1, 3),
        probability=np.array([probability(c.odds) for c in listed], dtype=np.float64),
        seen_ns=np.array([c.seen_ns for c in listed], dtype=np.int64),
        scan_passes=np.array([c.hit_looks for c in listed], dtype=np.int64),
        reasons=tuple(c.why for c in listed),
        undirected_speed_mps=np.array(undirected_speed_mps, dtype=np.float64),
        detector_instance=detector_instance,
    )


def detections_message(
    bank: Iterable[Candidate], trail: VehicleTrajectory, start_ns: int, end_ns: int, refused: Counter[str], at_most: int
) -> Detections:
    """The answer of a search from start_ns to end_ns: its candidates where each was last seen, accepted ones first.

    One that is accepted and was not announced is told, too: its last sighting may have been judged a moment later.
    """
    seen_now = (c for c in bank if c.seen_ns >= start_ns or (c.accepted and not c.announced))
    listed = sorted(seen_now, key=lambda c: (not c.accepted, -c.odds))[:at_most]
    seen = [trail.to_vehicle(c.seen_ns, c.xyz_m, c.velocity_mps) for c in listed]
    xyz_vehicle_m = np.array([xyz for xyz, _ in seen]).reshape(-1, 3)
    accepted = sum(c.accepted for c in listed)
    if accepted:
        x, y, z = xyz_vehicle_m[0]
        summary = f"drone at ({x:.2f}, {y:.2f}, {z:.2f}) m, {100 * probability(listed[0].odds):.1f} %: {listed[0].why}"
        summary += f"; {accepted - 1} more" if accepted > 1 else ""
    else:
        why = ", ".join(f"{n} x '{reason}'" for reason, n in refused.most_common(3) if n)
        summary = f"no drone: {sum(refused.values())} short returns refused at once ({why or 'none'})"
        if listed:
            summary += f"; the best candidate, {100 * probability(listed[0].odds):.1f} %: {listed[0].why}"
    return Detections(
        stamp_ns=end_ns,
        xyz_vehicle_m=xyz_vehicle_m,
        score=np.array([c.odds for c in listed], dtype=np.float64),
        e_inner=np.zeros(len(listed)),
        e_outer=np.zeros(len(listed)),
        accepted=np.array([c.accepted for c in listed], dtype=np.bool_),
        reasons=tuple(c.why for c in listed),
        summary=summary,
        start_ns=start_ns,
        seen_ns=np.array([c.seen_ns for c in listed], dtype=np.int64),
        velocity_vehicle_mps=np.array([v for _, v in seen]).reshape(-1, 3),
        probability=np.array([probability(c.odds) for c in listed], dtype=np.float64),
        candidate_id=np.array([c.number for c in listed], dtype=np.int64),
    )
