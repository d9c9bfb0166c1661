"""Messages made by hand for the stages' tests: packets, servo states, slices, depth images."""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import LidarMount, Pose
from stages.messages import DepthImage, Detections, KernelScores, LidarFirings, ServoState, SweptPoints
from stages.sweep.depth_image import focal_length_px, unproject

MS = 1_000_000
PACKET_NS = 1_327_104  # 24 firings of 55.296 us
START_NS = 1_700_000_000 * 10**9
ELEVATION_RAD = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
ON_ITS_SIDE = LidarMount(
    T_vehicle_turntable=Pose(xyz_m=(0.0, 0.0, 0.25)),
    T_turntable_lidar=Pose(xyz_m=(0.0, 0.0, 0.10), rpy_deg=(90.0, 0.0, 0.0)),
)


def firings(xyz_lidar_m, pulse_ns=None, azimuth_rad=0.0, lost_packets=0) -> LidarFirings:
    """One packet with these points; (0, 0, 0) is a pulse without return."""
    xyz = np.asarray(xyz_lidar_m, dtype=np.float32).reshape(-1, 3)
    n = len(xyz)
    pulse_ns = START_NS + np.arange(n) * 2304 if pulse_ns is None else np.asarray(pulse_ns)
    return LidarFirings(
        stamp_ns=int(pulse_ns[0]) if n else START_NS,
        pulse_stamp_ns=pulse_ns.astype(np.int64),
        laser=(np.arange(n) % 16).astype(np.uint8),
        azimuth_rad=np.full(n, azimuth_rad, dtype=np.float32),
        range_m=np.linalg.norm(xyz, axis=1).astype(np.float32),
        reflectivity=np.arange(n).astype(np.uint8),
        return_kind=np.zeros(n, dtype=np.uint8),
        xyz_lidar_m=xyz,
        lost_packets=lost_packets,
        laser_elevation_rad=ELEVATION_RAD,
    )


def servo(stamp_ns: int, position_rad: float) -> ServoState:
    return ServoState(stamp_ns=stamp_ns, position_rad=position_rad, velocity_radps=0.0, goal_rad=0.0, error=0)


def swept(xyz_vehicle_m, stamp_ns, laser=0, origin_vehicle_m=(0.0, 0.0, 0.0)) -> SweptPoints:
    """One slice with these points; stamps may be one number or one per point."""
    xyz = np.asarray(xyz_vehicle_m, dtype=np.float32).reshape(-1, 3)
    stamps = np.broadcast_to(np.asarray(stamp_ns, dtype=np.int64), (len(xyz),)).copy()
    return SweptPoints(
        stamp_ns=int(stamps[0]) if len(xyz) else int(np.max(stamp_ns)),
        point_stamp_ns=stamps,
        xyz_vehicle_m=xyz,
        laser=np.broadcast_to(np.asarray(laser, dtype=np.uint8), (len(xyz),)).copy(),
        reflectivity=np.zeros(len(xyz), dtype=np.uint8),
        turntable_rad=np.zeros(len(xyz), dtype=np.float32),
        pulses=max(len(xyz), 1),
        origin_vehicle_m=origin_vehicle_m,
    )


def depth_image(depth_m, fov_deg=120.0, origin=(0.0, 0.0, 0.0)) -> DepthImage:
    depth = np.asarray(depth_m, dtype=np.float32)
    filled = int((depth > 0).sum())
    return DepthImage(
        stamp_ns=START_NS + 2_600 * MS,
        start_ns=START_NS,
        depth_m=depth,
        focal_px=focal_length_px(depth.shape[1], fov_deg),
        origin_vehicle_m=np.asarray(origin, dtype=np.float64),
        points=filled,
        returns=filled + 1000,
        turned_rad=math.pi,
    )


def detections(*xyz_accepted, stamp_ns=START_NS, rejected=()) -> Detections:
    xyz = np.array([*xyz_accepted, *rejected], dtype=np.float64).reshape(-1, 3)
    n = len(xyz)
    accepted = np.arange(n) < len(xyz_accepted)
    return Detections(
        stamp_ns=stamp_ns,
        xyz_vehicle_m=xyz,
        evidence=KernelScores(e_inner=np.zeros(n), e_outer=np.zeros(n)),
        accepted=accepted,
        reasons=("made",) * n,
        summary="made",
    )


def street_depth(drone_at: tuple[int, int] | None = (200, 300), seed: int = 0) -> np.ndarray:
    """512 x 512: two long facades at x = +-8 m, sampled thinly, and a 0.4 m cross, 20 m up, at (row, column)."""
    depth = np.zeros((512, 512), dtype=np.float32)
    rng = np.random.default_rng(seed)
    focal = focal_length_px(512, 120.0)
    z = rng.uniform(5.0, 18.0, 60_000)
    y = rng.uniform(-40.0, 40.0, 60_000)
    x = np.where(rng.random(60_000) < 0.5, 8.0, -8.0)
    u, v = np.floor(focal * x / z + 256).astype(int), np.floor(focal * y / z + 256).astype(int)
    inside = (u >= 0) & (u < 512) & (v >= 0) & (v < 512)
    depth[v[inside], u[inside]] = z[inside]
    if drone_at is not None:
        row, column = drone_at
        depth[row - 1 : row + 2, column] = depth[row, column - 1 : column + 2] = 20.0
    return depth


def point_of(image: DepthImage, row: int, column: int) -> np.ndarray:
    return unproject(image, row, column)
