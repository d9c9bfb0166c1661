"""What may be looked at: the tracks, and the candidates that are worth another look, each where it is predicted.

Source: ours, for P III.C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stages.aim.search_offset import Look
from stages.geometry.frames import Array64
from stages.messages import Candidates, TrackingState, TrackState

TRACK_OWN_M = 1.0  # the detector tells of what is tracked, too
MOST_DONE = 256
FORGOTTEN_NS = 1_200_000_000  # a candidate nobody spoke of for so long
GONE_NS = 8_000_000_000  # and a track: its tracker was started afresh, or sees nothing

Key = tuple[str, int]


@dataclass(slots=True, eq=False)
class Target:
    """A place to look at, moving."""

    key: Key
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    sigma_m: float
    sure: bool  # a track, not a candidate
    probability: float = 1.0
    glance: bool = False  # looked at in passing, the sweep goes on
    seen_looks: int = 0  # turns in which the detector saw it
    looks: int = 0  # planned for it
    heard_ns: int = 0  # seen, if it is a candidate
    undirected_speed_mps: float = 0.0  # level, nobody knows whither
    tried: list[Look] = field(default_factory=lambda: list[Look]())  # since it was seen last, the newest

    def at(self, stamp_ns: int) -> Array64:
        return self.xyz_m + self.velocity_mps * ((stamp_ns - self.stamp_ns) * 1e-9)

    def reach_m(self, stamp_ns: int) -> float:
        """How far beside its place it may be: one sigma; or how far it has flown since it was seen, if it wanders."""
        if self.undirected_speed_mps:
            return self.undirected_speed_mps * max(stamp_ns - self.heard_ns, 0) * 1e-9
        return self.sigma_m


@dataclass(slots=True, eq=False)
class Targets:
    """All of them, and which candidates are left alone for how long."""

    known: dict[Key, Target] = field(default_factory=lambda: dict[Key, Target]())
    _rests: dict[int, tuple[int, int]] = field(default_factory=lambda: dict[int, tuple[int, int]]())  # until, times
    _detector_life: int | None = None  # that counts the candidates

    def get(self, key: Key | None) -> Target | None:
        """One of them; None when it is gone."""
        return None if key is None else self.known.get(key)

    def hear_candidates(self, candidates: Candidates, least_probability: float) -> None:
        """What is worth another look now."""
        if candidates.detector_instance != self._detector_life:  # those before were of other things
            self._detector_life = candidates.detector_instance
            self._rests.clear()
            self.known = {key: target for key, target in self.known.items() if target.sure}
        for key in [key for key in self.known if key[0] == "candidate"]:
            if key[1] not in candidates.candidate_id:
                del self.known[key]
        for i, number in enumerate(candidates.candidate_id.tolist()):
            if candidates.probability[i] < least_probability:
                self.known.pop(("candidate", number), None)
                continue
            rest_until_ns, _ = self._rests.get(number, (0, 0))
            if candidates.stamp_ns < rest_until_ns:
                continue
            old = self.known.get(("candidate", number))
            again = old is None or int(candidates.seen_ns[i]) > old.heard_ns
            age_s = (candidates.stamp_ns - int(candidates.seen_ns[i])) * 1e-9
            self.known[("candidate", number)] = Target(
                key=("candidate", number),
                stamp_ns=candidates.stamp_ns,
                xyz_m=candidates.xyz_vehicle_m[i],
                velocity_mps=candidates.velocity_vehicle_mps[i],
                sigma_m=0.15 + 1.0 * age_s,  # seen some times, its velocity is known to a metre a second
                sure=False,
                probability=float(candidates.probability[i]),
                seen_looks=int(candidates.scan_passes[i]),
                glance=old.glance if old else False,
                looks=old.looks if old else 0,
                heard_ns=int(candidates.seen_ns[i]),
                undirected_speed_mps=0.0
                if candidates.undirected_speed_mps is None
                else float(candidates.undirected_speed_mps[i]),
                tried=[] if old is None or again else old.tried,
            )

    def hear_state(self, state: TrackState) -> None:
        """Where a track is predicted; one that is lost is no target."""
        key = ("track", state.track_id)
        if state.state is TrackingState.SEARCHING and state.track_id == 0:  # it follows nothing
            for one in [one for one, target in self.known.items() if target.sure]:
                del self.known[one]
        if state.state is TrackingState.LOST or state.state is TrackingState.SEARCHING:
            self.known.pop(key, None)
        if state.state not in (TrackingState.TRACKING, TrackingState.COASTING) or state.xyz_vehicle_m is None:
            return
        old = self.known.get(key)
        sigma = 0.3 if state.covariance_m2 is None else math.sqrt(float(np.linalg.eigvalsh(state.covariance_m2)[-1]))
        velocity = np.zeros(3) if state.velocity_vehicle_mps is None else state.velocity_vehicle_mps
        seen = state.state is TrackingState.TRACKING
        self.known[key] = Target(
            key=key,
            stamp_ns=state.stamp_ns,
            xyz_m=state.xyz_vehicle_m,
            velocity_mps=velocity,
            sigma_m=sigma,
            sure=True,
            looks=old.looks if old else 0,
            tried=old.tried if old and state.hits == 0 else [],
            heard_ns=state.stamp_ns if seen or old is None else old.heard_ns,
        )

    def tracks(self, sigma_m: float) -> list[Target]:
        """Those known better than this, by number."""
        return sorted((t for t in self.known.values() if t.sure and t.sigma_m < sigma_m), key=lambda t: t.key)

    def candidates(self, now_ns: int) -> list[Target]:
        """Those that are not a track's own place."""
        tracks = [t.at(now_ns) for t in self.known.values() if t.sure]
        maybe = [t for t in self.known.values() if not t.sure]
        return [t for t in maybe if not any(float(np.linalg.norm(t.at(now_ns) - x)) < TRACK_OWN_M for x in tracks)]

    def tidy(self, now_ns: int, most_looks: int, rest_s: float) -> None:
        """Leave alone the candidates that had their looks; forget what nobody speaks of."""
        for key, target in tuple(self.known.items()):
            if target.sure:
                if now_ns - target.stamp_ns > GONE_NS:
                    del self.known[key]
                continue
            if target.looks >= most_looks:
                self.leave(target, now_ns, rest_s)
            elif now_ns - target.heard_ns > FORGOTTEN_NS:
                del self.known[key]

    def leave(self, target: Target, now_ns: int, rest_s: float) -> None:
        """Looked at long enough: leave it alone for a while, each time for longer."""
        number = target.key[1]
        _, times = self._rests.get(number, (0, 0))
        self._rests[number] = now_ns + round(rest_s * 2 ** min(times, 4) * 1e9), times + 1
        self.known.pop(target.key, None)
        if len(self._rests) > MOST_DONE:
            del self._rests[min(self._rests)]  # the oldest number
