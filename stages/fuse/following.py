"""Which track is fused: one drone's, the lowest number that is TRACKING, kept until it is lost.

Source: ours.
"""

from __future__ import annotations

from stages.messages import TrackingState, TrackState

HOLDS = (TrackingState.TRACKING, TrackingState.COASTING)
SILENT_NS = 2_000_000_000  # without TrackStates a track that gave no fix for so long makes room for another


class Following:
    """The number of the track that is followed, 0 for none."""

    def __init__(self, wanted: int | None) -> None:
        """`wanted`: follow this track and no other."""
        self._wanted = wanted
        self._states: dict[int, TrackingState] = {}
        self._fix_ns = 0
        self.number = 0
        self.reason = "no drone is tracked"

    def hear(self, state: TrackState) -> None:
        """What the tracker says of a track."""
        if state.track_id == 0 or state.state is TrackingState.CANDIDATE:
            return
        if state.state in HOLDS:
            self._states[state.track_id] = state.state
            if state.track_id == self.number:
                self.reason = state.reason
            return
        self._states.pop(state.track_id, None)
        if state.track_id == self.number:
            self.number, self.reason = 0, f"the tracker lost it: {state.reason}"

    def takes(self, track_id: int, stamp_ns: int) -> bool:
        """Whether a fix of a track is to be used; chooses a track where none is followed."""
        if self._wanted is not None and track_id != self._wanted:
            return False
        if self.number not in self._states and stamp_ns - self._fix_ns > SILENT_NS:
            self.number = 0
        if self.number == 0:
            tracked = [number for number, state in self._states.items() if state is TrackingState.TRACKING]
            if tracked and self._wanted is None and track_id > min(tracked):
                return False
            self.number = track_id
        if track_id != self.number:
            return False
        self._fix_ns = max(self._fix_ns, stamp_ns)
        return True
