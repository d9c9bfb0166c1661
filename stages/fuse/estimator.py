"""Estimate of the drone by IMU: a bank of yaw hypotheses until the heading is decided, then a factor graph.

Measurements are used in order of time, up to the horizon: the time up to which the motions of drone and vehicle are
measured. The published state is propagated from the horizon by the IMU. A measurement that arrives after the horizon
has passed its time is moved to the horizon.

The heading of a lost drone is remembered and propagated by the gyroscope: it is one hypothesis when a drone is found.

Source: ours; DESIGN, Fusion.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from stages.fuse.consistency import InformationInflation, Rejected, inflation
from stages.fuse.graph import InertialGraph
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2
from stages.geometry.trajectory import VehicleTrajectory
from stages.heading import bank_measurements as measure
from stages.heading.autopilot_samples import AutopilotSamples
from stages.heading.earlier_run import EarlierRun
from stages.heading.heading_memory import HeadingMemory
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_bank import InertialBank
from stages.heading.inertial_heading import InertialHeading, bias_free_turn, turn_between
from stages.heading.inertial_state import POSITION, THETA, VELOCITY, InertialState, log_rotations
from stages.heading.odometry_heading import OdometryHeading, OdomYaw
from stages.heading.ownership import Ownership, log_evidence
from stages.messages import DroneFix, DroneMotion, RelativeRotation, VisualMotion

DELAY_NS = 100_000_000  # measurements arrive at most this long after their stamp
GATE = 16.27  # chi-square, 3 degrees of freedom, 99.9 %
TILT_TIME_S = 20.0  # time constant of the error of roll and pitch
KEPT_NS = 15_000_000_000  # without a LiDAR position the estimate ends; the heading is remembered
VEHICLE_NS, WAIT_NS = 60_000_000, 350_000_000  # extrapolation of the vehicle's pose; longest wait for a newer one
IMAGE_NS = 300_000_000  # without an IMU, longest wait for the drone's next image
FREE_NS = 1_000_000_000  # without IMU and vanishing points the yaw is dropped after this time
Measurement = DroneFix | RelativeRotation | VisualMotion


@dataclass(frozen=True)
class FixCovariance:
    """Error of a LiDAR position, map axes [m2]: white, and a bias that does not average out."""

    white: Array64
    bias: Array64


class Estimator:
    """State of the drone that is followed."""

    def __init__(self, errors: FuseErrors, vehicle: VehicleTrajectory, lag_s: float) -> None:
        self._errors, self._vehicle = errors, vehicle
        self.imu = ImuBuffer()
        self.heading = InertialHeading(self.imu)
        self.graph = InertialGraph(self.imu, lag_s)
        self.ownership = Ownership()
        self.suspect = False  # what was followed moved otherwise than the IMU measures, and nothing has shown since
        self.odometry = OdometryHeading(math.radians(errors.compass_deg), errors.compass_outliers)
        self._autopilot = AutopilotSamples()
        self._memory = HeadingMemory(self.imu)
        self.earlier = EarlierRun(errors.changed_frames)
        self._waiting: list[tuple[int, int, Measurement]] = []
        self._count = 0
        self.resets, self.too_late = 0, 0
        self.fix_ns: int | None = None  # newest LiDAR position used
        self.newest_fix_ns: int | None = None  # also when the drone is lost
        self.rotation_ns: int | None = None  # newest rotation by vanishing points used
        self.nis = math.nan
        self.bias_covariance_m2 = np.zeros((3, 3))
        self.rotation_bias_rad2 = np.zeros((3, 3))
        self._restart_filters()

    def _restart_filters(self) -> None:
        self._fix_inflation = InformationInflation(self._errors.fix_time_s)
        self._rotation_inflation = InformationInflation(self._errors.rotation_time_s)
        self._rejected, self._rejected_rotations = Rejected(), Rejected()
        self.ownership.restart(self.suspect)
        self._vertical_ns = 0
        self.rotation_ns = None

    # input

    def add_motion(self, motion: DroneMotion) -> None:
        """Add an IMU interval with the autopilot's vertical and, while independent, its odometry."""
        if self.imu.add(motion):
            self._autopilot.add(motion)

    def add(self, measurement: Measurement) -> None:
        """Add a measurement; it is used when the horizon reaches its time."""
        if isinstance(measurement, VisualMotion):
            self.imu.add_visual_motion(measurement)
        self._count += 1
        heapq.heappush(self._waiting, (measurement.stamp_ns, self._count, measurement))

    def pass_time(self, now_ns: int) -> None:
        """Move the horizon and use the measurements before it."""
        horizon_ns = self._horizon_ns(now_ns)
        while self._waiting and self._waiting[0][0] <= horizon_ns:
            _, _, measurement = heapq.heappop(self._waiting)
            if isinstance(measurement, DroneFix):
                self._use_fix(measurement)
            elif isinstance(measurement, RelativeRotation):
                self._use_rotation(measurement)
            else:
                self._use_visual_motion(measurement)
        self._advance(horizon_ns)
        if self.fix_ns is not None and now_ns - self.fix_ns > KEPT_NS:
            self.lose()

    def _horizon_ns(self, now_ns: int) -> int:
        """Time up to which the motion of the drone and of the vehicle is measured."""
        newest_ns, image_ns = self.imu.newest_ns, self.imu.newest_image_ns
        horizon_ns = now_ns
        if newest_ns is not None and self.imu.is_current(now_ns):
            horizon_ns = min(newest_ns, now_ns - DELAY_NS)
        elif image_ns is not None and now_ns - image_ns < IMAGE_NS:
            horizon_ns = min(image_ns, now_ns)
        vehicle_ns = self._vehicle.newest_ns if self._vehicle.known_at(now_ns) else None
        if vehicle_ns is not None:
            horizon_ns = min(horizon_ns, max(vehicle_ns + VEHICLE_NS, now_ns - WAIT_NS))
        return horizon_ns

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
        return self.graph.running or (self.heading.decided and self.is_own)

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
        return self.odometry.odom_yaw

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

    def lose(self) -> None:
        """Drop the position; the heading is remembered."""
        if self.decided:
            state = self.graph.state if self.graph.running else self.heading.decision()
            self._memory.remember(self.stamp_ns, state)
        self._drop()

    def forget(self) -> None:
        """Drop the position and the remembered heading: a contradiction."""
        self._drop()
        self._memory.forget()
        self.odometry.restart()

    def start_map(self) -> None:
        """Another map frame begins: drop everything, also what waits for its time."""
        self.forget()
        self._waiting.clear()
        self.imu.clear()

    def _drop(self) -> None:
        self.resets += self.known
        self.graph.stop()
        self.heading.stop()
        self.fix_ns, self.nis = None, math.nan
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

    def _to_bank(self) -> None:
        """The IMU has ended: go on with the bank, from the graph's state."""
        self.heading.resume(self.graph.stamp_ns, self.graph.state)
        self.graph.stop()

    def fix_covariance(self, fix: DroneFix, R_map_vehicle: Array64) -> FixCovariance:
        """Error of a LiDAR position, map axes."""
        e = self._errors
        whole = e.fix_variance * fix.covariance_m2
        bias = e.fix_bias_share * whole
        if fix.bias_covariance_m2 is not None:
            bias = fix.bias_covariance_m2
            whole = bias + e.fix_variance * (fix.covariance_m2 - bias)
        R, ahead = R_map_vehicle, np.zeros((3, 3))
        if self._vehicle.known_at(fix.stamp_ns):  # otherwise the vehicle frame serves as the map frame
            ahead = self._vehicle.extrapolation_covariance_m2(fix.stamp_ns, fix.xyz_vehicle_m)
        return FixCovariance(R @ (whole - bias + ahead) @ R.T, R @ bias @ R.T)

    def _use_fix(self, fix: DroneFix) -> None:
        stamp_ns = fix.stamp_ns
        if not self._vehicle.in_current_frame(stamp_ns):
            return
        R_map_vehicle, t = self._vehicle.at(stamp_ns)
        z, covariance = R_map_vehicle @ fix.xyz_vehicle_m + t, self.fix_covariance(fix, R_map_vehicle)
        self.newest_fix_ns = max(stamp_ns, self.newest_fix_ns or stamp_ns)
        whole_m2 = covariance.white + covariance.bias
        if self.odometry.odom_yaw is None:
            self.odometry.start(self.earlier.odom_yaw(stamp_ns, z, whole_m2))
        earlier = self.earlier.heading(stamp_ns, z, whole_m2, self.known and self.decided)
        if not self.known or earlier is not None:
            self._find(fix, z, covariance, earlier)
            return
        late_s = max(self.stamp_ns - stamp_ns, 0) * 1e-9
        if late_s > 0.5:
            self.too_late += 1
            return
        state = self._at_horizon(stamp_ns)
        v = state.velocity_mps[0]
        noise = covariance.white * self._fix_inflation.factor(stamp_ns) + (self._errors.clock_s**2) * np.outer(v, v)
        measured, z = z, z + late_s * v
        noise = noise + (0.75 * late_s**2) ** 2 * np.eye(3)
        off = z - state.xyz_m[0]
        nis = mahalanobis2(off, state.covariance[0, POSITION, POSITION] + noise)
        if nis > GATE and self._rejected.add(stamp_ns, off, noise):
            self.forget()
            self._find(fix, z, covariance)
            return
        if nis <= GATE:
            self._rejected.clear()
            self._add_odometry(stamp_ns, measured, float(noise[0, 0] + noise[1, 1]) / 2)
        if self.graph.running:
            used = self._add_to_graph(max(stamp_ns, self.stamp_ns), z, noise, nis, state)
        else:
            used = nis <= GATE
            self.heading.advance(stamp_ns)
            self._add_vertical(self.heading.stamp_ns)
            self.heading.add_position(self.heading.stamp_ns, z, noise)
            assert self.heading.bank is not None
            self._add_ownership(stamp_ns, z, noise, self.heading.position_evidence)
            if self.known and self.decided and self.imu.is_current(stamp_ns):
                self._start_graph()
        if used and self.known:
            self.nis, self.fix_ns = nis, max(stamp_ns, self.fix_ns or stamp_ns)
            self.bias_covariance_m2 = covariance.bias

    def _at_horizon(self, stamp_ns: int) -> InertialState:
        """State at a measurement that is not before the horizon, else at the horizon."""
        if self.graph.running:
            return self.graph.at(max(stamp_ns, self.graph.stamp_ns))
        self.heading.advance(stamp_ns)
        assert self.heading.bank is not None
        return self.heading.bank.mean()

    def _add_to_graph(self, stamp_ns: int, z: Array64, noise: Array64, nis: float, predicted: InertialState) -> bool:
        """Add a LiDAR position to the graph, unless it is rejected. Whether it is in the estimate."""
        used = nis <= GATE and self.graph.add_position(stamp_ns, z, noise, predicted)
        if not used:
            self.graph.advance(stamp_ns)
        self._add_vertical(self.graph.stamp_ns)
        off = z - predicted.xyz_m[0]
        self._add_ownership(stamp_ns, z, noise, log_evidence(off, predicted.covariance[0, POSITION, POSITION] + noise))
        return used

    def _add_ownership(self, stamp_ns: int, z: Array64, noise: Array64, evidence: float) -> None:
        """Whether the object is the drone; the estimate of another one ends, and nothing is published until it is."""
        self.ownership.add(stamp_ns, z, noise, evidence if self.imu.is_current(stamp_ns) else None)
        if self.ownership.cleared:
            self.suspect = False
        if self.ownership.denied if self.graph.running else self.ownership.excluded:
            self.suspect = True
            self.forget()

    def _start_graph(self) -> None:
        self.graph.start(self.heading.stamp_ns, self.heading.decision())
        if self.graph.running:
            self.heading.stop()

    def _find(
        self, fix: DroneFix, z: Array64, covariance: FixCovariance, earlier: tuple[float, float, float] | None = None
    ) -> None:
        """Start at a LiDAR position; `earlier`: yaw of an earlier run, its sigma and the probability that it holds."""
        velocity = fix.velocity_vehicle_mps
        if velocity is not None:
            velocity = self._vehicle.to_map(fix.stamp_ns, fix.xyz_vehicle_m, velocity)[1]
        up = self._autopilot.up_drone(fix.stamp_ns)
        self._restart_filters()
        self.odometry.on_found()
        memory = earlier or self._memory.yaw(fix.stamp_ns, z, covariance.white + covariance.bias)
        level = np.array([0.0, 0.0, 1.0]) if up is None else up
        self.heading.start(fix.stamp_ns, z, covariance.white + covariance.bias, velocity, level, memory)
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

    def _add_odometry(self, stamp_ns: int, z: Array64, variance_m2: float) -> None:
        """The autopilot's own position at a LiDAR position: evidence for the heading while it is undecided."""
        own = self._autopilot.odometry(stamp_ns)
        self.heading.evidence = None
        if own is not None:
            self.odometry.add(stamp_ns, z, variance_m2, own.xyz_odom_m, own.segment)
            if not self.graph.running:
                self.heading.evidence = self.odometry.evidence(stamp_ns, own.R_odom_drone)

    def _use_rotation(self, rotation: RelativeRotation) -> None:
        if rotation.R_vehicle_drone is None or rotation.covariance_rad2 is None or not self.known:
            return
        if not self._vehicle.in_current_frame(rotation.stamp_ns):
            return
        stamp_ns, e = rotation.stamp_ns, self._errors
        R_map_vehicle = self._vehicle.at(stamp_ns)[0]
        R = R_map_vehicle @ rotation.R_vehicle_drone
        white = (1.0 - e.rotation_bias_share) * rotation.covariance_rad2
        factor = self._rotation_inflation.factor(stamp_ns)
        if not self.graph.running:
            self.heading.advance(stamp_ns)
            if (self.heading.add_rotation(stamp_ns, R, R_map_vehicle, factor * white) or 0.0) > 0.5:
                self._rotation_used(rotation)
            return
        if abs(stamp_ns - self.graph.stamp_ns) > 500_000_000:
            self.too_late += 1
            return
        graph = self.graph
        dR, variance = turn_between(self.imu, stamp_ns, graph.stamp_ns, graph.state.bias[0])
        covariance = dR.T @ (factor * white) @ dR + variance * np.eye(3)
        one = InertialBank(graph.state, np.zeros(1))
        off = measure.nearest_quarter(one, R @ dR, R_map_vehicle)[0]
        if mahalanobis2(off, graph.state.covariance[0, THETA, THETA] + covariance) > GATE:
            if self._rejected_rotations.add(stamp_ns, off, covariance):
                self.forget()
            return
        self._rejected_rotations.clear()
        quarters = R_map_vehicle @ measure.QUARTERS @ R_map_vehicle.T @ (R @ dR)
        turns = log_rotations(graph.state.R.transpose(0, 2, 1) @ quarters)
        if graph.add_rotation(quarters[int(np.argmin(np.linalg.norm(turns, axis=1)))], covariance):
            self._rotation_used(rotation)

    def _rotation_used(self, rotation: RelativeRotation) -> None:
        assert rotation.covariance_rad2 is not None
        self.rotation_ns = rotation.stamp_ns
        self.rotation_bias_rad2 = self._errors.rotation_bias_share * rotation.covariance_rad2

    def _use_visual_motion(self, motion: VisualMotion) -> None:
        if not self.graph.running:
            self.heading.advance(motion.stamp_ns)
            self.heading.add_visual_motion(motion)
            return
        turn = bias_free_turn(self.imu, motion)
        if turn is not None:
            rate, by_images, covariance = turn
            self.graph.add_gyro_bias(rate - by_images, math.sqrt(float(np.trace(covariance)) / 3))

    def velocity(self, state: InertialState) -> tuple[Array64, Array64]:
        """Velocity over ground (3,), map axes, and its covariance."""
        return state.velocity_mps[0], state.covariance[0, VELOCITY, VELOCITY]
