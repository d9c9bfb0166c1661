"""Which track is fused: the lowest number that is TRACKING, kept until it is lost.

A restarted tracker does not report the end of its old tracks and numbers from 1 again: a track that it does not report,
while it reports others, has ended.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterable

from stages.messages import TrackingState, TrackState

HOLDS = (TrackingState.TRACKING, TrackingState.COASTING)
SILENT_NS = 2_000_000_000  # a track without a report for this long has ended
STEP_NS = 200_000_000  # of a pause of all reports at most this much counts


class TrackContinuity:
    """The number of the track that is followed, 0 for none."""

    def __init__(self, wanted: int | None) -> None:
        """`wanted`: follow this track and no other."""
        self._wanted = wanted
        self._states: dict[int, tuple[TrackingState, int]] = {}  # with the time of the report, counted over reports
        self._spoken_ns, self._newest_ns = 0, 0
        self._fix_ns = 0
        self.number = 0
        self.reason = "no drone is tracked"

    def add(self, state: TrackState) -> None:
        """Add the state of a track."""
        if state.track_id == 0 and state.state is TrackingState.SEARCHING:
            self._forget(self._states, state.reason)
        if state.track_id == 0 or state.state is TrackingState.CANDIDATE:
            return
        self._spoken_ns += min(max(state.stamp_ns - self._newest_ns, 0), STEP_NS)
        self._newest_ns = max(state.stamp_ns, self._newest_ns)
        old = [number for number, (_, at_ns) in self._states.items() if self._spoken_ns - at_ns > SILENT_NS]
        self._forget(old, "no report from the tracker")
        if state.state in HOLDS:
            self._states[state.track_id] = state.state, self._spoken_ns
            if state.track_id == self.number:
                self.reason = state.reason
            return
        self._forget([state.track_id], state.reason)

    def _forget(self, numbers: Iterable[int], why: str) -> None:
        for number in tuple(numbers):
            self._states.pop(number, None)
            if number == self.number:
                self.number, self.reason = 0, f"the tracker lost it: {why}"

    def accepts(self, track_id: int, stamp_ns: int) -> bool:
        """Whether a fix of a track is used; selects a track where none is followed."""
        if self._wanted is not None and track_id != self._wanted:
            return False
        if self.number not in self._states and stamp_ns - self._fix_ns > SILENT_NS:
            self.number = 0
        if self.number == 0:
            tracked = [number for number, (state, _) in self._states.items() if state is TrackingState.TRACKING]
            if tracked and self._wanted is None and track_id > min(tracked):
                return False
            self.number = track_id
        if track_id != self.number:
            return False
        self._fix_ns = max(self._fix_ns, stamp_ns)
        return True
