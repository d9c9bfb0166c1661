"""Estimate of the drone by IMU: a bank of yaw hypotheses until the heading is decided, then a factor graph.

Measurements are used in order of time, up to the horizon (measurement_queue.py). The published state is propagated from
the horizon by the IMU. A position that arrives after the horizon has passed its time is moved to the horizon by the
estimated velocity; the horizon then waits for the next ones.

The heading of a lost drone is remembered and propagated by the gyroscope: it is one hypothesis when a drone is found.

Source: ours; DESIGN, Fusion.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.consistency import InformationInflation, Rejected, inflation
from stages.fuse.cues.cue_fusion import SEEN_NS, CueFusion
from stages.fuse.fix_covariance import FixCovariance, fix_covariance
from stages.fuse.graph import InertialGraph
from stages.fuse.measurement_queue import LATEST_NS, Measurement, MeasurementQueue
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64, heading_rad
from stages.geometry.se3 import CHI2_999_3, mahalanobis2
from stages.geometry.trajectory import VehicleTrajectory
from stages.heading.autopilot_samples import AutopilotSamples
from stages.heading.earlier_frame import EarlierFrame
from stages.heading.heading_memory import HeadingMemory
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_heading import InertialHeading, bias_free_turn, turn_between
from stages.heading.inertial_state import POSITION, THETA, VELOCITY, InertialState, yaw_sigma_rad
from stages.heading.map_outage import KnownState
from stages.heading.odometry_heading import OdometryHeading, OdomYaw
from stages.heading.ownership import Ownership, log_evidence
from stages.heading.rotation_matches import RotationMatches, combine
from stages.heading.same_frame import PriorHeading
from stages.messages import CueFactor, DroneCue, DroneFix, DroneMotion, RelativeRotation, VisualMotion

TILT_TIME_S = 20.0  # time constant of the error of roll and pitch
KEPT_NS = 15_000_000_000  # without a LiDAR position the estimate ends; the heading is remembered
FREE_NS = 1_000_000_000  # without IMU and vanishing points the yaw is dropped after this time
LATE_MPS2 = 1.5  # change of velocity that moving a late position to the state's time ignores


class Estimator:
    """State of the drone that is followed."""

    def __init__(self, errors: FuseErrors, vehicle: VehicleTrajectory, lag_s: float) -> None:
        self._errors, self._vehicle = errors, vehicle
        self.imu = ImuBuffer()
        self.heading = InertialHeading(self.imu)
        self.graph = InertialGraph(self.imu, lag_s)
        self.cues = CueFusion(errors, self.graph)
        self.cue_factors: list[CueFactor] = []  # since they were last taken
        self._by_imu: tuple[int, InertialState] | None = None  # the newest LiDAR position, propagated by the IMU alone
        self.ownership = Ownership()
        self.suspect = False  # what was followed moved otherwise than the IMU measures, and nothing has shown since
        self.odometry = OdometryHeading(math.radians(errors.compass_deg), errors.compass_outliers)
        self._autopilot = AutopilotSamples()
        self._memory = HeadingMemory(self.imu)
        self.earlier = EarlierFrame(errors.changed_frames)
        self.map_fixed = False  # `map` does not move with the vehicle
        self.map_number = 0  # how often a map frame has begun
        self._queue = MeasurementQueue(self.imu, vehicle)
        self.resets, self.too_late = 0, 0
        self.fix_ns: int | None = None  # newest LiDAR position used
        self.newest_fix_ns: int | None = None  # also when the drone is lost
        self.rotation_ns: int | None = None  # newest rotation by vanishing points used
        self._cameras_confirmed = False  # the graph was started with confirmed matches of both cameras
        self.nis = math.nan
        self.bias_covariance_m2 = np.zeros((3, 3))
        self._restart_filters()

    def _restart_filters(self) -> None:
        self._fix_inflation = InformationInflation(self._errors.fix_time_s)
        self._rotation_inflation = InformationInflation(self._errors.rotation_time_s)
        self._rejected, self._rejected_rotations = Rejected(), Rejected()
        self.ownership.restart(self.suspect)
        self._vertical_ns = 0
        self.rotation_ns = None
        self.rotation_bias_rad2 = np.zeros((3, 3))

    # input

    def add_motion(self, motion: DroneMotion, fixed: bool) -> None:
        """Add an IMU interval with the autopilot's vertical and, while independent, its odometry.

        `fixed`: the map frame does not move; otherwise the interval is kept for the time after the outage.
        """
        self.earlier.add_motion(motion)
        if not fixed or not self.imu.add(motion):
            return
        self._autopilot.add(motion)
        if motion.gyro_bias is not None:
            (self.graph if self.graph.running else self.heading).add_vertical_gyro_bias(motion.gyro_bias)

    def add(self, measurement: Measurement) -> None:
        """Add a measurement; it is used when the horizon reaches its time."""
        if isinstance(measurement, VisualMotion):
            self.imu.add_visual_motion(measurement)
        self._queue.add(measurement)

    def pass_time(self, now_ns: int) -> None:
        """Move the horizon and use the measurements before it."""
        horizon_ns = self._queue.horizon_ns(now_ns)
        for measurement in self._queue.until(horizon_ns):
            if isinstance(measurement, DroneFix):
                self._use_fix(measurement)
            elif isinstance(measurement, RelativeRotation):
                self._use_rotation(measurement)
            elif isinstance(measurement, DroneCue):
                self._use_cue(measurement)
            else:
                self._use_visual_motion(measurement)
        self._advance(horizon_ns)
        if self.fix_ns is not None and now_ns - self.fix_ns > KEPT_NS:
            self.lose()

    # state

    @property
    def measured_rotation_ns(self) -> int | None:
        """Newest measurement of the rotation: by vanishing points, or by a LiDAR position together with the IMU."""
        by_imu = self.fix_ns if self.decided and self.imu.is_current(self.stamp_ns) else None
        return max((ns for ns in (self.rotation_ns, by_imu) if ns is not None), default=None)

    @property
    def known(self) -> bool:
        """Whether a position is known."""
        return self.graph.running or self.heading.bank is not None

    @property
    def decided(self) -> bool:
        """Whether the heading is known."""
        return self.graph.running or self.heading.decided

    @property
    def is_own(self) -> bool:
        """Whether the followed object moves as the IMU measures, and so is the drone; without an IMU: not suspect."""
        if self.suspect:
            return self.ownership.cleared
        return self.ownership.certain or not self.imu.is_current(self.stamp_ns)

    @property
    def odom_yaw(self) -> OdomYaw | None:
        """Yaw of the autopilot's frame in `map`; None: not known, or the object may be another one than the drone."""
        if self.suspect or not (self.odometry.confirmed or self.ownership.certain):
            return None
        return self.odometry.axes

    @property
    def stamp_ns(self) -> int:
        """Time of the state at the horizon."""
        return self.graph.stamp_ns if self.graph.running else self.heading.stamp_ns

    def at(self, stamp_ns: int) -> InertialState:
        """One row: the state propagated to a time; its rotation is valid when `decided`."""
        if self.graph.running:
            return self.graph.at(stamp_ns)
        assert self.heading.bank is not None
        one = self.heading.decision() if self.decided else self.heading.bank.mean()
        return self.imu.propagate(one, np.ones(1), self.heading.stamp_ns, stamp_ns)

    def change_track(self) -> None:
        """Another object is followed: positions of the one before that wait for their time are not used."""
        self._queue.drop_fixes()
        if self.known:
            self.lose()

    def lose(self) -> None:
        """Drop the position; the heading is remembered."""
        if self.decided:
            state = self.graph.state if self.graph.running else self.heading.decision()
            self._memory.remember(self.stamp_ns, state)
        self._drop()

    def forget(self) -> None:
        """Drop the position, the remembered heading and the states before interruptions: a contradiction."""
        self.earlier.forget()
        self._forget_map()

    def _forget_map(self) -> None:
        """Drop what is known in frame map."""
        self._drop()
        self._memory.forget()
        self.odometry.restart()

    def begin_outage(self) -> None:
        """The vehicle's motion is not known any more: `map` moves with it, until it is known again."""
        self.earlier.begin_outage(self._vehicle.newest_ns or 0)
        self.start_map(math.pi)

    def start_map(self, turn_rad: float) -> None:
        """A map frame begins: that before an outage, maybe turned about the vehicle by up to an angle, or another.

        Everything in the one before is dropped, also what waits for its time.
        """
        self.map_number += 1
        self.earlier.start_frame(turn_rad)
        self._forget_map()
        self._queue.clear()
        self.imu.clear()
        self.cues.restart()

    def _drop(self) -> None:
        self.resets += self.known
        self.graph.stop()
        self.heading.stop()
        self.fix_ns, self.nis = None, math.nan
        self._by_imu = None
        self.cues.restart()
        self.earlier.restart_object()
        self._restart_filters()

    # measurements

    def _advance(self, stamp_ns: int) -> None:
        if self.graph.running and not self.imu.is_current(stamp_ns):
            self._to_bank()
        if self.graph.running:
            self.graph.advance(stamp_ns)
            return
        self.heading.advance(stamp_ns)
        last_ns = max(self.rotation_ns or 0, self.imu.newest_ns or 0)  # newest measurement of a rotation or a turn
        if last_ns and not self.imu.is_current(stamp_ns) and stamp_ns - last_ns > FREE_NS:
            self.heading.restart_yaw()
            self.rotation_ns = None
            self.rotation_bias_rad2 = np.zeros((3, 3))

    def _to_bank(self) -> None:
        """Go on with the bank, from the graph's state: the IMU has ended, or cameras give their first matches."""
        self.heading.resume(self.graph.stamp_ns, self.graph.state)
        self.graph.stop()

    def _use_fix(self, fix: DroneFix) -> None:
        stamp_ns = fix.stamp_ns
        if not self._vehicle.in_current_frame(stamp_ns):
            return
        R_map_vehicle, t = self._vehicle.at(stamp_ns)
        z, covariance = R_map_vehicle @ fix.xyz_vehicle_m + t, fix_covariance(fix, self._vehicle, self._errors)
        self.newest_fix_ns = max(stamp_ns, self.newest_fix_ns or stamp_ns)
        if self.map_fixed:
            self.earlier.add_position(stamp_ns, z, covariance.whole, self._velocity_map(fix), t)
        if self.odometry.odom_yaw is None and self._autopilot.odometry(stamp_ns) is None:
            self.odometry.start(self.earlier.odom_yaw(stamp_ns))
        prior = self.earlier.heading(self.known and self.decided) if self.imu.covers(stamp_ns) else None
        if not self.known or prior is not None:
            self._find(fix, z, covariance, prior)
            return
        late_ns = max(self.stamp_ns - stamp_ns, 0)
        if late_ns > LATEST_NS:
            self.too_late += 1
            return
        late_s = late_ns * 1e-9
        state = self._at_horizon(stamp_ns)
        v = state.velocity_mps[0]
        noise = covariance.white * self._fix_inflation.factor(stamp_ns) + (self._errors.clock_s**2) * np.outer(v, v)
        measured, z = z, z + late_s * v
        moved_m2 = late_s**2 * state.covariance[0, VELOCITY, VELOCITY] + (0.5 * LATE_MPS2 * late_s**2) ** 2 * np.eye(3)
        noise = noise + moved_m2
        off = z - state.xyz_m[0]
        nis = mahalanobis2(off, state.covariance[0, POSITION, POSITION] + noise)
        if nis > CHI2_999_3 and self._agrees_by_imu(stamp_ns, z, noise):
            self._continue_by_imu()
            state = self._at_horizon(stamp_ns)
            off = z - state.xyz_m[0]
            nis = mahalanobis2(off, state.covariance[0, POSITION, POSITION] + noise)
        if nis > CHI2_999_3 and self._rejected.add(stamp_ns, off, noise):
            self.forget()
            self._find(fix, z, covariance)
            return
        if nis <= CHI2_999_3:
            self._rejected.clear()
            self._add_odometry(stamp_ns, measured, float(noise[0, 0] + noise[1, 1]) / 2, state)
        if self.graph.running:
            used = self._add_to_graph(max(stamp_ns, self.stamp_ns), z, noise, nis, state)
        else:
            used = nis <= CHI2_999_3
            self._add_to_bank(stamp_ns, z, noise)
        if used and self.known:
            self.nis, self.fix_ns = nis, max(stamp_ns, self.fix_ns or stamp_ns)
            self.bias_covariance_m2 = covariance.bias
            self._by_imu = (self.graph.stamp_ns, self.graph.state) if self.graph.running else None
            if self.graph.running and self.is_own:
                up = self.graph.state.R[0, 2]
                bias_rad2 = float(up @ self.rotation_bias_rad2 @ up)
                self.earlier.add_state(KnownState(self.graph.stamp_ns, self.graph.state, bias_rad2, self.odom_yaw))

    def _at_horizon(self, stamp_ns: int) -> InertialState:
        """State at a measurement that is not before the horizon, else at the horizon."""
        if self.graph.running:
            return self.graph.at(max(stamp_ns, self.graph.stamp_ns))
        self.heading.advance(stamp_ns)
        assert self.heading.bank is not None
        return self.heading.bank.mean()

    def _add_to_graph(self, stamp_ns: int, z: Array64, noise: Array64, nis: float, predicted: InertialState) -> bool:
        """Add a LiDAR position to the graph, unless it is rejected. Whether it is in the estimate."""
        used = nis <= CHI2_999_3 and self.graph.add_position(stamp_ns, z, noise, predicted)
        if not used:
            self.graph.advance(stamp_ns)
        self._add_vertical(self.graph.stamp_ns)
        off = z - predicted.xyz_m[0]
        self._add_ownership(stamp_ns, z, noise, log_evidence(off, predicted.covariance[0, POSITION, POSITION] + noise))
        return used

    def _add_to_bank(self, stamp_ns: int, z: Array64, noise: Array64) -> None:
        """Add a LiDAR position to the bank; the graph starts when the heading is decided."""
        self.heading.advance(stamp_ns)
        self._add_vertical(self.heading.stamp_ns)
        self._add_ownership(stamp_ns, z, noise, self.heading.add_position(z, noise))
        self.heading.decide(self.is_own)
        if self.decided and self._contradicts_earlier(stamp_ns):
            self.earlier.forget()
            if self._autopilot.odometry(stamp_ns) is None:  # otherwise the axes are measured in this frame
                self.odometry.restart()
        if self.decided and self.imu.is_current(stamp_ns) and not self.heading.cameras_open:
            self._cameras_confirmed = self.heading.cameras_confirmed
            self.graph.start(self.heading.stamp_ns, self.heading.decision())
            if self.graph.running:
                self.heading.stop()

    def _contradicts_earlier(self, stamp_ns: int) -> bool:
        """Whether the decided yaw, at a LiDAR position, is another one than before the interruption."""
        turn, _ = self.heading.turn(stamp_ns, self.heading.stamp_ns)
        return self.earlier.contradicts(heading_rad(self.heading.decision().R[0] @ turn.T))

    def _add_ownership(self, stamp_ns: int, z: Array64, noise: Array64, evidence: float | None) -> None:
        """Whether the object is the drone; the estimate of another one ends, and nothing is published until it is."""
        self.ownership.add(stamp_ns, z, noise, evidence if self.imu.is_current(stamp_ns) else None)
        if self.ownership.cleared:
            self.suspect = False
        if self.ownership.denied if self.graph.running else self.ownership.excluded:
            self.suspect = True
            self.forget()

    def _velocity_map(self, fix: DroneFix) -> Array64 | None:
        """The tracker's velocity in `map`; None: not known."""
        if fix.velocity_vehicle_mps is None:
            return None
        return self._vehicle.to_map(fix.stamp_ns, fix.xyz_vehicle_m, fix.velocity_vehicle_mps)[1]

    def _find(self, fix: DroneFix, z: Array64, covariance: FixCovariance, prior: PriorHeading | None = None) -> None:
        """Start at a LiDAR position; `prior`: heading before, if the frame is the same."""
        up = self._autopilot.up_drone(fix.stamp_ns)
        self._restart_filters()
        self.odometry.on_found()
        if prior is None:
            memory = self._memory.yaw(fix.stamp_ns, z, covariance.whole)
        else:
            memory = prior.yaw_rad, prior.sigma_rad, prior.probability
            self.ownership.log_ratio += prior.log_ratio
        level = np.array([0.0, 0.0, 1.0]) if up is None else up
        self.heading.start(fix.stamp_ns, z, covariance.whole, self._velocity_map(fix), level, memory)
        self.fix_ns, self.bias_covariance_m2 = fix.stamp_ns, covariance.bias

    def _add_vertical(self, stamp_ns: int) -> None:
        """The autopilot's roll and pitch, each tilt_period_s."""
        e = self._errors
        up = self._autopilot.up_drone(stamp_ns)
        if up is None or (stamp_ns - self._vertical_ns) * 1e-9 < e.tilt_period_s:
            return
        self._vertical_ns = stamp_ns
        sigma = math.radians(e.tilt_deg) * math.sqrt(inflation(e.tilt_period_s, TILT_TIME_S))
        if self.graph.running:
            self.graph.add_vertical(up, sigma)
        else:
            self.heading.add_vertical(up, sigma)

    def _add_odometry(self, stamp_ns: int, z: Array64, variance_m2: float, state: InertialState) -> None:
        """The autopilot's own position at a LiDAR position: evidence for the heading while it is undecided.

        `state`: one row, at the LiDAR position, or at the horizon if that is later.
        """
        own = self._autopilot.odometry(stamp_ns)
        self.heading.evidence = None
        if own is not None:
            self.odometry.add(stamp_ns, z, variance_m2, own.xyz_odom_m, own.segment)
            if not self.graph.running:
                self.heading.evidence = self.odometry.evidence(stamp_ns, own.R_odom_drone)
        if self.graph.running:
            self._add_attitude(max(stamp_ns, self.stamp_ns), state)

    def _add_attitude(self, stamp_ns: int, state: InertialState) -> None:
        """The axes of the autopilot's attitude, by the yaw of the body; state: one row, at the time."""
        own = self._autopilot.odometry(stamp_ns)
        if own is None:
            return
        sigma_rad = yaw_sigma_rad(state.R[0], state.covariance[0, THETA, THETA] + self.rotation_bias_rad2)
        yaw_rad = math.remainder(state.yaw_rad[0] - heading_rad(own.R_odom_drone), 2 * math.pi)
        self.odometry.add_attitude(OdomYaw(stamp_ns, yaw_rad, sigma_rad))

    def _use_rotation(self, rotation: RelativeRotation) -> None:
        if not (len(rotation.rotations) and self.known and self._vehicle.in_current_frame(rotation.stamp_ns)):
            return
        stamp_ns, bias_share = rotation.stamp_ns, self._errors.rotation_bias_share
        R_map_vehicle = self._vehicle.at(stamp_ns)[0]
        white = (1.0 - bias_share) * rotation.covariances_rad2
        matches = RotationMatches(R_map_vehicle @ rotation.rotations, white, rotation.probabilities, R_map_vehicle)
        factor = self._rotation_inflation.factor(stamp_ns)
        if self.graph.running and not self._cameras_confirmed:
            self._to_bank()
        if not self.graph.running:
            self.heading.advance(stamp_ns)
            used = (self.heading.add_rotation(stamp_ns, matches, 1.0 / factor) or 0.0) > 0.5
        elif abs(stamp_ns - self.graph.stamp_ns) > LATEST_NS:
            self.too_late += 1
            return
        else:
            used = self._add_rotation_to_graph(stamp_ns, matches, factor)
        if used:
            self.rotation_ns = stamp_ns
            self.rotation_bias_rad2 = bias_share * rotation.covariances_rad2[0]

    def _add_rotation_to_graph(self, stamp_ns: int, matches: RotationMatches, factor: float) -> bool:
        """Add the matches as one rotation, its variance times `factor`. Whether it is in the estimate."""
        graph = self.graph
        turn = turn_between(self.imu, stamp_ns, graph.stamp_ns, graph.state.bias[0])
        one = combine(graph.state, matches.turned(*turn))
        if one.R_map_drone is None:
            if self._rejected_rotations.add(stamp_ns, one.residual_rad, one.covariance_rad2):
                self.forget()
            return False
        self._rejected_rotations.clear()
        return graph.add_rotation(one.R_map_drone, factor * one.spread_rad2)

    def _use_cue(self, cue: DroneCue) -> None:
        """Add a cue to the graph, while there is one."""
        known = self._vehicle.known_at(cue.stamp_ns) or not self._vehicle.known
        if not (self.graph.running and self.fix_ns and known and self._vehicle.in_current_frame(cue.stamp_ns)):
            return
        by_imu = None
        if cue.stamp_ns - self.fix_ns >= SEEN_NS:
            by_imu = self._propagated_by_imu()
            if by_imu is None:
                return
        factor = self.cues.add(cue, self._vehicle, by_imu)
        if factor is None:
            return
        self.cue_factors.append(factor)
        if by_imu is not None and factor.contradicts:
            self._continue_by_imu()

    def _propagated_by_imu(self) -> InertialState | None:
        """The newest LiDAR position, propagated to the graph's time by the IMU alone."""
        if self._by_imu is None or not self.graph.running:
            return None
        stamp_ns, state = self._by_imu
        if self.graph.stamp_ns > stamp_ns:
            state = self.imu.propagate(state, np.ones(1), stamp_ns, self.graph.stamp_ns)
            self._by_imu = self.graph.stamp_ns, state
        return state

    def _agrees_by_imu(self, stamp_ns: int, z: Array64, noise: Array64) -> bool:
        """Whether a LiDAR position agrees with the IMU alone, after cues were used since the one before."""
        if not self.graph.running or self.fix_ns is None or not self.cues.used_since(self.fix_ns + SEEN_NS):
            return False
        state = self._propagated_by_imu()
        if state is None:
            return False
        ahead = self.imu.propagate(state, np.ones(1), self.graph.stamp_ns, max(stamp_ns, self.graph.stamp_ns))
        return mahalanobis2(z - ahead.xyz_m[0], ahead.covariance[0, POSITION, POSITION] + noise) <= CHI2_999_3

    def _continue_by_imu(self) -> None:
        """Take the cues of this gap out of the estimate."""
        assert self.fix_ns is not None
        for source in self.cues.used_since(self.fix_ns + SEEN_NS):
            self.cues.distrust(source)
        state = self._propagated_by_imu()
        if state is not None:
            self.graph.start(self.graph.stamp_ns, state)

    def _use_visual_motion(self, motion: VisualMotion) -> None:
        if not self.graph.running:
            self.heading.advance(motion.stamp_ns)
            self.heading.add_visual_motion(motion)
            return
        turn = bias_free_turn(self.imu, motion)
        if turn is not None:
            rate, by_images, covariance = turn
            self.graph.add_gyro_bias(rate - by_images, covariance)
