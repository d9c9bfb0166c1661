"""Which track is fused, by the tracker's reports."""

from __future__ import annotations

import pytest

from stages.fuse.track_continuity import TrackContinuity
from stages.messages import TrackingState
from tests.stages.fuse.fuse_inputs import track
from tests.stages.fuse.imu_flights import S, ns


def test_without_track_states_the_first_drone_is_kept_until_it_is_silent():
    continuity = TrackContinuity(None)
    assert continuity.accepts(5, 0)
    assert not continuity.accepts(2, S)
    assert continuity.accepts(5, S)
    assert continuity.accepts(2, 4 * S)


def test_only_the_wanted_track_is_accepted():
    continuity = TrackContinuity(4)
    assert not continuity.accepts(1, 0)
    assert continuity.accepts(4, S)
    assert not continuity.accepts(1, 9 * S)


def test_a_candidate_is_no_track():
    continuity = TrackContinuity(None)
    continuity.add(track(0.0, TrackingState.CANDIDATE, 1))
    continuity.add(track(0.0, TrackingState.TRACKING, 2))
    assert continuity.accepts(2, 0)
    assert continuity.number == 2


def test_a_restarted_tracker_that_searches_ends_the_track():
    continuity = TrackContinuity(None)
    continuity.add(track(0.0, TrackingState.TRACKING, 3))
    assert continuity.accepts(3, ns(0.0))
    continuity.add(track(0.1, TrackingState.SEARCHING, 0, "restarted"))
    assert (continuity.number, continuity.reason) == (0, "the tracker lost it: restarted")
    continuity.add(track(0.3, TrackingState.TRACKING, 1))
    assert continuity.accepts(1, ns(0.3))


@pytest.mark.parametrize("pause_s", [0.0, 5.0])
def test_a_track_that_is_no_longer_reported_has_ended(pause_s):
    """A pause of all reports, as without LiDAR data, ends no track."""
    continuity = TrackContinuity(None)
    for number in (3, 4):
        continuity.add(track(0.0, TrackingState.TRACKING, number))
    assert continuity.accepts(3, ns(0.0))
    continuity.add(track(pause_s + 0.1, TrackingState.TRACKING, 4))
    assert continuity.number == 3
    for k in range(1, 25):
        continuity.add(track(pause_s + 0.1 * k, TrackingState.TRACKING, 4))
    assert continuity.number == 0
    assert continuity.accepts(4, ns(pause_s + 2.5))
