"""A flight over a parked or turning vehicle, as inputs of the stage: lines, fixes, autopilot or images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.align.joint_align import JointAlign
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import (
    BranchState,
    CameraMount,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    RelativeRotation,
    VehicleMotion,
    VisualMotion,
)
from tests.stages.align.made_lines import MANHATTAN, seen

S = 1_000_000_000
START_NS = 100 * S


@dataclass
class Flight:
    """Everything as functions of time [s]; each part can be disabled."""

    speed_mps: float = 1.0
    yaw0_deg: float = 200.0  # of the drone in the world
    turn_dps: float = 0.0  # of the drone
    vehicle_dps: float = 0.0
    local_yaw_deg: float = 77.0  # of the world in the autopilot's frame
    streets: tuple[float, ...] = MANHATTAN
    fixes: bool = True
    autopilot: str = "odometry"  # or "split": attitude and position; "attitude" alone; "none"
    images: bool = False  # VisualMotion
    vehicle_odometry: bool = True
    vehicle_silent: tuple[float, float] = (math.inf, math.inf)  # no VehicleMotion
    vehicle_restart_deg: float = 0.0  # its map frame is turned after that
    fix_sigma_m: float = 0.05
    false_yaw_deg: float = 0.0  # the fixes are turned: as by a wrong branch
    false_from_s: float = 0.0
    reset_at_s: float = math.inf  # the yaw of frame odom jumps
    blind: tuple[float, float] = (math.inf, math.inf)  # no lines between these times
    silent: tuple[float, float] = (math.inf, math.inf)  # no autopilot, no images
    image_lead_s: float = 0.0  # the vehicle's image is this much before the drone's
    per_direction: int = 12
    seed: int = 0

    def R_world_drone(self, t):
        return rotation_z(math.radians(self.yaw0_deg + self.turn_dps * t)) @ exp_rotation(
            np.array([0.05 * math.sin(t), 0.08, 0.0])
        )

    def R_world_vehicle(self, t):
        return rotation_z(math.radians(self.vehicle_dps * t))

    def place_m(self, t):
        return np.array([self.speed_mps * t, 0.5 * self.speed_mps * math.sin(t), 12.0])

    def R_local_world(self, t):
        return rotation_z(math.radians(self.local_yaw_deg + (70.0 if t >= self.reset_at_s else 0.0)))

    def run(self, stage: JointAlign, until_s: float, image_hz: float = 5.0) -> list[RelativeRotation]:
        """Feed the stage; returns its outputs."""
        rng = np.random.default_rng([self.seed, 9])
        events = [(t, "auto") for t in np.arange(0, until_s, 0.05)] + [(t, "fix") for t in np.arange(0, until_s, 0.1)]
        events += [(t, "lines") for t in np.arange(0.25, until_s, 1 / image_hz)]
        out: list[RelativeRotation] = []
        for t, kind in sorted(events):
            t = float(t)
            if kind == "auto":
                self._autopilot(stage, t)
            elif kind == "fix" and self.fixes:
                stage.on_fix(self._fix(t, rng))
            elif kind == "lines":
                out += self._lines(stage, t)
        return out + list(stage.finish())

    def _autopilot(self, stage: JointAlign, t: float) -> None:
        ns = START_NS + round(t * S)
        if self.vehicle_odometry and not self.vehicle_silent[0] <= t < self.vehicle_silent[1]:
            afresh_deg = self.vehicle_restart_deg if t >= self.vehicle_silent[1] else 0.0
            R = rotation_z(math.radians(afresh_deg)) @ self.R_world_vehicle(t)
            stage.on_motion(VehicleMotion(stamp_ns=ns, xyz_map_m=np.zeros(3), R_map_vehicle=R, covariance=None))
        if self.silent[0] <= t < self.silent[1]:
            return
        if self.images and t > 0.04:
            a, b = self.R_world_drone(t - 0.05), self.R_world_drone(t)
            way = a.T @ (self.place_m(t) - self.place_m(t - 0.05))
            length = float(np.linalg.norm(way))
            stage.on_visual_motion(
                VisualMotion(
                    stamp_ns=ns,
                    from_ns=START_NS + round((t - 0.05) * S),
                    R_from_to=a.T @ b,
                    covariance_rad2=1e-7 * np.eye(3),
                    direction_from=way / length if length > 1e-3 else None,
                    direction_sigma_rad=0.1 if length > 1e-3 else None,
                    matches=99,
                    reason="",
                )
            )
        R = self.R_local_world(t) @ self.R_world_drone(t)
        rate = log_rotation(self.R_world_drone(t - 5e-4).T @ self.R_world_drone(t + 5e-4)) / 1e-3
        xyz = self.R_local_world(t) @ self.place_m(t)
        v = self.R_local_world(t) @ (self.place_m(t + 5e-4) - self.place_m(t - 5e-4)) / 1e-3
        if self.autopilot == "odometry":
            stage.on_odometry(
                DroneOdometry(
                    stamp_ns=ns,
                    xyz_odom_m=xyz,
                    R_odom_drone=R,
                    velocity_drone_mps=R.T @ v,
                    angular_velocity_drone_radps=rate,
                    pose_covariance=None,
                    velocity_covariance=None,
                    reset_counter=0,
                    quality_percent=None,
                )
            )
        elif self.autopilot in ("split", "attitude"):
            stage.on_attitude(DroneAttitude(stamp_ns=ns, R_odom_drone=R, angular_velocity_drone_radps=rate))
            if self.autopilot == "split":
                stage.on_position(DroneLocalPosition(stamp_ns=ns, xyz_odom_m=xyz, velocity_odom_mps=v))

    def _fix(self, t: float, rng) -> DroneFix:
        xyz = self.place_m(t)
        if t >= self.false_from_s:
            xyz = rotation_z(math.radians(self.false_yaw_deg)) @ xyz
        return DroneFix(
            stamp_ns=START_NS + round(t * S),
            xyz_vehicle_m=self.R_world_vehicle(t).T @ xyz + rng.normal(0, self.fix_sigma_m, 3),
            covariance_m2=self.fix_sigma_m**2 * np.eye(3),
            hits=4,
        )

    def _lines(self, stage: JointAlign, t: float) -> list[RelativeRotation]:
        streets = () if self.blind[0] <= t < self.blind[1] else self.streets
        made = dict(per_direction=self.per_direction, verticals=4, sigma_rad=0.003, seed=self.seed)
        tv = t - self.image_lead_s
        vehicle = seen(
            CameraMount.VEHICLE, self.R_world_vehicle(tv), streets, stamp_ns=START_NS + round(tv * S), **made
        )
        drone = seen(CameraMount.DRONE, self.R_world_drone(t), streets, stamp_ns=START_NS + round(t * S), **made)
        return [*stage.on_vehicle(vehicle), *stage.on_drone(drone)]

    def error_deg(self, output: RelativeRotation) -> float:
        """Error of the published rotation, with its branch."""
        t = (output.stamp_ns - START_NS) / S
        R = self.R_world_vehicle(t).T @ self.R_world_drone(t)
        return math.degrees(float(np.linalg.norm(log_rotation(R.T @ output.R_vehicle_drone))))

    def quarters_off(self, output: RelativeRotation) -> float:
        """Degrees to the nearest branch."""
        t = (output.stamp_ns - START_NS) / S
        R = self.R_world_vehicle(t).T @ self.R_world_drone(t)
        return min(
            math.degrees(
                float(np.linalg.norm(log_rotation(R.T @ rotation_z(k * math.pi / 2) @ output.R_vehicle_drone)))
            )
            for k in range(4)
        )


def wrong_and_resolved(flight: Flight, outputs: list[RelativeRotation]) -> int:
    """Number of outputs that are RESOLVED on a wrong branch."""
    return sum(m.state is BranchState.RESOLVED and flight.error_deg(m) > 30 for m in outputs)
