"""A street, a hovering drone and the messages a run would send about them, built by hand: no stage is involved."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from flow.message import Message
from stages.geometry.frames import LidarMount, Pose, rotation_z
from stages.messages import (
    CandidateEvidence,
    Candidates,
    DepthImage,
    Detections,
    DroneFix,
    KernelScores,
    LidarFirings,
    ScoreImage,
    ServoGoal,
    ServoState,
    SweptPoints,
    SweptPulses,
    TrackingState,
    TrackState,
    VehicleMotion,
)

START_NS = 1_760_000_000_000_000_000
MOUNT = LidarMount(
    T_vehicle_turntable=Pose(xyz_m=(0.0, 0.0, 0.25)), T_turntable_lidar=Pose(xyz_m=(0.0, 0.0, 0.1), rpy_deg=(90, 0, 0))
)
ELEVATION_RAD = np.deg2rad([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
SWEEP_S = 2.6
PACKET_S = 24 * 55.296e-6
FRAME_S = 0.12
FOCAL_PX = 256 / math.tan(math.radians(60))


def drone_xyz(t_s: float) -> np.ndarray:
    """Where the drone is, vehicle frame [m]."""
    return np.array([6.0 + 0.8 * t_s, 2.0 + 1.5 * math.sin(0.8 * t_s), 12.0 + 0.3 * t_s])


def servo_rad(t_s: float) -> float:
    """A sweep of 180 deg, then +-5 deg about the drone's direction."""
    if t_s < SWEEP_S:
        return math.pi * t_s / SWEEP_S
    x, y, _ = drone_xyz(t_s)
    return math.atan2(y, x) % math.pi + math.radians(5) * math.sin(2 * math.pi * 57 / 60 * t_s)


def cast(origin: np.ndarray, rays: np.ndarray, drone: np.ndarray) -> np.ndarray:
    """Range [m] along each unit ray (n, 3) to ground, facades or drone; 0: nothing within 100 m."""
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.full(len(rays), np.inf)
        for axis, at, lower, upper in ((2, -2.0, -60, 0), (1, 9.0, -2, 22), (1, -8.0, -2, 14), (0, 38.0, -2, 30)):
            distance = (at - origin[axis]) / rays[:, axis]
            hit = origin + distance[:, None] * rays
            gaps = (np.floor(hit[:, 0] / 11.0) % 3 == 1) if axis == 1 and at < 0 else np.zeros(len(rays), bool)
            good = (distance > 0.5) & (hit[:, 2] > lower - 1e-6) & (hit[:, 2] < upper) & ~gaps
            nearest = np.where(good & (distance < nearest), distance, nearest)
    along = rays @ (drone - origin)
    miss = np.linalg.norm(drone - origin) ** 2 - along**2
    nearest = np.where((along > 0) & (miss < 0.25**2) & (along < nearest), along, nearest)
    return np.where(nearest < 100.0, nearest, 0.0)


def packet(t_s: float) -> tuple[LidarFirings, SweptPoints]:
    """One VLP-16 packet: 24 firings of 16 lasers at 10 turns a second."""
    firing_s = t_s + np.repeat(np.arange(24) * 55.296e-6, 16)
    laser = np.tile(np.arange(16, dtype=np.uint8), 24)
    azimuth = (2 * np.pi * 10 * firing_s) % (2 * np.pi)
    w = ELEVATION_RAD[laser]
    ray_lidar = np.stack([np.cos(w) * np.sin(azimuth), np.cos(w) * np.cos(azimuth), np.sin(w)], axis=1)
    base, lidar = MOUNT.T_vehicle_turntable.matrix(), MOUNT.T_turntable_lidar.matrix()
    angle = servo_rad(t_s)
    rotation = base[:3, :3] @ rotation_z(angle)
    origin = base[:3, 3] + rotation @ lidar[:3, 3]
    rays = ray_lidar @ (rotation @ lidar[:3, :3]).T
    distance = cast(origin, rays, drone_xyz(t_s)).astype(np.float32)
    stamps = START_NS + (firing_s * 1e9).astype(np.int64)
    seen = distance > 0
    reflectivity = np.full(len(laser), 40, np.uint8)
    firings = LidarFirings(
        stamp_ns=int(stamps[0]),
        pulse_stamp_ns=stamps,
        laser=laser,
        azimuth_rad=azimuth.astype(np.float32),
        range_m=distance,
        reflectivity=reflectivity,
        return_kind=np.zeros(len(laser), np.uint8),
        xyz_lidar_m=(ray_lidar * distance[:, None]).astype(np.float32),
        lost_packets=0,
        laser_elevation_rad=ELEVATION_RAD,
    )
    swept = SweptPoints(
        stamp_ns=int(stamps[0]),
        point_stamp_ns=stamps[seen],
        xyz_vehicle_m=(origin + rays * distance[:, None]).astype(np.float32)[seen],
        laser=laser[seen],
        reflectivity=reflectivity[seen],
        turntable_rad=np.full(int(seen.sum()), angle, np.float32),
        pulses=len(laser),
    )
    return firings, swept


def images(xyz_vehicle_m: np.ndarray, stamp_ns: int) -> tuple[DepthImage, ScoreImage]:
    """The sweep as a depth image, and a made-up score: far from the drone is worse."""
    origin = np.array([0.0, 0.0, 0.25])
    ray = xyz_vehicle_m.astype(np.float64) - origin
    ray = ray[ray[:, 2] > 0.5]
    pixel = np.floor(FOCAL_PX * ray[:, :2] / ray[:, 2:] + 256).astype(int)
    inside = ((pixel >= 0) & (pixel < 512)).all(axis=1)
    depth = np.zeros((512, 512), np.float32)
    order = np.argsort(-ray[inside, 2])
    u, v = pixel[inside][order].T
    depth[v, u] = ray[inside, 2][order]
    at = FOCAL_PX * (drone_xyz(1.0) - origin)[:2] / (drone_xyz(1.0) - origin)[2] + 256
    rows, columns = np.mgrid[:512, :512]
    score = np.where(depth > 0, np.hypot(columns - at[0], rows - at[1]) * 8 + 5, np.nan).astype(np.float32)
    image = DepthImage(
        stamp_ns=stamp_ns,
        start_ns=START_NS,
        depth_m=depth,
        focal_px=FOCAL_PX,
        origin_vehicle_m=origin,
        points=int(inside.sum()),
        returns=len(xyz_vehicle_m),
        turned_rad=math.pi,
    )
    return image, ScoreImage(stamp_ns=stamp_ns, score=score)


def detections(stamp_ns: int) -> Detections:
    """The drone accepted, a facade edge and a lamp rejected."""
    xyz = np.array([drone_xyz(1.0), [20.0, 9.0, 21.5], [30.0, -8.0, 13.5]])
    return Detections(
        stamp_ns=stamp_ns,
        xyz_vehicle_m=xyz,
        accepted=np.array([True, False, False]),
        reasons=("drone: e = 12.4, lowest", "e_outer 88 over 40: touches a facade", "e_inner 60 over 20: not compact"),
        summary="drone at x 6.8, y 3.1, z 12.3 m: e = 12.4, the next is 88.0",
        evidence=KernelScores(e_inner=np.array([2.0, 0.0, 60.0]), e_outer=np.array([10.4, 88.0, 80.2])),
    )


def run(duration_s: float) -> Iterator[tuple[str, Message]]:
    """(output, message) of a whole run in time order."""
    swept_all: list[np.ndarray] = []
    found = False
    frames = 0
    for k in range(int(duration_s / PACKET_S)):
        t_s = k * PACKET_S
        stamp_ns = START_NS + int(t_s * 1e9)
        if k % 4 == 0:
            yield (
                "servo.servo_state",
                ServoState(stamp_ns=stamp_ns, position_rad=servo_rad(t_s), velocity_radps=1.2, goal_rad=2.0, error=0),
            )
        firings, swept = packet(t_s)
        yield "lidar.lidar_firings", firings
        yield "sweep.swept_points", swept
        if t_s < SWEEP_S:
            swept_all.append(swept.xyz_vehicle_m)
        elif not found:
            found = True
            depth, score = images(np.concatenate(swept_all), stamp_ns)
            yield "sweep.depth_image", depth
            yield "detect.score_image", score
            yield "detect.detections", detections(stamp_ns)
        if t_s > frames * FRAME_S:
            frames += 1
            hits = 3 + frames % 4
            if found:
                noise = 0.06 * np.random.default_rng(frames).standard_normal(3)
                covariance = np.diag([0.05, 0.06, 0.09]) ** 2
                fix = DroneFix(
                    stamp_ns=stamp_ns,
                    xyz_vehicle_m=drone_xyz(t_s) + noise,
                    covariance_m2=covariance,
                    hits=hits,
                )
                yield "track.drone_fix", fix
            state = TrackState(
                stamp_ns=stamp_ns,
                state=TrackingState.TRACKING if found else TrackingState.SEARCHING,
                reason=f"{hits} returns within 1.0 m" if found else "the first sweep is not complete",
                hits=hits if found else 0,
                frame_s=FRAME_S,
            )
            yield "track.track_state", state


def pulses(firings: LidarFirings) -> SweptPulses:
    """The same pulses placed, pointing wherever."""
    return SweptPulses(
        stamp_ns=firings.stamp_ns,
        point_stamp_ns=firings.pulse_stamp_ns,
        direction_vehicle=np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (len(firings.laser), 1)),
        range_m=firings.range_m,
        laser=firings.laser,
        reflectivity=firings.reflectivity,
        turntable_rad=0.0,
        origin_vehicle_m=(0.0, 0.0, 0.35),
    )


def candidates(stamp_ns: int, t_s: float) -> Candidates:
    """The drone, ever surer, and a lamp that is dropped after 1 s."""
    n = 2 if t_s < 1.0 else 1
    xyz = np.array([drone_xyz(t_s), [-16.0, -23.0, 8.0]])[:n]
    return Candidates(
        stamp_ns=stamp_ns,
        candidate_id=np.array([3, 5])[:n],
        xyz_vehicle_m=xyz,
        velocity_vehicle_mps=np.zeros((n, 3)),
        probability=np.array([min(0.99, 0.2 + t_s), 0.01])[:n],
        seen_ns=np.full(n, stamp_ns - 20_000_000),
        scan_passes=np.full(n, 4),
        reasons=(
            "9 scan passes; 8 of 8 sectors around it free",
            "next to a large object; if not a drone, a lamp, wire or edge",
        )[:n],
        accept_probability=0.95,
    )


def classified(stamp_ns: int, t_s: float) -> Detections:
    """The drone accepted, the lamp rejected, with probabilities."""
    return Detections(
        stamp_ns=stamp_ns,
        xyz_vehicle_m=np.array([drone_xyz(t_s), [-16.0, -23.0, 8.0]]),
        accepted=np.array([True, False]),
        reasons=("9 scan passes", "next to a large object; if not a drone, a lamp, wire or edge"),
        summary="drone at (6.8, 3.1, 12.3) m, 99.2 %: 9 scan passes",
        evidence=CandidateEvidence(
            start_ns=START_NS,
            candidate_id=np.array([3, 5]),
            seen_ns=np.full(2, stamp_ns),
            velocity_vehicle_mps=np.zeros((2, 3)),
            log_odds=np.array([4.8, -4.6]),
            probability=np.array([0.992, 0.01]),
        ),
    )


def tracks(stamp_ns: int, t_s: float, second_lost_s: float) -> Iterator[tuple[str, Message]]:
    """Drone 1 is tracked and coasts from 1.5 s on; drone 2, 6 m next to it, is lost at `second_lost_s`."""
    velocity = np.array([0.8, 1.2, 0.3])
    coasting_s = max(t_s - 1.5, 0.0)
    for number, xyz in ((1, drone_xyz(t_s)), (2, np.add(drone_xyz(t_s), [0.0, 6.0, 0.0]))):
        lost = number == 2 and t_s >= second_lost_s
        coasts = number == 1 and coasting_s > 0
        if not lost and not coasts:
            yield (
                "track.drone_fix",
                DroneFix(
                    stamp_ns=stamp_ns,
                    xyz_vehicle_m=xyz,
                    covariance_m2=np.diag([0.05, 0.06, 0.09]) ** 2,
                    hits=3,
                    track_id=number,
                    velocity_vehicle_mps=velocity,
                ),
            )
        yield (
            "track.track_state",
            TrackState(
                stamp_ns=stamp_ns,
                state=TrackingState.LOST if lost else TrackingState.COASTING if coasts else TrackingState.TRACKING,
                reason=f"no return for {coasting_s:.1f} s" if coasts else "3 returns, 12 pulses next to it",
                hits=0 if lost or coasts else 3,
                frame_s=0.1,
                track_id=number,
                xyz_vehicle_m=None if lost else xyz,
                velocity_vehicle_mps=None if lost else velocity,
                covariance_m2=None if lost else np.eye(3) * (0.1 + coasting_s) ** 2,
            ),
        )


def run_by_evidence(duration_s: float) -> Iterator[tuple[str, Message]]:
    """(output, message) of a run of the evidence detector and the hit-and-miss tracker, two drones, in time order."""
    answered = False
    for k in range(int(duration_s / PACKET_S)):
        t_s = k * PACKET_S
        stamp_ns = START_NS + int(t_s * 1e9)
        if k % 4 == 0:
            angle = servo_rad(t_s)
            state = ServoState(stamp_ns=stamp_ns, position_rad=angle, velocity_radps=1.2, goal_rad=2.0, error=0)
            yield "servo.servo_state", state
        firings, swept = packet(t_s)
        yield "lidar.lidar_firings", firings
        yield "sweep.swept_points", swept
        yield "sweep.swept_pulses", pulses(firings)
        if k % 75 == 0:
            yield (
                "aim.servo_goal",
                ServoGoal(stamp_ns=stamp_ns, position_rad=1.0 + 0.1 * (k // 75 % 3), speed_radps=5.0),
            )
            still = VehicleMotion(stamp_ns=stamp_ns, xyz_map_m=np.zeros(3), R_map_vehicle=np.eye(3), covariance=None)
            yield "odometry.vehicle_motion", still
            yield "detect.candidates", candidates(stamp_ns, t_s)
            if t_s > 0.75 and not answered:
                answered = True
                yield "detect.detections", classified(stamp_ns, t_s)
            if answered:
                yield from tracks(stamp_ns, t_s, second_lost_s=1.8)
            else:
                maybe = next(state for _, state in tracks(stamp_ns, t_s, 0.0) if isinstance(state, TrackState))
                yield "track.track_state", dataclasses.replace(maybe, state=TrackingState.CANDIDATE, track_id=0)


MERMAID = """flowchart LR
  lidar --> sweep
  servo --> sweep
  sweep --> detect --> track"""
EVIDENCE_MERMAID = MERMAID + "\n    detect -- candidates --> track\n"
SETTINGS = "stages:\n  track:\n    use: stages.track.Track\n    config: {radius_m: 1.0}\n"
