"""Which drone a track follows, when there are several, and how often it changed over to another.

Source: ours. A track is judged by the drone it is nearest to most of the time; what it says near another is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from links.evaluation.associate import Stamps, interpolate
from links.evaluation.output import Output
from links.evaluation.run_data import RunData
from stages.geometry.frames import Array64

NEAR_M = 1.0
OF_A_DRONE = ("truth", "hits", "visible")  # what may be missing for one drone and there for another


@dataclass(frozen=True, slots=True)
class Following:
    """What the tracks of a run follow."""

    drone: NDArray[np.int64]  # (n,) of each output: index of the drone that its track follows
    swaps: dict[int, int]  # by track: how often it went over to another drone


def follow(
    stamps_ns: Stamps,
    xyz_m: Array64,
    tracks: NDArray[np.int64],
    paths: Sequence[tuple[Stamps, Array64]],
    max_gap_ns: int,
) -> Following:
    """Drones by the tracks of n outputs; `paths` are the true stamps and positions of each drone.

    A track follows the drone that is nearest to most of its outputs, the first when truth covers none of them. It
    swaps when it was last within NEAR_M of one drone alone and now is of another alone.
    """
    away_m = np.full((len(stamps_ns), len(paths)), np.inf)
    for index, (true_ns, true_m) in enumerate(paths):
        known, at_m, _ = interpolate(stamps_ns, true_ns, true_m, None, max_gap_ns)
        away_m[known, index] = np.linalg.norm(xyz_m[known] - at_m[known], axis=1)
    covered = np.isfinite(away_m).any(axis=1)
    nearest = np.argmin(away_m, axis=1)
    near = away_m < NEAR_M
    drone = np.zeros(len(stamps_ns), dtype=np.int64)
    swaps: dict[int, int] = {}
    for track in np.unique(tracks).tolist():
        own = tracks == track
        drone[own] = int(np.argmax(np.bincount(nearest[own & covered], minlength=len(paths))))
        alone = np.nonzero(own & (near.sum(axis=1) == 1))[0]
        swaps[track] = int(np.count_nonzero(np.diff(nearest[alone[np.argsort(stamps_ns[alone], kind="stable")]])))
    return Following(drone, swaps)


def per_drone(run: RunData, max_gap_s: float) -> list[RunData]:
    """The run as each of its drones is judged: with its own truth, and of each output the tracks that follow it."""
    known = [(number, drone, drone.path) for number, drone in enumerate(run.drones, start=1) if drone.path is not None]
    if len(known) < 2:
        return [run]
    paths = [(path.stamps_ns, path.xyz_m) for _, _, path in known]
    parts: list[list[Output]] = [[] for _ in known]
    for output in run.outputs:
        poses = output.poses
        tracks = np.ones(len(poses), dtype=np.int64) if output.track is None else output.track
        following = follow(poses.stamps_ns, poses.xyz_m, tracks, paths, round(max_gap_s * 1e9))
        for index, part in enumerate(parts):
            own = following.drone == index
            swaps = sum(following.swaps[track] for track in np.unique(tracks[own]).tolist())
            part.append(_some(output, own, swaps))
    return [
        replace(
            run,
            outputs=tuple(outputs),
            truth=path,
            drone_hits_ns=drone.hits_ns,
            hidden_ns=drone.hidden_ns,
            missing={key: why for key, why in run.missing.items() if key not in OF_A_DRONE} | drone.missing,
            drone=number,
        )
        for (number, drone, path), outputs in zip(known, parts, strict=True)
    ]


def _some(output: Output, kept: NDArray[np.bool_], swaps: int) -> Output:
    """The output's lines that are kept."""
    poses = output.poses
    q = poses.quaternion_xyzw
    return Output(
        output.name,
        replace(
            poses,
            stamps_ns=poses.stamps_ns[kept],
            xyz_m=poses.xyz_m[kept],
            quaternion_xyzw=None if q is None else q[kept],
        ),
        None if output.covariance is None else output.covariance[kept],
        output.why_no_covariance,
        None if output.good is None else output.good[kept],
        None if output.hits is None else output.hits[kept],
        None if output.track is None else output.track[kept],
        swaps,
        None if output.rotated is None else output.rotated[kept],
    )
