"""Track a drone by the likelihood of returns and pass-throughs: each scan pass updates its position and velocity.

    SEARCHING   no hypothesis
    CANDIDATE   a candidate of the detector is followed; no fix is published
    TRACKING    the detector accepted it and it returned pulses recently: a DroneFix for each scan pass with a return
    COASTING    no recent return; the state is predicted and its covariance grows
    LOST        no return for `lost_after_s` and no telemetry, or the detector no longer accepts it

A scan pass is one passing of the rotor over the drone. Each pulse is compared with the position predicted for the
pulse's own time (de-skewed by the velocities of drone and vehicle). Pulses that pass close to it without a return are
pass-throughs (stages/track/hull.py). Several hypotheses are followed while it is ambiguous which one is the drone.

Source: ours, for P III.C; DESIGN, The graph: track.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.frames import Array64, LidarMount
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.sweep.pulses import cone_of
from stages.kernels.track.scan_pass import largest_sigma_m
from stages.messages import (
    CandidateEvidence,
    Candidates,
    Detections,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    SweptPulses,
    TrackingState,
    TrackState,
    VehicleMotion,
)
from stages.track.hypotheses import Hypotheses, Hypothesis
from stages.track.scan_pass import ScanPass, collect_into, evaluate

IMPROBABLE = 0.2  # highest probability of a candidate at which its track ends
PASS_OVER_NS = 4_000_000  # this long after its last pulse a scan pass is complete
CANDIDATE_S = 1.5  # a hypothesis that is not accepted is removed this long after its last return


class LikelihoodTrackSettings(Settings):
    """Settings of `LikelihoodTrack`."""

    mount: LidarMount = LidarMount()  # its pointing_sigma_deg enters the bias covariance
    span_m: float = Field(0.5, gt=0, le=10)  # largest dimension of the drone
    hull_share: float = Field(0.075, ge=-1, le=1)  # distance of the centre behind the returns' mean, over the span
    max_drones: int = Field(1, ge=1, le=8)  # tracked at the same time
    max_hypotheses: int = Field(4, ge=0, le=16)  # unconfirmed candidates
    own_sigma_m: float = Field(0.8, gt=0)  # position sigma beyond which only the detector can reacquire the track
    manoeuvre: float = Field(1.0, gt=0)  # density q of the drone's acceleration [m^2/s^3]
    odometry_manoeuvre: float = Field(0.01, gt=0)  # the same with odometry
    coast_after_s: float = Field(0.35, gt=0)  # time without a return after which a track is COASTING
    lost_after_s: float = Field(6.0, gt=0)  # time without a return after which a track is LOST; with odometry later,
    lost_sigma_m: float = Field(5.0, gt=0)  # when its largest position sigma exceeds this
    start_sigma_mps: float = Field(1.5, gt=0)  # one sigma of the detector's velocity
    tilt_deg: float = Field(0.05, ge=0)  # of the servo's axis against the vehicle's, about x and y, one sigma each
    range_sigma_m: float = Field(0.017, ge=0)  # of the LiDAR, constant: VLP-16 data sheet 63-9229, +-3 cm, uniform
    shape_share: float = Field(0.03, ge=0, le=1)  # constant offset of the returns over the span, one sigma per axis
    use_pass_throughs: bool = True  # False: only returns count (ablation)
    de_skew: bool = True  # False: a scan pass has one time stamp (ablation)


class LikelihoodTrack(Stage[LikelihoodTrackSettings]):
    """Track up to `max_drones` drones by the likelihood of returns and pass-throughs of each scan pass."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"candidates", "motion", "drone_position", "drone_odometry"})

    def __init__(self, settings: LikelihoodTrackSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._vehicle = VehicleTrajectory()
        self._detector_instance: int | None = None  # candidate numbers are unique within one
        self._next_number: int = 1
        self._idle_ns: int = 0
        self._idle_reason: str = "no drone detected yet"
        settings = self.settings
        self._hypotheses = Hypotheses(
            settings.manoeuvre,
            settings.odometry_manoeuvre,
            settings.start_sigma_mps,
            settings.own_sigma_m,
            settings.max_drones,
        )

    def on_motion(self, motion: VehicleMotion) -> None:
        """Add the vehicle's pose; without any the vehicle is assumed to be parked."""
        self._vehicle.add(motion)

    def on_drone_position(self, position: DroneLocalPosition) -> None:
        """Add the drone's telemetry, by which tracks are predicted."""
        self._hypotheses.add_position(position)

    def on_drone_odometry(self, odometry: DroneOdometry) -> None:
        """Add the drone's odometry; preferred when both are sent."""
        self._hypotheses.add_odometry(odometry)

    def on_candidates(self, candidates: Candidates) -> Iterator[TrackState]:
        """Start hypotheses at probable candidates; remove tracks whose candidate is no longer accepted."""
        if self._detector_instance not in (None, candidates.detector_instance):
            self._hypotheses.clear_candidate_numbers()
        self._detector_instance = candidates.detector_instance
        own = set(candidates.candidate_id[candidates.probability >= 0.5].tolist())
        for i in range(len(candidates.candidate_id)):
            number, P = int(candidates.candidate_id[i]), float(candidates.probability[i])
            xyz, v = self._vehicle.to_map(
                candidates.stamp_ns, candidates.xyz_vehicle_m[i], candidates.velocity_vehicle_mps[i]
            )
            track = self._hypotheses.near(xyz, candidates.stamp_ns, number)
            if track is None and P >= 0.5:
                track = self._hypotheses.diverged(number, xyz, v, int(candidates.seen_ns[i]), candidates.stamp_ns)
            if track is not None:
                seen_later = int(candidates.seen_ns[i]) > track.last_return_ns
                uncertain = track.confirmed and seen_later and self._hypotheses.uncertain(track, candidates.stamp_ns)
                required = 0.5  # if the detector follows it, too
                if uncertain and track.candidate != number:
                    required = self._hypotheses.required_probability(
                        track, candidates.stamp_ns, candidates.accept_probability
                    )
                if uncertain and required <= P:
                    self._hypotheses.move(track, number, xyz, v, int(candidates.seen_ns[i]), candidates.stamp_ns)
                # an improbable candidate next to a track whose own candidate is probable is another object
                is_same_object = track.candidate == number or (
                    candidates.scan_passes[i] >= 6 and track.candidate not in own
                )
                improbable = min(IMPROBABLE, 1.0 - candidates.accept_probability)  # others would be accepted instead
                if improbable > P and track.confirmed and is_same_object:
                    yield from self._lose(
                        track, candidates.stamp_ns, f"no longer accepted as a drone: {candidates.reasons[i]}"
                    )
            elif P >= 0.5 and len(self._hypotheses) - len(self._hypotheses.confirmed) < self.settings.max_hypotheses:
                self._hypotheses.start(number, xyz, v, int(candidates.seen_ns[i]), candidates.stamp_ns)

    def on_detections(self, detections: Detections) -> Iterator[TrackState | DroneFix]:
        """Confirm the accepted candidates as drones."""
        evidence = detections.evidence
        for i in np.nonzero(detections.accepted)[0]:
            seen_ns, number, v = detections.stamp_ns, -1, np.zeros(3)
            if isinstance(evidence, CandidateEvidence):
                seen_ns, number = int(evidence.seen_ns[i]), int(evidence.candidate_id[i])
                v = evidence.velocity_vehicle_mps[i]
            xyz, v = self._vehicle.to_map(seen_ns, detections.xyz_vehicle_m[i], v)
            track = self._hypotheses.near(xyz, seen_ns, number) or self._hypotheses.diverged(
                number, xyz, v, seen_ns, seen_ns
            )
            drone = track if track is not None and track.confirmed else None
            if drone is not None and seen_ns > drone.last_return_ns and self._hypotheses.uncertain(drone, seen_ns):
                self._hypotheses.move(drone, number, xyz, v, seen_ns, seen_ns)
            if drone is None and (old := self._hypotheses.oldest_unseen(seen_ns)):
                yield from self._lose(old, seen_ns, "no return, while the detector accepted another drone")
            if track is None:
                if len(self._hypotheses.confirmed) >= self.settings.max_drones:
                    continue
                track = self._hypotheses.start(number, xyz, v, seen_ns, seen_ns)
            if not track.confirmed and len(self._hypotheses.confirmed) < self.settings.max_drones:
                track.confirmed = True
                track.number, self._next_number = self._next_number, self._next_number + 1
                track.candidate = number
                track.reason = "accepted by the detector"
                track.log_odds = max(track.log_odds, 4.0)
                yield self._state(track, max(detections.stamp_ns, track.stamp_ns))

    def on_pulses(self, pulses: SweptPulses) -> Iterator[DroneFix | TrackState]:
        """Collect each track's pulses, evaluate complete scan passes, publish states and fixes."""
        if pulses.range_m.size == 0:
            return
        now_ns = int(pulses.point_stamp_ns[-1])
        if len(self._hypotheses):
            yield from self._follow(pulses, now_ns)
        if not len(self._hypotheses) and now_ns - self._idle_ns > 500_000_000:
            self._idle_ns = now_ns
            yield TrackState(
                stamp_ns=now_ns,
                state=TrackingState.SEARCHING,
                reason=self._idle_reason,
                hits=0,
                frame_s=0.5,
                track_id=0,
            )

    def _follow(self, pulses: SweptPulses, now_ns: int) -> Iterator[DroneFix | TrackState]:
        """Update each hypothesis with a slice."""
        hypotheses, span_m, de_skew = self._hypotheses, self.settings.span_m, self.settings.de_skew
        ends_ns = (pulses.stamp_ns, now_ns) if de_skew else (pulses.middle_ns, pulses.middle_ns)
        ends = self._vehicle.at(ends_ns[0]), self._vehicle.at(ends_ns[1])
        cone = cone_of(pulses.direction_vehicle)
        for track in hypotheses:
            if track not in hypotheses:  # removed in this loop as a duplicate
                continue
            yield from self._close_before(track, pulses.stamp_ns)
            before = track.scan_pass
            state = hypotheses.at(track, pulses.stamp_ns) if before is None else (before.x, before.P)
            track.scan_pass = collect_into(before, pulses, ends, cone, *state, span_m, de_skew)
            if before is None:
                track.pass_sample = hypotheses.sample(pulses.stamp_ns)
            yield from self._close_before(track, now_ns)
            if track in hypotheses:
                yield from self._publish_state(track, now_ns)

    def _lose(self, track: Hypothesis, now_ns: int, why: str) -> Iterator[TrackState]:
        self._hypotheses.drop(track)
        if track.confirmed:
            self._idle_reason = f"lost drone {track.number}: {why}"
            yield TrackState(
                stamp_ns=now_ns, state=TrackingState.LOST, reason=why, hits=0, frame_s=0.1, track_id=track.number
            )

    def _publish_state(self, track: Hypothesis, now_ns: int) -> Iterator[TrackState]:
        """Publish coasting and loss between scan passes; remove duplicates."""
        settings = self.settings
        silent_s = (now_ns - track.last_return_ns) * 1e-9
        gone = silent_s > (settings.lost_after_s if track.confirmed else CANDIDATE_S)
        if track.confirmed and gone:
            has_odometry = self._hypotheses.sample(now_ns) is not None
            gone = not (has_odometry and largest_sigma_m(self._hypotheses.at(track, now_ns)[1]) < settings.lost_sigma_m)
        if gone or track.log_odds < -4.0:
            why = f"no return for {silent_s:.1f} s" if silent_s > 1.0 else "no return in repeated scan passes"
            yield from self._lose(track, now_ns, why)
        elif track.confirmed:
            for other in self._hypotheses:  # duplicates
                if other is not track and np.linalg.norm(other.x[:3] - track.x[:3]) < settings.span_m:
                    younger = other if not other.confirmed or other.number > track.number else track
                    if younger is not track:
                        yield from self._lose(other, now_ns, f"is the same as drone {track.number}")
            if now_ns - track.published_ns > 100_000_000:
                if silent_s > settings.coast_after_s:
                    track.reason = f"no return for {silent_s:.1f} s"
                yield self._state(track, now_ns)
        elif now_ns - track.published_ns > 100_000_000:
            yield self._state(track, now_ns)

    def _state(self, track: Hypothesis, now_ns: int) -> TrackState:
        silent_s = (now_ns - track.last_return_ns) * 1e-9
        state = TrackingState.CANDIDATE
        if track.confirmed:
            state = TrackingState.COASTING if silent_s > self.settings.coast_after_s else TrackingState.TRACKING
        x, P = self._hypotheses.at(track, now_ns)
        R, _ = self._vehicle.at(now_ns)
        xyz, velocity = self._vehicle.to_vehicle(now_ns, x[:3], x[3:])
        covariance = R.T @ P[:3, :3] @ R + self._bias_covariance(xyz)
        # a recent return is relative to the vehicle and needs no vehicle pose
        if silent_s > self.settings.coast_after_s:
            covariance += self._vehicle.extrapolation_covariance_m2(now_ns, xyz)
        track.published_ns = now_ns
        return TrackState(
            stamp_ns=now_ns,
            state=state,
            reason=track.reason,
            hits=track.hits,
            frame_s=0.1,
            track_id=track.number,
            xyz_vehicle_m=xyz,
            velocity_vehicle_mps=velocity,
            covariance_m2=covariance,
        )

    # one scan pass

    def _close_before(self, track: Hypothesis, stamp_ns: int) -> Iterator[DroneFix | TrackState]:
        """Evaluate the track's scan pass if its last pulse is PASS_OVER_NS before a time."""
        scan_pass = track.scan_pass
        if scan_pass is not None and stamp_ns - scan_pass.last_ns > PASS_OVER_NS:
            track.scan_pass = None
            yield from self._close(track, scan_pass)

    def _close(self, track: Hypothesis, scan_pass: ScanPass) -> Iterator[DroneFix | TrackState]:
        settings = self.settings
        seen = evaluate(
            scan_pass,
            settings.span_m,
            settings.hull_share * settings.span_m,
            track.p_0,
            settings.use_pass_throughs,
            settings.own_sigma_m,
        )
        track.hits = 0 if seen is None else seen.hits
        if seen is None:
            return
        self._hypotheses.update(track, scan_pass.start_ns, seen.x, seen.P, track.pass_sample)
        track.log_odds = min(max(track.log_odds + seen.log_likelihood_ratio, -8.0), 8.0)
        if seen.hits == 0:
            return
        track.last_return_ns = seen.return_ns
        if seen.expected > 0.5:
            ratio = min(max(track.p_0 * seen.hits / seen.expected, 0.15), 0.95)
            track.p_0 += 0.1 * (ratio - track.p_0)
        track.reason = f"{seen.hits} returns, {seen.other_pulses} pulses next to it"
        if track.confirmed:
            self._hypotheses.learn(track)
            yield self._fix(track)
        yield self._state(track, max(scan_pass.last_ns, track.last_return_ns, track.published_ns))

    def _fix(self, track: Hypothesis) -> DroneFix:
        x, P = self._hypotheses.at(track, track.last_return_ns)
        R, _ = self._vehicle.at(track.last_return_ns)
        xyz, velocity = self._vehicle.to_vehicle(track.last_return_ns, x[:3], x[3:])
        bias_covariance_m2 = self._bias_covariance(xyz)
        return DroneFix(
            stamp_ns=track.last_return_ns,
            xyz_vehicle_m=xyz,
            covariance_m2=R.T @ P[:3, :3] @ R + bias_covariance_m2,
            hits=track.hits,
            track_id=track.number,
            velocity_vehicle_mps=velocity,
            bias_covariance_m2=bias_covariance_m2,
        )

    def _bias_covariance(self, xyz_vehicle_m: Array64) -> Array64:
        """Covariance (3, 3) [m^2] that does not average out: turntable zero and tilt, range, and the drone's shape.

        Vehicle axes. The line of sight is taken from the vehicle's origin, decimetres from the LiDAR's.
        """
        settings = self.settings
        along = xyz_vehicle_m * (settings.range_sigma_m / max(float(np.linalg.norm(xyz_vehicle_m)), 1e-9))
        level = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0]) * math.radians(settings.mount.pointing_sigma_deg)
        x, y, z = xyz_vehicle_m * math.radians(settings.tilt_deg)
        tilted = np.outer([0.0, -z, y], [0.0, -z, y]) + np.outer([z, 0.0, -x], [z, 0.0, -x])
        outline = (settings.shape_share * settings.span_m) ** 2 * np.eye(3)
        return np.outer(level, level) + tilted + np.outer(along, along) + outline
