"""Truth of the drones and the association with it: truth at given times, and the drone that each track follows.

Source: grd; links/runs/truth.py writes the files. Truth is interpolated, but never over a gap. This file needs no
package of the extra `evaluate`: links/runs/truth.py uses it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from links.evaluation.text_files import NO_DRONE, Flags, Stamps, TextTable, Trajectory, read_tum
from links.runs import results
from stages.geometry.frames import Array64

NEVER_NS = np.iinfo(np.int64).max // 2  # the end of a span that did not end
NEAR_M = 1.0  # a track this near to one drone alone is on that drone


@dataclass(frozen=True, slots=True)
class EvaluationLimits:
    """Thresholds of an evaluation. The report states all of them."""

    max_gap_s: float = 0.15  # truth is not interpolated over longer gaps
    max_age_s: float = 0.3  # an output is current for this long; an autopilot drops out after a longer silence
    false_m: float = 1.0  # an output farther from the drone is false
    overconfident_sigmas: float = 3.0  # a false output farther than this many of its own sigmas is overconfident
    reach_m: float = 100.0  # no output is expected beyond this range: VLP-16 data sheet 63-9229, range
    min_returns: int = 4  # a search with this many returns of the drone should detect it

    @property
    def max_gap_ns(self) -> int:
        """`max_gap_s` [ns]."""
        return round(self.max_gap_s * 1e9)


class EvaluationInput(Enum):
    """An input of an evaluation that a run may lack."""

    TRUTH = auto()
    RETURNS = auto()  # which returns came from the drone
    VISIBILITY = auto()  # when the drone was occluded
    SEARCHES = auto()
    COMPUTE = auto()


@dataclass(frozen=True, slots=True)
class DroneTruth:
    """Truth about one drone. `missing` has the reason for what is None."""

    path: Trajectory | None = None
    returns_ns: Stamps | None = None  # when a pulse returned from it, rising
    occluded_ns: Stamps | None = None  # (m, 2) begin and end of occlusions, rising
    missing: dict[EvaluationInput, str] = field(default_factory=dict)


def read_true_drones(folder: Path, truth_file: Path | None) -> tuple[tuple[DroneTruth, ...], bool]:
    """Truth of every drone, at least one, and whether truth states that there was none."""
    path = folder / results.TRUTH_FILE
    first, why, empty_sky = None, "", False
    if truth_file is not None:
        first = read_tum(truth_file)
    elif not path.exists():
        why = "the recording holds no truth (real flight?); give one with --truth FILE.tum"
    elif not len(first := read_tum(path, may_be_empty=True)):
        empty_sky = NO_DRONE in first.header
        first, why = None, "there was no drone" if empty_sky else f"{path} is empty"
    drones = [_read_drone(folder, 1, first, why)]
    while truth_file is None and (more := folder / results.drone_file(results.TRUTH_FILE, len(drones) + 1)).exists():
        drones.append(_read_drone(folder, len(drones) + 1, read_tum(more), ""))
    return tuple(drones), empty_sky


def _read_drone(folder: Path, number: int, path: Trajectory | None, why_no_path: str) -> DroneTruth:
    missing = {
        EvaluationInput.TRUTH: why_no_path,
        EvaluationInput.RETURNS: "the recording does not hold which returns came from the drone",
        EvaluationInput.VISIBILITY: "the recording does not hold when the drone was occluded",
    }
    returns, visible = (
        folder / results.drone_file(name, number) for name in (results.TRUTH_RETURNS_FILE, results.TRUTH_VISIBLE_FILE)
    )
    return DroneTruth(path, _read_returns(returns), _read_occlusions(visible), missing)


def _read_returns(path: Path) -> Stamps | None:
    if not path.exists():
        return None
    return np.sort(TextTable(path, ("stamp_s",)).stamps_ns("stamp_s"))


def _read_occlusions(path: Path) -> Stamps | None:
    """Begin and end (m, 2) of each occlusion; one that did not end ends at NEVER_NS."""
    if not path.exists():
        return None
    table = TextTable(path, ("stamp_s", "visible"))
    stamps_ns, visible = table.stamps_ns("stamp_s"), np.concatenate([[True], table.equals("visible", "1")])
    begin, end = stamps_ns[visible[:-1] & ~visible[1:]], stamps_ns[~visible[:-1] & visible[1:]]
    return np.column_stack([begin, np.append(end, NEVER_NS)[: len(begin)]])


@dataclass(frozen=True, slots=True)
class Brackets:
    """The samples before and after each of m times."""

    known: Flags  # (m,) False outside the samples and inside gaps
    before: NDArray[np.int64]  # (m,) indices; where `known` is False they mean nothing
    after: NDArray[np.int64]
    weight: Array64  # (m,) of the sample after, 0 to 1


def bracket(at_ns: Stamps, stamps_ns: Stamps, max_gap_ns: int) -> Brackets:
    """Bracket the times `at_ns` by samples at most `max_gap_ns` apart. A sample itself is always known."""
    after = np.clip(np.searchsorted(stamps_ns, at_ns, side="left"), 0, len(stamps_ns) - 1)
    exact = stamps_ns[after] == at_ns
    before = np.where(exact, after, np.maximum(after - 1, 0))
    step_ns = stamps_ns[after] - stamps_ns[before]
    inside = (at_ns >= stamps_ns[0]) & (at_ns <= stamps_ns[-1])
    known = exact | (inside & (step_ns <= max_gap_ns))
    weight = np.where(known & ~exact, (at_ns - stamps_ns[before]) / np.maximum(step_ns, 1), 0.0)
    return Brackets(known, before, after, weight)


def interpolate(at_ns: Stamps, stamps_ns: Stamps, xyz_m: Array64, max_gap_ns: int) -> tuple[Flags, Array64]:
    """Linear interpolation of positions: known (m,) and xyz (m, 3) [m], whose unknown rows mean nothing."""
    if not len(stamps_ns):
        return np.zeros(len(at_ns), dtype=np.bool_), np.zeros((len(at_ns), 3))
    b = bracket(at_ns, stamps_ns, max_gap_ns)
    w = b.weight[:, None]
    return b.known, (1 - w) * xyz_m[b.before] + w * xyz_m[b.after]


def drone_labels(
    stamps_ns: Stamps, xyz_m: Array64, paths: Sequence[tuple[Stamps, Array64]], limits: EvaluationLimits
) -> tuple[Flags, Flags]:
    """Whether the truth decides what is at each position (n, 3) [m], and whether it is a drone: flags (n,) each.

    It is a drone within `false_m` of one at that time. `paths`: true stamps [ns] and positions [m] of every drone, in
    the same frame; none for a sky without drones. Not decided: the truth of a drone has a gap there, and no other drone
    is near.
    """
    everywhere, is_drone = np.ones(len(stamps_ns), dtype=np.bool_), np.zeros(len(stamps_ns), dtype=np.bool_)
    for path in paths:
        covered, at_m = interpolate(stamps_ns, *path, limits.max_gap_ns)
        everywhere &= covered
        is_drone |= covered & (np.linalg.norm(xyz_m - at_m, axis=1) < limits.false_m)
    return everywhere | is_drone, is_drone


def newest(at_ns: Stamps, stamps_ns: Stamps) -> NDArray[np.int64]:
    """Index of the newest sample at or before each time; -1 before the first."""
    return np.searchsorted(stamps_ns, at_ns, side="right") - 1


@dataclass(frozen=True, slots=True)
class TrackAssociation:
    """The drone that each track of a run follows."""

    drone: NDArray[np.int64]  # (n,) of each output: index of the drone that its track follows
    switches: dict[int, int]  # by track: how often it changed to another drone


def follow(
    stamps_ns: Stamps,
    xyz_m: Array64,
    tracks: NDArray[np.int64],
    paths: Sequence[tuple[Stamps, Array64]],
    max_gap_ns: int,
) -> TrackAssociation:
    """Associate the tracks of n outputs with drones, whose true stamps and positions are `paths`.

    A track follows the drone that is nearest to most of its outputs, the first one when truth covers none of them. It
    switches when it is within NEAR_M of one drone alone and was so of another before.
    """
    distance_m = np.full((len(stamps_ns), len(paths)), np.inf)
    for index, (true_ns, true_m) in enumerate(paths):
        known, at_m = interpolate(stamps_ns, true_ns, true_m, max_gap_ns)
        distance_m[known, index] = np.linalg.norm(xyz_m[known] - at_m[known], axis=1)
    covered = np.isfinite(distance_m).any(axis=1)
    nearest = np.argmin(distance_m, axis=1)
    near_one = (distance_m < NEAR_M).sum(axis=1) == 1
    drone = np.zeros(len(stamps_ns), dtype=np.int64)
    switches: dict[int, int] = {}
    for track in np.unique(tracks).tolist():
        own = tracks == track
        drone[own] = int(np.argmax(np.bincount(nearest[own & covered], minlength=len(paths))))
        certain = np.nonzero(own & near_one)[0]
        in_time = certain[np.argsort(stamps_ns[certain], kind="stable")]
        switches[track] = int(np.count_nonzero(np.diff(nearest[in_time])))
    return TrackAssociation(drone, switches)
