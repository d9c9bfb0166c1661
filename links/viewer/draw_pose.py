"""Draws the fused pose, the rotation between vehicle and drone, visual motion, and the autopilot's EKF status.

Source: ours, for P IV Eq. 7-10, V.E and DESIGN, The graph: fuse;
https://mavlink.io/en/messages/ardupilotmega.html#EKF_STATUS_REPORT.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

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
from links.viewer.scene import DRONE_FRAME, ViewerScene, drone_sphere, sphere_frame
from stages.geometry.frames import Array64
from stages.messages import (
    AutopilotEstimator,
    BranchState,
    CameraMount,
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
BRANCHES = ["yaw 0 deg", "yaw 90 deg", "yaw 180 deg", "yaw 270 deg", "none of them"]
BRANCH_COLOURS = np.array(
    [colours.GOOD, colours.COASTING, colours.CANDIDATE, colours.VERTICAL, colours.BAD], dtype=np.uint32
)
MATCHES_COLOUR = np.array([colours.NEUTRAL], dtype=np.uint32)
MOTION_COLOURS = np.array([colours.DRONE, colours.NEUTRAL], dtype=np.uint32)
AMBIGUOUS_AXES = (colours.AXES & np.uint32(0xFFFFFF00)) | np.uint32(0x60)


def relative_pose(message: RelativePose, name: str, scene: ViewerScene) -> Entities:
    """Axes and 95 % ellipsoid of the pose, curves of its components and sigmas, its state as lane, log and text."""
    state = message.state.name
    yield from state_change(state_path(name), state, scene)
    if scene.changed(f"log/{name}", state):
        yield log_entry(name, f"{state}: {message.reason}", "WARN" if message.state in WARNING_STATES else "INFO")
    if scene.changed(f"resets/{name}", str(message.resets)) and message.resets:
        yield log_entry(name, f"the pose jumped, reset {message.resets}: {message.reason}", "WARN")
    estimate = message.estimate
    if estimate is None:
        yield clear(f"vehicle/{name}")
        yield scene.status(6, stage_of(name), f"{state}: {message.reason}")
        return
    xyz_m, position_m2 = estimate.xyz_vehicle_m, position_covariance_vehicle_m2(estimate)
    yield ellipsoids(f"vehicle/{name}/ellipsoid_95", xyz_m[None], position_m2[None], colours.NEUTRAL, filled=False)
    yield plot(f"plots/position/{name}", xyz_m, [f"fused {axis}" for axis in AXES], colours.AXES, dots=False)
    sigma_m = np.sqrt(np.diag(position_m2))
    yield plot(f"plots/sigma/{name}", sigma_m, [f"fused sigma {axis}" for axis in "xyz"], colours.AXES, dots=False)
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


def position_covariance_vehicle_m2(estimate: PositionEstimate | PoseEstimate) -> Array64:
    """(3, 3) covariance of the drone's position, vehicle axes."""
    if isinstance(estimate, PoseEstimate):
        return estimate.R_vehicle_drone @ estimate.covariance[3:, 3:] @ estimate.R_vehicle_drone.T
    return estimate.covariance_vehicle_m2


def relative_rotation(message: RelativeRotation, name: str, scene: ViewerScene) -> Entities:
    """Yaw branch probabilities, state, branch switches, angles with sigmas; the drone's axes at its fix."""
    state = message.state.name
    probability = message.branch_probability
    percent = 100.0 * np.append(probability, max(0.0, 1.0 - probability.sum()))
    yield plot(f"plots/branch/{name}", percent, BRANCHES, BRANCH_COLOURS)
    yield from state_change(state_path(name), state, scene)
    yield plot(f"plots/other/{name}/switches", [message.switches], ["branch switches"])
    if scene.changed(f"switches/{name}", str(message.switches)) and message.switches:
        yield log_entry(name, f"the published branch changed, switch {message.switches}: {message.reason}", "WARN")
    if scene.changed(f"log/{name}", state):
        text = f"{state}: {message.reason}" if message.reason else state
        yield log_entry(name, text, "WARN" if message.state is not BranchState.RESOLVED else "INFO")
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
    yield plot(f"plots/other/{name}", ratios, [f"EKF test ratio of {what}" for what in RATIOS])
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
