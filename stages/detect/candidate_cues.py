"""What other sensors add to a candidate's log-odds.

A cue is of one object: it adds nothing to others while it matches an accepted candidate. What cues add that are not
proven to be of the candidate ends below the threshold of acceptance.

Source: ours.
"""

from __future__ import annotations

from stages.cues.evidence import CueEvidence, CueWeights, ObjectPath, ObjectState
from stages.detect.candidate import Candidate
from stages.detect.candidate_table import CandidateTable
from stages.detect.flight import scatter_m
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import CueState, DroneCue

COMPARED_NS = 500_000_000  # a cue is compared with a candidate observed this recently,
COMPARED_PASSES = 5  # in so many scan passes
MARGIN_NATS = 0.5  # below the threshold of acceptance
CUE_PASSES = 3  # scan passes without which cues accept no candidate: before, a repeated false return is possible


class CandidateCues:
    """Compares candidates with the cues of the last seconds."""

    def __init__(self, weights: CueWeights, furthest_m: float, accept_nats: float, follow_up_nats: float) -> None:
        """Log-odds at which a candidate is accepted, and at which it is observed again."""
        self._weights, self._accept_nats, self._follow_up_nats = weights, accept_nats, follow_up_nats
        self._evidence = CueEvidence(weights, furthest_m)

    @property
    def known(self) -> bool:
        """Whether there are cues."""
        return self._evidence.known

    def reset(self) -> None:
        """Drop everything: the map frame is another one."""
        self._evidence.reset()

    def add(self, cue: DroneCue, trail: VehicleTrajectory, table: CandidateTable) -> CueState:
        """Add a measurement of another sensor, and compare it with the drones that the LiDAR alone would accept."""
        drones = [
            _object(c)
            for c in table
            if c.scan_passes >= COMPARED_PASSES
            and abs(cue.stamp_ns - c.seen_ns) < COMPARED_NS
            and c.own_log_odds >= self._accept_nats
        ]
        return self._evidence.add(cue, trail, drones)

    def add_to(self, c: Candidate, trail: VehicleTrajectory, table: CandidateTable) -> str:
        """Add the evidence to a candidate: its lowest of the last seconds, so that a short match is none.

        Returns the remark for people.
        """
        if not self.known:
            c.cue_nats = None
            return ""
        state = _object(c)
        nats, of_proven, remark = self._evidence.nats(state, trail, c.stamp_ns, c.proven_cues)
        if not remark:
            c.cue_nats = None
            return ""
        if nats > 0.0 and any(o is not c and o.accepted and (o.cue_nats or 0.0) > 0.0 for o in table):
            nats = 0.0
        if c.cue_nats is not None:
            since_s = (c.stamp_ns - c.cue_ns) * 1e-9
            nats = min(nats, c.cue_nats + self._weights.recovery_nats_per_s * since_s)
        c.cue_nats, c.cue_ns = nats, c.stamp_ns
        ceiling = max(self._accept_nats - MARGIN_NATS - c.single_log_odds, 0.0)
        if nats > max(of_proven, ceiling) and c.scan_passes >= CUE_PASSES:
            c.proven_cues |= self._evidence.proven(ObjectPath(c.path_ns, c.path_m, scatter_m(c.range_m)), trail)
            of_proven = self._evidence.nats(state, trail, c.stamp_ns, c.proven_cues).of_proven
        nats = min(nats, max(of_proven, ceiling) if c.scan_passes >= CUE_PASSES else ceiling)
        observed = min(c.single_log_odds, self._follow_up_nats)
        # a wrong cue does not end the observation of the drone
        c.single_log_odds = max(c.single_log_odds + nats, observed)
        return f"; cues {nats:+.1f} ({remark})"


def _object(c: Candidate) -> ObjectState:
    """Position and velocity of a candidate."""
    return ObjectState(c.stamp_ns, c.xyz_m, c.velocity_mps, c.p)
