"""Draws the fused pose, its errors, what is sent of it, the relative rotation, visual motion, the autopilot's EKF.

Source: ours, for P IV Eq. 7-10, V.E and DESIGN, The graph: fuse;
https://mavlink.io/en/messages/ardupilotmega.html#EKF_STATUS_REPORT.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flow.message import port_name
from links.evaluation.association import interpolate
from links.mavlink.poses.position_gate import gate_reason
from links.viewer import colours
from links.viewer.entities import (
    Entities,
    Entity,
    clear,
    ellipsoids,
    log_entry,
    plot,
    slashed,
    stage_of,
    state_change,
    state_path,
)
from links.viewer.scene import DRONE_FRAME, Gate, ViewerScene, drone_sphere, sphere_frame
from stages.geometry.frames import Array64
from stages.messages import (
    AutopilotEstimator,
    BranchState,
    CameraMount,
    DroneFix,
    HeadingEstimate,
    PoseEstimate,
    PoseState,
    PositionEstimate,
    RelativePose,
    RelativeRotation,
    ServoOffset,
    VisualMotion,
)

POSE_AXIS_M = 0.8  # length of the fused pose's axes
ROTATION_AXIS_M = 0.6  # length of the drone's axes in the close-up
TRAVEL = 1.4  # length of the direction of travel, in radii of the sphere
AXES = ["x forward", "y left", "z up"]
WARNING_STATES = (PoseState.LOST, PoseState.AMBIGUOUS, PoseState.COASTING)
RATIOS = ["velocity", "horizontal position", "height", "compass"]
MATCHES = ["first match", "second match", "third match", "fourth match", "none of them"]
BRANCHES = ["yaw 0 deg", "yaw 90 deg", "yaw 180 deg", "yaw 270 deg", "none of them"]
BRANCH_COLOURS = np.array(
    [colours.GOOD, colours.COASTING, colours.CANDIDATE, colours.VERTICAL, colours.BAD], dtype=np.uint32
)
MATCHES_COLOUR = np.array([colours.NEUTRAL], dtype=np.uint32)
MOTION_COLOURS = np.array([colours.DRONE, colours.NEUTRAL], dtype=np.uint32)
TRUTH_COLOUR, TRUTH_GAP_NS = 0xFFFFFFA0, 50_000_000  # the truth is not interpolated across a larger gap
TRUE_AXES = (colours.AXES & np.uint32(0xFFFFFF00)) | np.uint32(0x80)
ERROR_COLOURS = np.array([colours.BAD, colours.NEUTRAL], dtype=np.uint32)
GATE_VALUES = ["position sigma", "rotation sigma", "age of the measured rotation", "sigma of the autopilot's yaw axis"]
GATE_COLOURS = np.array(
    [colours.BAD, colours.DRONE, colours.CANDIDATE, colours.COASTING, colours.VERTICAL], dtype=np.uint32
)
GATE_TOP = 3.0  # larger shares are drawn here: what matters is on which side of the limit they are
UNKNOWN = np.full(3, math.nan)
ERROR_GAP_NS = 1_000_000_000  # the curve of an error is interrupted where the position is unknown for longer
TrueTrack = tuple[NDArray[np.int64], Array64]  # stamps (n,) and positions (n, 3) of a drone, vehicle frame
AMBIGUOUS_AXES = (colours.AXES & np.uint32(0xFFFFFF00)) | np.uint32(0x60)


def relative_pose(message: RelativePose, name: str, scene: ViewerScene) -> Entities:
    """Axes and 95 % ellipsoid of the pose, curves of its components and sigmas, its state as lane, log and text."""
    state = message.state.name
    yield from state_change(state_path(name), state, scene)
    if scene.changed(f"log/{name}", state):
        yield log_entry(name, f"{state}: {message.reason}", "WARN" if message.state in WARNING_STATES else "INFO")
    if scene.changed(f"resets/{name}", str(message.resets)) and message.resets:
        yield log_entry(name, f"the pose jumped, reset {message.resets}: {message.reason}", "WARN")
    if scene.gate is not None:
        yield from gate(message, name, scene.gate, scene)
    estimate = message.estimate
    if estimate is None:
        yield clear(f"vehicle/{name}")
        yield from _position_curves(name, UNKNOWN, UNKNOWN)
        yield scene.status(6, stage_of(name), f"{state}: {message.reason}")
        return
    xyz_m, position_m2 = estimate.xyz_vehicle_m, position_covariance_vehicle_m2(estimate)
    scene.estimated(name, message.stamp_ns, xyz_m, position_m2)
    yield ellipsoids(f"vehicle/{name}/ellipsoid_95", xyz_m[None], position_m2[None], colours.NEUTRAL, filled=False)
    sigma_m = np.sqrt(np.diag(position_m2))
    yield from _position_curves(name, xyz_m, sigma_m)
    if math.isfinite(message.nis):
        yield plot(f"plots/other/{name}/nis", [message.nis], ["NIS of the newest fix, expected 3"])
    if message.measured_ns is not None:
        age_s = (message.stamp_ns - message.measured_ns) * 1e-9
        yield plot(f"plots/other/{name}/age", [age_s], ["age of the newest fix [s]"])
    text = f"{slashed(xyz_m, 2)} m, sigma {slashed(sigma_m, 2)} m"
    if not isinstance(estimate, PoseEstimate):
        yield clear(f"vehicle/{name}/axes")
    else:
        R = estimate.R_vehicle_drone
        arrows = rr.Arrows3D(
            origins=np.tile(xyz_m, (3, 1)),
            vectors=POSE_AXIS_M * R.T,
            colors=colours.AXES,
            radii=rr.Radius.ui_points(2.0),
        )
        yield Entity(f"vehicle/{name}/axes", arrows, frame="vehicle")
        angles_deg = rpy_deg(R)
        sigma_deg = np.rad2deg(np.sqrt(np.diag(estimate.covariance)[:3]))
        yield plot(f"plots/rotation/{name}", angles_deg, ["fused roll", "pitch", "yaw"], colours.AXES, dots=False)
        names = [f"fused sigma about {axis}" for axis in AXES]
        yield plot(f"plots/rotation_sigma/{name}", sigma_deg, names, colours.AXES, dots=False)
        text += f"; roll / pitch / yaw {slashed(angles_deg, 1)} deg, sigma {slashed(sigma_deg, 1)} deg"
    yield scene.status(6, stage_of(name), f"{state}: {text}; {message.reason}")


def _position_curves(name: str, xyz_m: Array64, sigma_m: Array64) -> Entities:
    """Curves of the fused position and its sigmas; `UNKNOWN` interrupts them."""
    yield plot(f"plots/position/{name}", xyz_m, [f"fused {axis}" for axis in AXES], colours.AXES, dots=False)
    yield plot(f"plots/sigma/{name}", sigma_m, [f"fused sigma {axis}" for axis in "xyz"], colours.AXES, dots=False)


def gate(message: RelativePose, name: str, gate: Gate, scene: ViewerScene) -> Entities:
    """Whether the autopilot's gate accepts a pose at its own time, or why not; each value as a share of its limit."""
    reason = gate_reason(message, message.stamp_ns, gate.limits, gate.yaw)
    state = "accepted" if reason is None else reason.value
    yield from state_change("states/autopilot_gate", state, scene)
    if scene.changed("log/autopilot_gate", state):
        text = "accepted" if reason is None else f"held back: {state}"
        yield log_entry("autopilot_gate", text, "INFO" if reason is None else "WARN")
    limits, estimate = gate.limits, message.estimate
    shares = [math.nan] * len(GATE_VALUES)
    if estimate is not None:
        largest_m2 = float(np.linalg.eigvalsh(position_covariance_vehicle_m2(estimate))[-1])
        shares[0] = math.sqrt(max(largest_m2, 0.0)) / limits.position_sigma_m
    if isinstance(estimate, PoseEstimate) and gate.yaw != "none":
        largest_rad2 = float(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1])
        shares[1] = math.degrees(math.sqrt(max(largest_rad2, 0.0))) / limits.rotation_sigma_deg
        if message.rotation_ns is not None:
            shares[2] = (message.stamp_ns - message.rotation_ns) * 1e-9 / limits.rotation_age_s
    if message.odom_yaw_sigma_rad is not None and gate.yaw == "none":
        shares[3] = math.degrees(message.odom_yaw_sigma_rad) / limits.rotation_sigma_deg
    values = [1.0, *shares]
    yield plot(f"plots/gate/{name}", np.minimum(values, GATE_TOP), ["limit", *GATE_VALUES], GATE_COLOURS, dots=False)
    yield scene.status(5, "to the autopilot", state if reason is None else f"held back: {state}")


def truth(number: int, stamp_ns: int, xyz_m: Array64) -> Entities:
    """The true position of a drone: a ghost in 3D and curves."""
    ghost = rr.Points3D([xyz_m], colors=TRUTH_COLOUR, radii=0.25, labels=["truth"], show_labels=False)
    yield Entity(f"vehicle/true_drone_{number}", ghost, frame="vehicle")
    yield plot(f"plots/position/true_drone_{number}", xyz_m, [f"true {axis}" for axis in AXES], TRUE_AXES, dots=False)


def errors_against(truths: Sequence[TrueTrack], scene: ViewerScene) -> Iterator[tuple[int, Entity]]:
    """(stamp, curve) of the error of each estimated position, next to its sigma; of several drones the nearest one."""
    for name, estimates in scene.estimates.items():
        at_ns = np.array([estimate.stamp_ns for estimate in estimates], dtype=np.int64)
        xyz_m = np.array([estimate.xyz_vehicle_m for estimate in estimates]).reshape(-1, 3)
        distances = np.full((len(truths), len(at_ns)), np.nan)
        for row, (stamps_ns, true_m) in enumerate(truths):
            known, there_m = interpolate(at_ns, stamps_ns, true_m, TRUTH_GAP_NS)
            distances[row, known] = np.linalg.norm(xyz_m - there_m, axis=1)[known]
        nearest = np.nanmin(np.where(np.isnan(distances), np.inf, distances), axis=0, initial=np.inf)
        path, names = f"plots/error/{name}", [f"{name}: error", f"{name}: sigma"]
        dots, last_ns = name.endswith(port_name(DroneFix)), None
        for estimate, error_m in zip(estimates, nearest.tolist(), strict=True):
            if not math.isfinite(error_m):
                continue
            if last_ns is not None and estimate.stamp_ns - last_ns > ERROR_GAP_NS:
                yield last_ns + 1, plot(path, UNKNOWN[:2], names, ERROR_COLOURS, dots=dots)
            last_ns = estimate.stamp_ns
            yield last_ns, plot(path, [error_m, estimate.sigma_m], names, ERROR_COLOURS, dots=dots)


def position_covariance_vehicle_m2(estimate: PositionEstimate | PoseEstimate) -> Array64:
    """(3, 3) covariance of the drone's position, vehicle axes."""
    if isinstance(estimate, PoseEstimate):
        return estimate.R_vehicle_drone @ estimate.covariance[3:, 3:] @ estimate.R_vehicle_drone.T
    return estimate.covariance_vehicle_m2


def heading_estimate(message: HeadingEstimate, name: str, scene: ViewerScene) -> Entities:
    """The most probable yaw, its probability and sigma, and whether the heading is decided."""
    state = "decided" if message.decided else "not decided"
    yield from state_change(f"states/{stage_of(name)}_heading", state, scene)
    if scene.changed(f"log/{name}", message.reason):
        yield log_entry(name, message.reason)
    if len(message.yaw_map_rad):
        yaw_deg = math.degrees(math.remainder(float(message.yaw_vehicle_rad[0]), 2 * math.pi))
        sigma_deg, near = math.degrees(message.sigma_rad[0]), 100.0 * message.near_probability
        z = colours.AXES[2:]
        yield plot(f"plots/rotation/{name}", [yaw_deg], ["most probable yaw"], z)
        yield plot(f"plots/rotation_sigma/{name}", [sigma_deg], ["sigma of the most probable yaw"], z)
        yield plot(f"plots/branch/{name}", [near], ["yaw within 20 deg"], MATCHES_COLOUR, dots=False)


def relative_rotation(message: RelativeRotation, name: str, scene: ViewerScene) -> Entities:
    """Probabilities of yaw branches or matches, state, switches, angles with sigmas; the drone's axes at its fix."""
    state = message.state.name
    is_open = message.state is BranchState.OPEN
    probability = np.append(message.probabilities, np.zeros(4))[:4] if is_open else message.branch_probability
    all_of_them = message.probabilities.sum() if is_open else probability.sum()
    percent = 100.0 * np.append(probability, max(0.0, 1.0 - all_of_them))
    yield plot(f"plots/branch/{name}", percent, MATCHES if is_open else BRANCHES, BRANCH_COLOURS)
    yield from state_change(state_path(name), state, scene)
    yield plot(f"plots/other/{name}/switches", [message.switches], ["branch switches"])
    if scene.changed(f"switches/{name}", str(message.switches)) and message.switches:
        yield log_entry(name, f"the published branch changed, switch {message.switches}: {message.reason}", "WARN")
    if scene.changed(f"log/{name}", state):
        text = f"{state}: {message.reason}" if message.reason else state
        yield log_entry(name, text, "INFO" if message.state in (BranchState.RESOLVED, BranchState.OPEN) else "WARN")
    R = message.R_vehicle_drone
    if R is None:
        yield from drone_sphere(None)
        yield clear(f"vehicle/{name}")
        yield scene.status(7, stage_of(name), f"{state}: {message.reason}")
        return
    yield from drone_sphere(R, f"rotated by the estimate: {state}")
    angles_deg = rpy_deg(R)
    yield plot(f"plots/rotation/{name}", angles_deg, ["roll", "pitch", "yaw"], colours.AXES)
    sigma = ""
    if message.covariance_rad2 is not None:
        sigma_deg = np.rad2deg(np.sqrt(np.diag(message.covariance_rad2)))
        yield plot(f"plots/rotation_sigma/{name}", sigma_deg, [f"sigma about {axis}" for axis in AXES], colours.AXES)
        sigma = f", sigma {slashed(sigma_deg, 2)} deg"
    if scene.fixes:  # without a fix the position of the drone is unknown
        packed = colours.AXES if message.state is BranchState.RESOLVED else AMBIGUOUS_AXES
        axes = rr.Arrows3D(vectors=ROTATION_AXIS_M * R.T, colors=packed, radii=rr.Radius.ui_points(2.0))
        yield Entity(f"vehicle/{name}/axes", axes, frame=DRONE_FRAME)
    text = f"{state}, {percent[0]:.1f} %: roll / pitch / yaw {slashed(angles_deg, 1)} deg{sigma}"
    yield scene.status(7, stage_of(name), f"{text}; {message.reason}" if message.reason else text)


def visual_motion(message: VisualMotion, name: str, scene: ViewerScene) -> Entities:
    """Number of inlier features, sigmas of rotation and direction of travel; the direction on the drone's sphere."""
    yield plot(f"plots/matches/{name}", [message.matches], ["inlier features"], MATCHES_COLOUR)
    rotation_deg = math.degrees(math.sqrt(float(np.linalg.eigvalsh(message.covariance_rad2)[-1])))
    yield plot(f"plots/motion_sigma/{name}/rotation", [rotation_deg], ["rotation, largest"], MOTION_COLOURS[1:])
    yield from state_change(state_path(name), "moves" if message.direction_from is not None else "no motion", scene)
    text = f"{message.matches} inlier features over {(message.stamp_ns - message.from_ns) * 1e-9:.2f} s"
    origins, vectors = np.zeros((0, 3)), np.zeros((0, 3))
    if message.direction_from is not None:
        origins, vectors = np.zeros((1, 3)), TRAVEL * (message.R_from_to.T @ message.direction_from)[None]
    if message.direction_sigma_rad is not None:
        direction_deg = math.degrees(message.direction_sigma_rad)
        style = MOTION_COLOURS[:1]
        yield plot(f"plots/motion_sigma/{name}/direction", [direction_deg], ["direction of travel"], style)
        text += f", direction of travel +-{direction_deg:.1f} deg"
    travel = rr.Arrows3D(origins=origins, vectors=vectors, colors=0xFFFFFFFF, radii=rr.Radius.ui_points(2.5))
    yield Entity(f"sphere/{name}/travel", travel, frame=sphere_frame(CameraMount.DRONE))
    yield scene.status(8, stage_of(name), f"{text}; {message.reason}" if message.reason else text)


def autopilot_estimator(message: AutopilotEstimator, name: str, scene: ViewerScene) -> Entities:
    """What the drone's EKF reports that it fuses, and its test ratios; a ratio above 1 is a rejected measurement."""
    good = {
        "attitude": message.attitude_good,
        "velocity": message.velocity_good,
        "position": message.position_good,
        "height": message.height_good,
    }
    missing = [what for what, is_good in good.items() if not is_good]
    text = "all good" if not missing else f"no good {', '.join(missing)}"
    if message.constant_position:
        text += "; constant position mode"
    yield from state_change(f"states/{name}", "fused" if not missing else "not fused", scene)
    if scene.changed(f"log/{name}", text):
        yield log_entry(name, f"the autopilot's EKF: {text}", "INFO" if not missing else "WARN")
    ratios = [message.velocity_ratio, message.horizontal_ratio, message.height_ratio, message.compass_ratio]
    yield plot(f"plots/estimator/{name}", ratios, [f"EKF test ratio of {what}" for what in RATIOS])
    yield scene.status(9, f"{stage_of(name)}, EKF", text)


def servo_offset(message: ServoOffset, name: str, scene: ViewerScene) -> Entities:
    """The estimated time offset of the servo's stamps against the LiDAR's, and the value in the rig file."""
    if message.offset_s is None or message.sigma_s is None:
        yield scene.status(9, stage_of(name), message.reason)
        return
    values = 1e3 * np.array([message.offset_s, message.sigma_s, message.rig_offset_s])
    names = ["servo offset [ms]", "sigma of the servo offset [ms]", "servo offset of the rig [ms]"]
    yield plot(f"plots/other/{name}", values, names)
    text = f"{values[0]:.2f} +- {values[1]:.2f} ms, rig {values[2]:.2f} ms; {message.reason}"
    yield scene.status(9, stage_of(name), text)


def rpy_deg(R: Array64) -> Array64:
    """Roll, pitch, yaw (3,) of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = math.asin(float(np.clip(-R[2, 0], -1.0, 1.0)))
    return np.rad2deg([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])
