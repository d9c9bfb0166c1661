"""How the rotation between vehicle and drone looks, and the drone's own motion: how sure, which branch, since when.

Source: ours, for P IV Eq. 7-10 and V.E.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from links.viewer import colours
from links.viewer.marks import Marks, clear, lane_of, plot, say, stage_of, state
from links.viewer.scene import DRONE_FRAME, Mark, Scene, drone_sphere, sphere_frame
from stages.geometry.frames import Array64
from stages.messages import BranchState, CameraMount, RelativeRotation, VisualMotion

BRANCHES = ["as given", "turned by 90 deg", "by 180 deg", "by 270 deg", "none of them"]
BRANCH_COLOURS = np.array(
    [colours.GOOD, colours.COASTING, colours.MAYBE, colours.VERTICAL, colours.BAD], dtype=np.uint32
)
TRAVEL = 1.4  # radii of the sphere, an arrow that sticks out of it
AXIS_M = 0.6  # of the drone's axes in the close-up
MATCHES_COLOUR = np.array([colours.NEUTRAL], dtype=np.uint32)
MOTION_COLOURS = np.array([colours.DRONE, colours.NEUTRAL], dtype=np.uint32)
AMBIGUOUS_AXES = (colours.AXES & np.uint32(0xFFFFFF00)) | np.uint32(0x60)


def relative_rotation(message: RelativeRotation, name: str, scene: Scene) -> Marks:
    """Probabilities of the four branches, state, switches, angles and their sigma; the drone's axes where it is."""
    word = message.state.name
    probability = message.branch_probability
    percent = 100.0 * np.append(probability, max(0.0, 1.0 - probability.sum()))
    yield plot(f"plots/branch/{name}", percent, BRANCHES, BRANCH_COLOURS)
    yield from state(lane_of(name), word, scene)
    yield plot(f"plots/other/{name}/switches", [message.switches], ["switches of the branch"])
    if scene.changed(f"switches/{name}", str(message.switches)) and message.switches:
        yield say(name, f"the branch given out has changed, {message.switches} so far: {message.reason}", "WARN")
    if scene.changed(f"log/{name}", word):
        warns = message.state is not BranchState.RESOLVED
        yield say(name, f"{word}: {message.reason}" if message.reason else word, "WARN" if warns else "INFO")
    R = message.R_vehicle_drone
    if R is None:
        yield from drone_sphere(None)
        yield clear(f"vehicle/{name}")
        yield scene.now(7, stage_of(name), f"{word}: {message.reason}")
        return
    yield from drone_sphere(R, f"turned as given: {word}")
    angles_deg = rpy_deg(R)
    yield plot(f"plots/rotation/{name}", angles_deg, ["roll", "pitch", "yaw"], colours.AXES)
    sure = ""
    if message.covariance_rad2 is not None:
        sigma_deg = np.rad2deg(np.sqrt(np.diag(message.covariance_rad2)))
        names = [f"sigma about {axis}" for axis in ("x forward", "y left", "z up")]
        yield plot(f"plots/rotation_sigma/{name}", sigma_deg, names, colours.AXES)
        sure = f", sigma {_slashed(sigma_deg, 2)} deg"
    if scene.fixes:  # else it is not known where the drone is
        packed = colours.AXES if message.state is BranchState.RESOLVED else AMBIGUOUS_AXES
        axes = rr.Arrows3D(vectors=AXIS_M * R.T, colors=packed, radii=rr.Radius.ui_points(2.0))
        yield Mark(f"vehicle/{name}/axes", axes, frame=DRONE_FRAME)
    words = f"{word}, {percent[0]:.1f} %: roll / pitch / yaw {_slashed(angles_deg, 1)} deg{sure}"
    yield scene.now(7, stage_of(name), f"{words}; {message.reason}" if message.reason else words)


def visual_motion(message: VisualMotion, name: str, scene: Scene) -> Marks:
    """How many features agree, how sure rotation and direction of travel are; the direction on the drone's sphere."""
    yield plot(f"plots/matches/{name}", [message.matches], ["features that agree"], MATCHES_COLOUR)
    rotation_deg = math.degrees(math.sqrt(float(np.linalg.eigvalsh(message.covariance_rad2)[-1])))
    yield plot(f"plots/motion_sigma/{name}/rotation", [rotation_deg], ["rotation, widest"], MOTION_COLOURS[1:])
    yield from state(lane_of(name), "moves" if message.direction_from is not None else "no motion", scene)
    words = f"{message.matches} features agree over {(message.stamp_ns - message.from_ns) * 1e-9:.2f} s"
    origins, vectors = np.zeros((0, 3)), np.zeros((0, 3))
    if message.direction_from is not None:
        origins, vectors = np.zeros((1, 3)), TRAVEL * (message.R_from_to.T @ message.direction_from)[None]
    if message.direction_sigma_rad is not None:
        direction_deg = math.degrees(message.direction_sigma_rad)
        style = MOTION_COLOURS[:1]
        yield plot(f"plots/motion_sigma/{name}/direction", [direction_deg], ["direction of travel"], style)
        words += f", direction of travel +-{direction_deg:.1f} deg"
    travel = rr.Arrows3D(origins=origins, vectors=vectors, colors=0xFFFFFFFF, radii=rr.Radius.ui_points(2.5))
    yield Mark(f"sphere/{name}/travel", travel, frame=sphere_frame(CameraMount.DRONE))
    yield scene.now(8, stage_of(name), f"{words}; {message.reason}" if message.reason else words)


def rpy_deg(R: Array64) -> Array64:
    """Roll, pitch, yaw (3,) of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = math.asin(float(np.clip(-R[2, 0], -1.0, 1.0)))
    return np.rad2deg([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])


def _slashed(values: Array64, decimals: int) -> str:
    return " / ".join(f"{round(value, decimals) + 0.0:.{decimals}f}" for value in values.tolist())
