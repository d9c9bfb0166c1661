"""Targets of the aim stage: tracks, and candidates that need further observations, with their predicted positions.

Source: ours, for P III.C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stages.aim.search_offset import MissedObservation
from stages.geometry.frames import Array64
from stages.messages import Candidates, TrackingState, TrackState

TRACK_GATE_M = 1.0  # a candidate this near a track is the track's own drone
MAX_COOLDOWNS = 256
MAX_BACKOFF = 4  # doublings of the cool-down
CANDIDATE_TIMEOUT_NS = 1_200_000_000
TRACK_TIMEOUT_NS = 8_000_000_000  # without a state: the tracker was restarted, or receives nothing

Key = tuple[str, int, int]  # "track" or "candidate", number of the chain, and its id within the chain


@dataclass(slots=True, eq=False)
class Target:
    """A moving point in the vehicle frame."""

    key: Key
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    sigma_m: float
    is_track: bool  # else a candidate
    probability: float = 1.0
    keeps_sweep: bool = False  # it is observed without an interruption of the sweep
    scan_passes: int = 0  # in which the detector observed it
    observations: int = 0  # planned for it
    observed_ns: int = 0  # its last planned observation
    seen_ns: int = 0  # its last return
    undirected_speed_mps: float = 0.0  # horizontal, in an unknown direction
    missed: list[MissedObservation] = field(default_factory=lambda: list[MissedObservation]())  # since its last return

    def at(self, stamp_ns: int) -> Array64:
        """Position (3,) [m] predicted with constant velocity."""
        return self.xyz_m + self.velocity_mps * ((stamp_ns - self.stamp_ns) * 1e-9)

    def spread_m(self, stamp_ns: int) -> float:
        """One sigma of its position, or the distance flown since its last return if its heading is unknown."""
        if self.undirected_speed_mps:
            return self.undirected_speed_mps * max(stamp_ns - self.seen_ns, 0) * 1e-9
        return self.sigma_m


@dataclass(slots=True, eq=False)
class Targets:
    """All targets, and the candidates that are excluded for a cool-down time."""

    by_key: dict[Key, Target] = field(default_factory=lambda: dict[Key, Target]())
    chains: set[int] = field(default_factory=lambda: set[int]())  # of which there were messages
    _cooldowns: dict[Key, tuple[int, int]] = field(default_factory=lambda: dict[Key, tuple[int, int]]())  # until, count
    # of each chain; candidate ids are unique within one
    _detector_instance: dict[int, int] = field(default_factory=lambda: dict[int, int]())

    def get(self, key: Key | None) -> Target | None:
        """The target, or None when it has ended."""
        return None if key is None else self.by_key.get(key)

    def update_candidates(self, candidates: Candidates, min_probability: float, chain: int = 1) -> None:
        """Replace a chain's candidates by those of at least this probability that are not in a cool-down."""
        self.chains.add(chain)
        kind = "candidate", chain
        own = [key for key in self.by_key if key[:2] == kind]
        if candidates.detector_instance != self._detector_instance.get(chain):  # its ids are unrelated to earlier ones
            self._detector_instance[chain] = candidates.detector_instance
            self._cooldowns = {key: until for key, until in self._cooldowns.items() if key[:2] != kind}
            ended = own
        else:
            ended = [key for key in own if key[2] not in candidates.candidate_id]
        for key in ended:
            del self.by_key[key]
        for i, number in enumerate(candidates.candidate_id.tolist()):
            key = (*kind, number)
            if candidates.probability[i] < min_probability:
                self.by_key.pop(key, None)
                continue
            cooldown_until_ns, _ = self._cooldowns.get(key, (0, 0))
            if candidates.stamp_ns < cooldown_until_ns:
                continue
            old = self.by_key.get(key)
            returned = old is None or int(candidates.seen_ns[i]) > old.seen_ns
            age_s = (candidates.stamp_ns - int(candidates.seen_ns[i])) * 1e-9
            self.by_key[key] = Target(
                key=key,
                stamp_ns=candidates.stamp_ns,
                xyz_m=candidates.xyz_vehicle_m[i],
                velocity_mps=candidates.velocity_vehicle_mps[i],
                sigma_m=0.15 + 1.0 * age_s,  # after several observations one sigma of its velocity is 1 m/s
                is_track=False,
                probability=float(candidates.probability[i]),
                scan_passes=int(candidates.scan_passes[i]),
                keeps_sweep=old.keeps_sweep if old else False,
                observations=old.observations if old else 0,
                seen_ns=int(candidates.seen_ns[i]),
                undirected_speed_mps=0.0
                if candidates.undirected_speed_mps is None
                else float(candidates.undirected_speed_mps[i]),
                observed_ns=old.observed_ns if old else 0,
                missed=[] if old is None or returned else old.missed,
            )

    def update_track(self, state: TrackState, chain: int = 1) -> None:
        """Set the predicted position of a chain's track. A track that is LOST or SEARCHING is no target."""
        self.chains.add(chain)
        key = ("track", chain, state.track_id)
        if state.state is TrackingState.SEARCHING and state.track_id == 0:  # the tracker has no track
            for track_key in [track_key for track_key in self.by_key if track_key[:2] == key[:2]]:
                del self.by_key[track_key]
        if state.state is TrackingState.LOST or state.state is TrackingState.SEARCHING:
            self.by_key.pop(key, None)
        if state.state not in (TrackingState.TRACKING, TrackingState.COASTING) or state.xyz_vehicle_m is None:
            return
        old = self.by_key.get(key)
        sigma_m = 0.3 if state.covariance_m2 is None else math.sqrt(float(np.linalg.eigvalsh(state.covariance_m2)[-1]))
        velocity_mps = np.zeros(3) if state.velocity_vehicle_mps is None else state.velocity_vehicle_mps
        seen = state.state is TrackingState.TRACKING
        self.by_key[key] = Target(
            key=key,
            stamp_ns=state.stamp_ns,
            xyz_m=state.xyz_vehicle_m,
            velocity_mps=velocity_mps,
            sigma_m=sigma_m,
            is_track=True,
            observations=old.observations if old else 0,
            observed_ns=old.observed_ns if old else 0,
            missed=old.missed if old and state.hits == 0 else [],
            seen_ns=state.stamp_ns if seen or old is None else old.seen_ns,
        )

    def tracks(self, max_sigma_m: float) -> list[Target]:
        """Tracks with a smaller position sigma than this, ordered by chain and id.

        Of tracks of several chains that follow one object, nearer to each other than TRACK_GATE_M, the first.
        """
        found: list[Target] = []
        for track in sorted((t for t in self.by_key.values() if t.is_track), key=lambda t: t.key):
            others_m = (np.linalg.norm(track.xyz_m - t.at(track.stamp_ns)) for t in found if t.key[1] != track.key[1])
            if track.sigma_m < max_sigma_m and all(float(away_m) >= TRACK_GATE_M for away_m in others_m):
                found.append(track)
        return found

    def candidates(self, stamp_ns: int) -> list[Target]:
        """Candidates that are not within the gate of a track."""
        tracks = [t.at(stamp_ns) for t in self.by_key.values() if t.is_track]
        found = [t for t in self.by_key.values() if not t.is_track]
        return [t for t in found if not any(float(np.linalg.norm(t.at(stamp_ns) - x)) < TRACK_GATE_M for x in tracks)]

    def expire(self, stamp_ns: int, max_observations: int, cooldown_s: float) -> None:
        """Exclude candidates that had `max_observations`; delete targets without recent messages."""
        for key, target in tuple(self.by_key.items()):
            if target.is_track:
                if stamp_ns - target.stamp_ns > TRACK_TIMEOUT_NS:
                    del self.by_key[key]
                continue
            if target.observations >= max_observations:
                self.exclude(target, stamp_ns, cooldown_s)
            elif stamp_ns - target.seen_ns > CANDIDATE_TIMEOUT_NS:
                del self.by_key[key]

    def exclude(self, target: Target, stamp_ns: int, cooldown_s: float) -> None:
        """Ignore a candidate for the cool-down time, which doubles with each repetition, up to 16-fold."""
        _, count = self._cooldowns.get(target.key, (0, 0))
        self._cooldowns[target.key] = stamp_ns + round(cooldown_s * 2 ** min(count, MAX_BACKOFF) * 1e9), count + 1
        self.by_key.pop(target.key, None)
        if len(self._cooldowns) > MAX_COOLDOWNS:
            del self._cooldowns[min(self._cooldowns)]  # the oldest id of a chain
