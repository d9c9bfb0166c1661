"""Tracker of the paper: mean shift on the returns near the drone's last position, frame by frame.

    F = {returns of this frame within r of t^0},  t^0 = the last frame's t,  then `stages/track/mean_shift.py`

A detection is one pixel of the depth image. With `refine_detection` the track starts where the mean shift over the
returns of that scan within r of it ends: those of the last two sweeps, in axes of a vehicle that stands, as in P III.

The state is SEARCHING until a detection is accepted, then TRACKING. Frames without returns are normal, because the
beams also point in other directions. After `lost_after_s` without returns the state is LOST for one frame, then
SEARCHING. The frames' boundaries are a fixed time grid for the points' stamps, independent of the messages' boundaries.

A detection is up to one sweep old (2.6 s). The first returns are therefore searched within `acquire_radius_m`: 3 m for
a drone of up to 1.1 m/s. The paper uses r = 1 m there and loses drones faster than 0.4 m/s before the first frame.

While TRACKING, detections are not used, as in the paper, with one exception for a track on the wrong object: the track
is reset to a detection if `rival_sweeps` successive sweeps accept a drone farther than r from it and none within r, or
one sweep does so in which the track had no return. `rival_sweeps: null` is the paper's method.

Source: P III.C, Equation 6 (r = 1 m, n_max = 10, first the initial scan, then frames of 120 ms); states, covariance and
rivals are ours.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.frames import Array64
from stages.kernels.track.mean_shift import mean_shift, within
from stages.messages import Detections, DroneFix, MeanShiftResult, SweptPoints, TrackingState, TrackState
from stages.track.mean_shift import crossings, fix_covariance_m2

SCAN_NS = 5_300_000_000  # returns are kept for two sweeps of 180 deg at 11.4 rpm (P III.A)


@dataclass(slots=True)
class _State:
    """State of the stage."""

    frame_end_ns: int | None = None
    t_hat: Array64 | None = None  # last position of the drone; None while searching
    last_hit_ns: int = 0
    acquired: bool = False  # at least one frame with returns since the detection
    hit_since_sweep: bool = False
    rivals: int = 0  # successive sweeps that accepted a drone at another position only
    event: str = "no drone detected yet"  # why the state is SEARCHING, or an event to report with the next state
    near: list[SweptPoints] = field(default_factory=lambda: list[SweptPoints]())  # F, slice by slice
    scan: deque[SweptPoints] = field(default_factory=lambda: deque[SweptPoints]())  # since the last detections


class MeanShiftTrackSettings(Settings):
    """Settings of `MeanShiftTrack`."""

    radius_m: float = Field(1.0, gt=0, le=10)  # r, distance of the used returns from the last position
    acquire_radius_m: float = Field(3.0, gt=0, le=10)  # instead of r until the first returns; the paper's is r
    refine_detection: bool = True  # mean shift over the scan that a detection is from, before the track starts
    max_iterations: int = Field(10, ge=1)  # n_max, per frame
    tolerance_m: float = Field(1e-4, ge=0)  # a shorter step ends the frame's iteration
    frame_s: float = Field(0.12, gt=0)  # duration of a frame
    min_hits: int = Field(1, ge=1)  # returns of a frame that are needed for a fix
    lost_after_s: float = Field(3.0, gt=0)  # without a fix; a whole sweep (2.6 s) may pass without a return
    rival_sweeps: int | None = Field(2, ge=1)  # sweeps with a rival that reset the track; null: none
    span_m: float = Field(0.5, gt=0, le=10)  # s, largest dimension of the drone, for the covariance
    range_noise_m: float = Field(0.03, ge=0)  # one sigma; VLP-16 datasheet 63-9229: typical accuracy +-3 cm
    pointing_deg: float = Field(0.1, ge=0)  # one sigma of encoder, calibration and servo time together
    beam_deg: float = Field(0.17, ge=0)  # VLP-16 divergence, 3 mrad


class MeanShiftTrack(Stage[MeanShiftTrackSettings]):
    """P III.C: mean shift on the returns around the last position. One fix per frame with at least `min_hits`."""

    def __init__(self, settings: MeanShiftTrackSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._state = _State()

    def on_detections(self, detections: Detections) -> None:
        """Start a track at the best accepted detection; while tracking, count rival detections."""
        settings = self.settings
        memory = self._state
        accepted = detections.xyz_vehicle_m[detections.accepted]
        scan, memory.scan = memory.scan, deque()
        if memory.t_hat is None:
            if len(accepted):
                self._start(detections.stamp_ns, accepted[0], scan, "started at a detection")
            return
        here = len(accepted) and (np.linalg.norm(accepted - memory.t_hat, axis=1) <= settings.radius_m).any()
        memory.rivals = 0 if here or not len(accepted) else memory.rivals + 1
        unsupported = not memory.hit_since_sweep
        memory.hit_since_sweep = False
        if (
            settings.rival_sweeps is not None
            and memory.rivals
            and (unsupported or memory.rivals >= settings.rival_sweeps)
        ):
            distance_m = float(np.linalg.norm(accepted[0] - memory.t_hat))
            why = "the last sweep had no return here" if unsupported else f"{memory.rivals} sweeps in a row agree"
            event = f"moved {distance_m:.1f} m to a detection: {why}"
            self._start(detections.stamp_ns, accepted[0], scan, event)

    def on_points(self, points: SweptPoints) -> Iterator[DroneFix | TrackState]:
        """Collect the returns near t^0; evaluate completed frames."""
        memory = self._state
        stamps_ns = points.point_stamp_ns
        if self.settings.refine_detection:
            memory.scan.append(points)
            while memory.scan[0].stamp_ns < points.stamp_ns - SCAN_NS:
                memory.scan.popleft()
        if memory.frame_end_ns is None:
            memory.frame_end_ns = points.stamp_ns + self._frame_ns
        taken = 0
        last_ns = max(points.stamp_ns, int(stamps_ns[-1])) if stamps_ns.size else points.stamp_ns
        while last_ns >= memory.frame_end_ns:
            split = int(np.searchsorted(stamps_ns, memory.frame_end_ns))
            self._collect(points, taken, split)
            taken = max(taken, split)
            yield from self._close_frame()
            next_ns = int(stamps_ns[taken]) if taken < stamps_ns.size else last_ns
            skipped = max(0, next_ns - memory.frame_end_ns) // self._frame_ns
            memory.frame_end_ns += (skipped + 1) * self._frame_ns
        self._collect(points, taken, stamps_ns.size)

    def finish(self) -> Iterator[DroneFix | TrackState]:
        """Evaluate the last frame."""
        memory = self._state
        if memory.frame_end_ns is not None:
            yield from self._close_frame()

    @property
    def _frame_ns(self) -> int:
        return round(self.settings.frame_s * 1e9)

    def _start(self, stamp_ns: int, xyz_vehicle_m: Array64, scan: deque[SweptPoints], event: str) -> None:
        memory = self._state
        memory.t_hat, refined = self._refined(xyz_vehicle_m.astype(np.float64), scan)
        memory.last_hit_ns = stamp_ns
        memory.acquired = memory.hit_since_sweep = False
        memory.rivals = 0
        memory.event = event + refined
        memory.near.clear()

    def _refined(self, t_0: Array64, scan: deque[SweptPoints]) -> tuple[Array64, str]:
        """Position (3,) after the mean shift over the returns of a scan within r of t_0, and a text about it."""
        settings = self.settings
        near = [s.xyz_vehicle_m[within(s.xyz_vehicle_m, t_0, settings.radius_m)] for s in scan]
        hits = sum(len(points) for points in near)
        if not hits:
            return t_0, ""
        t = mean_shift(np.concatenate(near).astype(np.float64), t_0, settings.max_iterations, settings.tolerance_m)[0]
        return t, f", moved {float(np.linalg.norm(t - t_0)):.2f} m by {hits} returns of its scan"

    def _collect(self, points: SweptPoints, start: int, end: int) -> None:
        """Add returns start..end of a slice that lie within r of t^0 to the set F."""
        memory = self._state
        if memory.t_hat is None or start >= end:
            return
        radius_m = self.settings.radius_m if memory.acquired else self.settings.acquire_radius_m
        near = start + within(points.xyz_vehicle_m[start:end], memory.t_hat, radius_m)
        if near.size:
            memory.near.append(
                SweptPoints(
                    stamp_ns=points.stamp_ns,
                    point_stamp_ns=points.point_stamp_ns[near],
                    xyz_vehicle_m=points.xyz_vehicle_m[near],
                    laser=points.laser[near],
                    reflectivity=points.reflectivity[near],
                    turntable_rad=points.turntable_rad[near],
                    pulses=points.pulses,
                    origin_vehicle_m=points.origin_vehicle_m,
                )
            )

    def _close_frame(self) -> Iterator[DroneFix | TrackState]:
        settings = self.settings
        memory = self._state
        assert memory.frame_end_ns is not None
        near, memory.near = memory.near, []
        hits = sum(len(part.laser) for part in near)
        state, reason = TrackingState.SEARCHING, memory.event
        if memory.t_hat is not None:
            silent_s = (memory.frame_end_ns - memory.last_hit_ns) / 1e9
            if hits >= settings.min_hits:
                fix = self._fix(near, memory.t_hat)
                memory.t_hat = fix.xyz_vehicle_m
                memory.last_hit_ns = fix.stamp_ns
                memory.acquired = memory.hit_since_sweep = True
                state, reason = TrackingState.TRACKING, f"{hits} returns"
                yield fix
            elif silent_s > settings.lost_after_s:
                state, reason = (
                    TrackingState.LOST,
                    f"below {settings.min_hits} returns a frame for {silent_s:.1f} s",
                )
                memory.t_hat, memory.event = None, "lost the drone, waiting for a detection"
            else:
                few = f"{hits} returns" if hits else "no return"
                state, reason = TrackingState.TRACKING, f"{few}, {silent_s:.2f} s since the last fix or detection"
            if memory.event and memory.t_hat is not None:
                reason, memory.event = f"{memory.event}; {reason}", ""
        yield TrackState(stamp_ns=memory.frame_end_ns, state=state, reason=reason, hits=hits, frame_s=settings.frame_s)

    def _fix(self, near: list[SweptPoints], t_0: Array64) -> DroneFix:
        settings = self.settings
        points_m = np.concatenate([part.xyz_vehicle_m for part in near]).astype(np.float64)
        stamps_ns = np.concatenate([part.point_stamp_ns for part in near])
        laser = np.concatenate([part.laser for part in near])
        t, weights, iterations, shift_m = mean_shift(points_m, t_0, settings.max_iterations, settings.tolerance_m)
        since_ns = stamps_ns - stamps_ns[0]
        covariance_m2 = fix_covariance_m2(
            points_m,
            weights,
            crossings(stamps_ns, laser),
            np.array(near[0].origin_vehicle_m),
            settings.span_m,
            settings.range_noise_m,
            math.radians(settings.pointing_deg),
            math.radians(settings.beam_deg),
        )
        return DroneFix(
            stamp_ns=int(stamps_ns[0]) + round(float(np.average(since_ns, weights=weights))),
            xyz_vehicle_m=t,
            covariance_m2=covariance_m2,
            hits=len(points_m),
            mean_shift=MeanShiftResult(iterations=iterations, shift_m=shift_m),
        )
