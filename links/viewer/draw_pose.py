"""How the fused pose looks, and what the autopilot makes of it: what is known, how well, since when, and every jump.

Source: ours, for DESIGN, The graph: fuse; https://mavlink.io/en/messages/ardupilotmega.html#EKF_STATUS_REPORT.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from links.viewer import colours
from links.viewer.draw_rotation import rpy_deg
from links.viewer.marks import Marks, clear, ellipsoids, lane_of, plot, say, stage_of, state
from links.viewer.scene import Mark, Scene
from stages.messages import AutopilotEstimator, PoseEstimate, PoseState, PositionEstimate, RelativePose, ServoOffset

AXIS_M = 0.8
AXES = ["x forward", "y left", "z up"]
WARNED = (PoseState.LOST, PoseState.AMBIGUOUS, PoseState.COASTING)
RATIOS = ["velocity", "level position", "height", "compass"]


def relative_pose(message: RelativePose, name: str, scene: Scene) -> Marks:
    """Axes and 95 % ellipsoid of the position, curves of both and their sigmas, the state in a lane and in words."""
    word = message.state.name
    yield from state(lane_of(name), word, scene)
    if scene.changed(f"log/{name}", word):
        yield say(name, f"{word}: {message.reason}", "WARN" if message.state in WARNED else "INFO")
    if scene.changed(f"resets/{name}", str(message.resets)) and message.resets:
        yield say(name, f"the pose jumped, {message.resets} so far: {message.reason}", "WARN")
    estimate = message.estimate
    if estimate is None:
        yield clear(f"vehicle/{name}")
        yield scene.now(6, stage_of(name), f"{word}: {message.reason}")
        return
    xyz_m, placed = estimate.xyz_vehicle_m, position_covariance_vehicle_m2(estimate)
    yield ellipsoids(f"vehicle/{name}/ellipsoid_95", xyz_m[None], placed[None], colours.NEUTRAL, filled=False)
    yield plot(f"plots/position/{name}", xyz_m, [f"fused {axis}" for axis in AXES], colours.AXES, dots=False)
    sigma_m = np.sqrt(np.diag(placed))
    yield plot(f"plots/sigma/{name}", sigma_m, [f"fused sigma {axis}" for axis in "xyz"], colours.AXES, dots=False)
    if math.isfinite(message.nis):
        yield plot(f"plots/other/{name}/nis", [message.nis], ["squared innovation of the newest fix, 3 expected"])
    if message.measured_ns is not None:
        age_s = (message.stamp_ns - message.measured_ns) * 1e-9
        yield plot(f"plots/other/{name}/age", [age_s], ["age of the newest fix [s]"])
    where = f"{_slashed(xyz_m, 2)} m, sigma {_slashed(sigma_m, 2)} m"
    if not isinstance(estimate, PoseEstimate):
        yield clear(f"vehicle/{name}/axes")
    else:
        R = estimate.R_vehicle_drone
        arrows = rr.Arrows3D(
            origins=np.tile(xyz_m, (3, 1)), vectors=AXIS_M * R.T, colors=colours.AXES, radii=rr.Radius.ui_points(2.0)
        )
        yield Mark(f"vehicle/{name}/axes", arrows, frame="vehicle")
        angles_deg = rpy_deg(R)
        sigma_deg = np.rad2deg(np.sqrt(np.diag(estimate.covariance)[:3]))
        yield plot(f"plots/rotation/{name}", angles_deg, ["fused roll", "pitch", "yaw"], colours.AXES, dots=False)
        names = [f"fused sigma about {axis}" for axis in AXES]
        yield plot(f"plots/rotation_sigma/{name}", sigma_deg, names, colours.AXES, dots=False)
        where += f"; roll / pitch / yaw {_slashed(angles_deg, 1)} deg, sigma {_slashed(sigma_deg, 1)} deg"
    yield scene.now(6, stage_of(name), f"{word}: {where}; {message.reason}")


def position_covariance_vehicle_m2(estimate: PositionEstimate | PoseEstimate) -> np.ndarray:
    """(3, 3) covariance of the drone's position, vehicle axes."""
    if isinstance(estimate, PoseEstimate):
        return estimate.R_vehicle_drone @ estimate.covariance[3:, 3:] @ estimate.R_vehicle_drone.T
    return estimate.covariance_vehicle_m2


def autopilot_estimator(message: AutopilotEstimator, name: str, scene: Scene) -> Marks:
    """What the drone's EKF says it fuses, beside what was sent to it; ratios over 1 are refused measurements."""
    good = {
        "attitude": message.attitude_good,
        "velocity": message.velocity_good,
        "position": message.position_good,
        "height": message.height_good,
    }
    missing = [what for what, is_good in good.items() if not is_good]
    words = "all good" if not missing else f"no good {', '.join(missing)}"
    if message.constant_position:
        words += "; it pretends to stand still"
    yield from state(f"states/{name}", "fused" if not missing else "not fused", scene)
    if scene.changed(f"log/{name}", words):
        yield say(name, f"the autopilot's EKF: {words}", "INFO" if not missing else "WARN")
    ratios = [message.velocity_ratio, message.horizontal_ratio, message.height_ratio, message.compass_ratio]
    yield plot(f"plots/other/{name}", ratios, [f"EKF test ratio of {what}" for what in RATIOS])
    yield scene.now(9, f"{stage_of(name)}, its EKF", words)


def servo_offset(message: ServoOffset, name: str, scene: Scene) -> Marks:
    """How early the servo's stamps are against the LiDAR's, and what the rig says of it."""
    if message.offset_s is None or message.sigma_s is None:
        yield scene.now(9, stage_of(name), message.reason)
        return
    values = 1e3 * np.array([message.offset_s, message.sigma_s, message.rig_s])
    yield plot(f"plots/other/{name}", values, ["servo offset [ms]", "its sigma [ms]", "the rig's [ms]"])
    words = f"{values[0]:.2f} +- {values[1]:.2f} ms, the rig says {values[2]:.2f} ms; {message.reason}"
    yield scene.now(9, stage_of(name), words)


def _slashed(values: np.ndarray, decimals: int) -> str:
    return " / ".join(f"{round(value, decimals) + 0.0:.{decimals}f}" for value in values.tolist())
