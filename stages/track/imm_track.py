# pyright: basic, reportMissingImports=false
"""Baseline of the field: DBSCAN clusters, tracked by IMM-PDAF; extra `baseline`.

    returns above the horizon in frames of `frame_s` -> clusters (DBSCAN)
    clusters larger than `largest_spans` drones       -> background: walls, trees, ground
    others, not near background of the last seconds   -> measurements
    a measurement in no track's gate                  -> a new tentative track
    `confirm_hits` frames with a gated measurement and a displacement of `least_moved_m` -> confirmed

Every confirmed track is an object that moves; the oldest one is published as the drone. Telemetry, pass-throughs and
surroundings are not used. Standing objects (lamps, wires, edges) are separated by displacement alone, so a drone that
hovers is not found; with `least_moved_m: 0` it is, and so is everything else that is small.

The settings were chosen by hand on one flight that is in no table (docs/reference/detection.md).

Source: ours, of the usual parts: Ester et al., "DBSCAN", KDD (1996); `stages/track/imm_pdaf.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from sklearn.cluster import DBSCAN

from flow.stage import Settings, Stage
from stages.detect.isolation import LargeObjectMap
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import DroneFix, SweptPoints, TrackingState, TrackState, VehicleMotion
from stages.track.imm_pdaf import ImmPdaf, ImmSettings

Stamps = NDArray[np.int64]
TENTATIVE_NS = 1_000_000_000  # a tentative track ends this long after its last measurement
BACKGROUND_NS = 3_000_000_000  # one sweep of the turntable


class _Cluster(NamedTuple):
    xyz_map_m: Array64
    stamp_ns: int
    returns: int


@dataclass(slots=True)
class _Track:
    number: int
    filter: ImmPdaf
    start_m: Array64
    returns: int  # of the newest cluster
    hits: int = 1
    seen_ns: int = 0
    confirmed: bool = False


@dataclass(slots=True)
class _State:
    trail: VehicleTrajectory = field(default_factory=VehicleTrajectory)
    background: LargeObjectMap = field(default_factory=LargeObjectMap)
    tracks: list[_Track] = field(default_factory=lambda: list[_Track]())
    points: list[tuple[Array64, Stamps]] = field(default_factory=lambda: list[tuple[Array64, Stamps]]())
    frame_end_ns: int | None = None
    number: int = 0  # of the newest track
    published: int = 0  # number of the published track; 0: none


class ImmPdafTrackSettings(Settings):
    """Settings of `ImmPdafTrack`."""

    span_m: float = Field(0.5, gt=0, le=10)  # largest dimension of the drone
    lowest_deg: float = Field(4.0, ge=-30, le=80)  # least elevation above the LiDAR's horizon
    nearest_m: float = Field(1.5, ge=0.3)
    furthest_m: float = Field(65.0, gt=1)
    frame_s: float = Field(0.1, gt=0)  # one turn of the rotor
    eps_m: float = Field(1.0, gt=0)  # of DBSCAN; a cluster is this far from all other returns
    min_points: int = Field(1, ge=1)  # of DBSCAN; one: a beam returns once from a far drone
    largest_spans: float = Field(1.3, gt=0)  # a larger cluster is no drone
    background_m: float = Field(2.0, gt=0)  # a cluster this near to background belongs to it
    confirm_hits: int = Field(5, ge=2)
    least_moved_m: float = Field(1.5, ge=0)  # displacement that confirms a track
    lost_after_s: float = Field(3.0, gt=0)  # a whole sweep (2.6 s) may pass without a return
    reach_mps: float = Field(15.0, gt=0)  # measurements farther away than at this speed are not tried
    noise_mps: tuple[float, float] = (0.5, 4.0)  # velocity noise of the two models after 1 s
    stay: float = Field(0.95, gt=0.5, lt=1)  # probability that a model stays valid over a frame
    sigma_m: float = Field(0.15, gt=0)  # of a cluster's centre about the drone's
    start_speed_mps: float = Field(6.0, gt=0)
    detection_probability: float = Field(0.3, gt=0, lt=1)  # in a frame; the fan is not always on the drone
    gate_probability: float = Field(0.99, gt=0, lt=1)
    clutter_per_m3: float = Field(1e-4, gt=0)  # small clusters in a frame


class ImmPdafTrack(Stage[ImmPdafTrackSettings]):
    """DBSCAN and IMM-PDAF; the oldest confirmed track is the drone."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"motion"})

    def __init__(self, settings: ImmPdafTrackSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        chosen = {name: getattr(self.settings, name) for name in ImmSettings._fields}
        self._filter_settings, self._now = ImmSettings(**chosen), _State()

    def on_motion(self, motion: VehicleMotion) -> None:
        """Update the vehicle's trajectory; after a jump of its odometry all tracks end."""
        if self._now.trail.add(motion):
            self._now.tracks.clear()
            self._now.background = LargeObjectMap()

    def on_points(self, points: SweptPoints) -> Iterator[DroneFix | TrackState]:
        """Collect the returns of a frame; evaluate the frame when it is complete."""
        now = self._now
        if now.frame_end_ns is None:
            now.frame_end_ns = points.stamp_ns + round(self.settings.frame_s * 1e9)
        if points.stamp_ns >= now.frame_end_ns:
            yield from self._frame(now.frame_end_ns)
            now.frame_end_ns = points.stamp_ns + round(self.settings.frame_s * 1e9)
        relative_m = points.xyz_vehicle_m.astype(np.float64) - np.array(points.origin_vehicle_m)
        range_m = np.linalg.norm(relative_m, axis=1)
        kept = (range_m > self.settings.nearest_m) & (range_m < self.settings.furthest_m)
        kept &= relative_m[:, 2] > math.sin(math.radians(self.settings.lowest_deg)) * range_m
        R, t = now.trail.at(points.stamp_ns)
        now.points.append((points.xyz_vehicle_m[kept] @ R.T + t, points.point_stamp_ns[kept]))

    def _frame(self, end_ns: int) -> Iterator[DroneFix | TrackState]:
        now = self._now
        clusters = self._clusters()
        was_confirmed = now.published
        for track in now.tracks:
            clusters = self._update(track, clusters)
        for cluster in clusters:
            now.number += 1
            filter_ = ImmPdaf(cluster.xyz_map_m, cluster.stamp_ns, self._filter_settings)
            now.tracks.append(_Track(now.number, filter_, cluster.xyz_map_m, cluster.returns, seen_ns=cluster.stamp_ns))
        now.tracks = [track for track in now.tracks if end_ns - track.seen_ns < self._retention_ns(track)]
        best = next((track for track in now.tracks if track.confirmed), None)
        now.published = 0 if best is None else best.number
        frame_s = self.settings.frame_s
        if best is None:
            lost = was_confirmed != 0
            state = TrackingState.LOST if lost else TrackingState.SEARCHING
            reason = "no cluster in the gate" if lost else f"{len(now.tracks)} tentative tracks"
            yield TrackState(stamp_ns=end_ns, state=state, reason=reason, hits=0, frame_s=frame_s)
            return
        seen = best.filter.stamp_ns >= end_ns - round(frame_s * 1e9)
        reason = f"{best.hits} frames, probability of a manoeuvre {best.filter.probabilities[1]:.2f}"
        yield TrackState(
            stamp_ns=end_ns, state=TrackingState.TRACKING, reason=reason, hits=best.returns if seen else 0,
            frame_s=frame_s, track_id=best.number,
        )  # fmt: skip
        if seen:
            yield self._fix(best)

    def _fix(self, track: _Track) -> DroneFix:
        xyz_m, _, covariance_m2 = track.filter.estimate()
        R, t = self._now.trail.at(track.filter.stamp_ns)
        return DroneFix(
            stamp_ns=track.filter.stamp_ns,
            xyz_vehicle_m=R.T @ (xyz_m - t),
            covariance_m2=R.T @ covariance_m2 @ R,
            hits=track.returns,
            track_id=track.number,
        )

    def _clusters(self) -> list[_Cluster]:
        """The small clusters of the frame, which is then empty."""
        now, settings = self._now, self.settings
        parts, now.points = now.points, []
        xyz_m, stamps_ns = np.concatenate([xyz for xyz, _ in parts]), np.concatenate([stamps for _, stamps in parts])
        if not len(xyz_m):
            return []
        labels = DBSCAN(eps=settings.eps_m, min_samples=settings.min_points).fit(xyz_m).labels_
        found: list[_Cluster] = []
        for label in range(labels.max() + 1):
            own = labels == label
            own_ns = stamps_ns[own]
            if float(np.linalg.norm(np.ptp(xyz_m[own], axis=0))) > settings.largest_spans * settings.span_m:
                now.background.add(xyz_m[own], int(own_ns[-1]))
                continue
            stamp_ns = int(own_ns[0]) + round(float((own_ns - own_ns[0]).mean()))
            found.append(_Cluster(xyz_m[own].mean(axis=0), stamp_ns, int(own.sum())))
        found = [cluster for cluster in found if not self._is_background(cluster)]
        return sorted(found, key=lambda cluster: cluster.stamp_ns)

    def _is_background(self, cluster: _Cluster) -> bool:
        most_m, since_ns = self.settings.background_m, cluster.stamp_ns - BACKGROUND_NS
        return math.isfinite(self._now.background.nearest_m(cluster.xyz_map_m, 0.0, most_m, since_ns))

    def _update(self, track: _Track, clusters: list[_Cluster]) -> list[_Cluster]:
        """Update a track with the clusters in its gate; returns the others."""
        xyz_m, velocity_mps, _ = track.filter.estimate()
        near: dict[int, float] = {}  # distance from the prediction by index
        for index, cluster in enumerate(clusters):
            dt = (cluster.stamp_ns - track.filter.stamp_ns) * 1e-9
            distance_m = math.dist(cluster.xyz_map_m, xyz_m + dt * velocity_mps)
            if dt > 0 and distance_m < self.settings.eps_m + self.settings.reach_mps * dt:
                near[index] = distance_m
        if not near:
            return clusters
        nearest = clusters[min(near, key=lambda index: near[index])]
        if not track.filter.step(np.array([clusters[index].xyz_map_m for index in near]), nearest.stamp_ns):
            return clusters
        track.hits, track.seen_ns, track.returns = track.hits + 1, nearest.stamp_ns, nearest.returns
        xyz_m, _, _ = track.filter.estimate()
        moved_m = math.dist(xyz_m, track.start_m)
        track.confirmed |= track.hits >= self.settings.confirm_hits and moved_m >= self.settings.least_moved_m
        far = [math.dist(cluster.xyz_map_m, xyz_m) > self.settings.eps_m for cluster in clusters]
        return [c for index, c in enumerate(clusters) if index not in near or far[index]]

    def _retention_ns(self, track: _Track) -> float:
        return self.settings.lost_after_s * 1e9 if track.confirmed else TENTATIVE_NS
