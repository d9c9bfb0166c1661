"""Real point clouds of a real drone: tracking in each frame, and the distance from another team's track.

UG2+/MMAUD, 4.9 s: a drone 2.0 to 2.6 m from a Livox Mid-360 and, until it leaves its view at 2.8 s, a Livox Avia.
Limits of these clouds:

    pulses without return   not recorded: of the pass-throughs only those are known that returned from behind the drone
    times                   one stamp per frame, returns in firing order. The Mid-360's are spread evenly over the 0.1 s
                            (it passes the drone once per frame), the Avia's keep the frame's stamp (it does not scan)
    lasers                  not recorded, and no regular scan lines: there are no chords (stages/detect/chords.py), so a
                            Detections message at the first frame's returns replaces the detector

The other team's track is no ground truth and not independent: its rows have the stamps and the mean positions of the
returns on the drone, the Avia's until 2.8 s and the Mid-360's from 4.0 s. Its first part therefore contains the
misalignment of the two sensors; only the second part is comparable.

    python -m pytest tests/stages/track/test_real_clouds.py -s        prints the distances

Source: `../shared/data/drone_lidar` (CC BY-NC-SA 4.0: read there, never copied).
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from stages.messages import Detections, DroneFix, KernelScores, SweptPulses, TrackingState, TrackState
from stages.track.likelihood_track import LikelihoodTrack

CLOUDS = Path(__file__).resolve().parents[4] / "shared" / "data" / "drone_lidar"
MID_360, AVIA, TRACK = (
    "ug2_val_seq1_lidar_360.npz",
    "ug2_val_seq1_livox_avia.npz",
    "track_by_ug2_winner_NOT_official_gt.csv",
)
FRAME_NS = 100_000_000
SLICE_COS = math.cos(math.radians(10.0))  # a slice: successive returns within 10 deg of its first
NEAR_M, ABOVE_DEG = 4.0, 20.0  # only the drone is so near and so high
SAME_STAMP_S = 5e-6


class Frame(NamedTuple):
    """One frame of a Livox, sensor axes (z up)."""

    stamp_ns: int
    pulse_ns: np.ndarray  # (n,)
    xyz_m: np.ndarray  # (n, 3)

    @property
    def on_drone(self) -> np.ndarray:
        """Which returns are the drone's."""
        range_m = np.linalg.norm(self.xyz_m, axis=1)
        return (range_m < NEAR_M) & (self.xyz_m[:, 2] > range_m * math.sin(math.radians(ABOVE_DEG)))


def needed(name: str) -> Path:
    path = CLOUDS / name
    if not path.exists():
        pytest.skip(f"the real cloud {name} is not here (../shared/data/drone_lidar)")
    return path


@functools.cache
def frames(name: str) -> list[Frame]:
    found: list[Frame] = []
    with np.load(needed(name)) as clouds:
        for key in clouds.files:
            seconds, fraction = key.split(".")
            stamp_ns = int(seconds) * 10**9 + int(fraction.ljust(9, "0"))
            xyz = clouds[key].astype(np.float64)
            xyz = xyz[np.linalg.norm(xyz, axis=1) > 0]
            spread_ns = FRAME_NS if name == MID_360 else 0
            pulse_ns = stamp_ns + np.arange(len(xyz)) * spread_ns // max(len(xyz), 1)
            found.append(Frame(stamp_ns, pulse_ns.astype(np.int64), xyz))
    return found


def other_track() -> np.ndarray:
    """(n, 4): t [s] since 1970, x, y, z [m]."""
    return np.loadtxt(needed(TRACK), delimiter=",", skiprows=1)


def pulses(pulse_ns: np.ndarray, direction: np.ndarray, range_m: np.ndarray) -> SweptPulses:
    n = len(range_m)
    return SweptPulses(
        stamp_ns=int(pulse_ns[0]),
        point_stamp_ns=pulse_ns,
        direction_vehicle=direction.astype(np.float32),
        range_m=range_m.astype(np.float32),
        laser=np.zeros(n, dtype=np.uint8),
        reflectivity=np.zeros(n, dtype=np.uint8),
        turntable_rad=math.nan,
        origin_vehicle_m=(0.0, 0.0, 0.0),
    )


def pulse_downwards(stamp_ns: int) -> SweptPulses:
    """One pulse downwards: it ends the scan pass of a sensor that does not scan."""
    return pulses(np.array([stamp_ns]), np.array([[0.0, 0.0, -1.0]]), np.zeros(1))


def slices(frame: Frame) -> Iterator[SweptPulses]:
    """A frame in slices of nearly one direction, as of a fan of beams."""
    range_m = np.linalg.norm(frame.xyz_m, axis=1)
    direction = frame.xyz_m / range_m[:, None]
    first = 0
    while first < len(range_m):
        leaves = np.nonzero(direction[first:] @ direction[first] < SLICE_COS)[0]
        end = first + (int(leaves[0]) if len(leaves) else len(range_m) - first)
        yield pulses(frame.pulse_ns[first:end], direction[first:end], range_m[first:end])
        first = end


def found_at(frame: Frame) -> Detections:
    """Detections in the first frame."""
    return Detections(
        stamp_ns=frame.stamp_ns,
        xyz_vehicle_m=frame.xyz_m[frame.on_drone].mean(axis=0)[None],
        evidence=KernelScores(e_inner=np.zeros(1), e_outer=np.zeros(1)),
        accepted=np.ones(1, dtype=bool),
        reasons=("the only object near and above",),
        summary="drone",
    )


def track(name: str, span_m: float) -> tuple[list[DroneFix], list[TrackState]]:
    """All frames with a return on the drone through the tracker; the span is the one setting."""
    stage = LikelihoodTrack(span_m=span_m)
    seen = [frame for frame in frames(name) if frame.on_drone.any()]
    out = list(stage.on_detections(found_at(seen[0])))
    for frame in seen:
        for part in slices(frame):
            out += stage.on_pulses(part)
        if name == AVIA or frame is seen[-1]:
            out += stage.on_pulses(pulse_downwards(int(frame.pulse_ns[-1]) + FRAME_NS // 2))
    return [m for m in out if isinstance(m, DroneFix)], [m for m in out if isinstance(m, TrackState)]


class Distance(NamedTuple):
    """Between grd's fixes and rows of the other track, after the best time offset and shift."""

    dt_s: float  # grd's stamps are later by this
    shift_m: np.ndarray
    median_m: float
    largest_m: float


def distance(fixes: list[DroneFix], rows: np.ndarray, *, in_time: bool, shifted: bool) -> Distance:
    """Least squares over time offsets within 0.3 s; rows beyond grd's fixes are compared with the nearest one."""
    t = np.array([fix.stamp_ns - fixes[0].stamp_ns for fix in fixes]) * 1e-9
    xyz = np.array([fix.xyz_vehicle_m for fix in fixes])
    at = rows[:, 0] - fixes[0].stamp_ns * 1e-9

    def left(dt: float) -> tuple[np.ndarray, np.ndarray]:
        distance_m = np.column_stack([np.interp(at + dt, t, xyz[:, k]) for k in range(3)]) - rows[:, 1:]
        shift = distance_m.mean(axis=0) if shifted else np.zeros(3)
        return np.linalg.norm(distance_m - shift, axis=1), shift

    dt = min(np.linspace(-0.3, 0.3, 61) if in_time else [0.0], key=lambda dt: float((left(dt)[0] ** 2).sum()))
    distance_m, shift = left(dt)
    return Distance(float(dt), shift, float(np.median(distance_m)), float(distance_m.max()))


def shared(name: str) -> list[tuple[np.ndarray, Frame]]:
    """The rows of the other track with the stamp of a frame of this sensor, each with that frame."""
    seen = frames(name)
    stamps = np.array([frame.stamp_ns * 1e-9 for frame in seen])
    nearest = [(row, int(np.abs(stamps - row[0]).argmin())) for row in other_track()]
    return [(row, seen[k]) for row, k in nearest if abs(stamps[k] - row[0]) < SAME_STAMP_S]


@pytest.mark.parametrize("span_m", [0.4, 0.5, 0.6])
@pytest.mark.parametrize(("name", "with_drone"), [(MID_360, 49), (AVIA, 28)])
def test_the_drone_is_tracked_in_each_frame_with_returns(name, with_drone, span_m):
    seen = [frame for frame in frames(name) if frame.on_drone.any()]
    assert len(seen) == with_drone
    fixes, states = track(name, span_m)
    fix_ns = np.array([fix.stamp_ns for fix in fixes])
    for frame in seen:  # each return on the drone belongs to a scan pass with a fix
        for pulse_ns in frame.pulse_ns[frame.on_drone]:
            assert np.abs(fix_ns - pulse_ns).min() < 10_000_000
    assert {state.state for state in states} == {TrackingState.TRACKING}
    assert {fix.track_id for fix in fixes} == {1}


@pytest.mark.parametrize(("name", "median_m"), [(MID_360, 0.05), (AVIA, 0.05)])
def test_the_fix_lies_among_its_own_returns(name, median_m):
    xyz = np.concatenate([frame.xyz_m[frame.on_drone] for frame in frames(name)])
    pulse_ns = np.concatenate([frame.pulse_ns[frame.on_drone] for frame in frames(name)])
    distance_m = []
    for fix in track(name, 0.5)[0]:
        own = np.abs(pulse_ns - fix.stamp_ns) < 10_000_000
        distance_m.append(float(np.linalg.norm(fix.xyz_vehicle_m - np.median(xyz[own], axis=0))))
    assert np.median(distance_m) < median_m
    assert max(distance_m) < 0.15


def test_the_other_teams_track_is_computed_from_the_same_clouds():
    first, second = shared(AVIA), shared(MID_360)
    assert (len(first), len(second), len(other_track())) == (28, 9, 37)
    for rows in (first, second):
        distance_m = [np.linalg.norm(frame.xyz_m[frame.on_drone].mean(axis=0) - row[1:]) for row, frame in rows]
        assert np.median(distance_m) < 0.05


def test_the_distance_to_the_other_teams_track():
    """The other track is the mean of the returns; grd's is the drone's centre, 4 cm behind it."""
    by_avia, by_mid_360 = (np.array([row for row, _ in shared(name)]) for name in (AVIA, MID_360))
    lines = [""]
    for name, words, rows, near_m, far_m in (
        (AVIA, "its first part, from the same returns", by_avia, 0.06, 0.15),
        (MID_360, "its second part, from the same returns", by_mid_360, 0.06, 0.07),
        (MID_360, "its first part, from the Avia", by_avia, 0.30, 0.40),  # the two are not aligned
        (MID_360, "all of it", other_track(), 0.30, 0.40),
    ):
        fixes = track(name, 0.5)[0]
        lines.append(f"{name}, {len(fixes)} fixes, against {words}, {len(rows)} rows:")
        for in_time, shifted in ((False, False), (True, False), (False, True), (True, True)):
            d = distance(fixes, rows, in_time=in_time, shifted=shifted)
            x, y, z = d.shift_m
            lines.append(
                f"    time offset {d.dt_s:+.2f} s, shift ({x:+.3f}, {y:+.3f}, {z:+.3f}) m:"
                f" median {d.median_m:.3f} m, largest {d.largest_m:.3f} m"
            )
        plain = distance(fixes, rows, in_time=False, shifted=False)
        assert plain.median_m < near_m
        assert plain.largest_m < far_m
        assert distance(fixes, rows, in_time=False, shifted=True).median_m < 0.12
    sys.stdout.write("\n".join([*lines, ""]))
