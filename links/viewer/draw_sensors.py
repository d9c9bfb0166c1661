"""How the sensors' messages look: what was measured, where the turntable stands, what became of the pulses.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from links.viewer import colours, images
from links.viewer.marks import Marks, lane_of, plot, stage_of, state
from links.viewer.scene import Mark, Scene, turntable_transform
from links.viewer.slices import thin
from stages.messages import (
    DepthImage,
    LidarFirings,
    ScoreImage,
    ServoGoal,
    ServoState,
    SweptPoints,
    SweptPulses,
    VehicleMotion,
)

SERVO_COLOURS = np.array([colours.NEUTRAL, colours.FAN | 0xFF], dtype=np.uint32)
ASKED_COLOUR = np.array([colours.DRONE], dtype=np.uint32)


def lidar_firings(message: LidarFirings, name: str, scene: Scene) -> Marks:
    """The range image, and what was lost."""
    yield Mark(f"range/{name}", images.range_image(message))
    yield plot(f"plots/other/{name}/lost_packets", [message.lost_packets], [f"{name} lost packets"])
    yield from state(lane_of(name), "packets lost" if message.lost_packets else "ok", scene)


def servo_state(message: ServoState, name: str, scene: Scene) -> Marks:
    """Angle and goal, health, and the turntable where it stands."""
    angles_deg = np.rad2deg([message.position_rad, message.goal_rad])
    yield plot(f"plots/servo/{name}", angles_deg, ["servo", "its goal"], SERVO_COLOURS, dots=False)
    yield plot(f"plots/other/{name}/velocity", [math.degrees(message.velocity_radps)], ["servo [deg/s]"])
    yield from state(lane_of(name), f"error 0x{message.error:02X}" if message.error else "ok", scene)
    if scene.mount is not None and scene.mount.turns and scene.turntable_is_due(message.stamp_ns):
        yield Mark("frames/turntable", turntable_transform(scene.mount, message.position_rad))


def servo_goal(message: ServoGoal, name: str, scene: Scene) -> Marks:
    """What the aim asks for, beside what the servo does."""
    del scene
    yield plot(
        f"plots/servo/{name}", [math.degrees(message.position_rad)], ["asked"], ASKED_COLOUR, dots=False, steps=True
    )
    yield plot(f"plots/other/{name}/speed", [math.degrees(message.speed_radps)], ["asked [deg/s]"])


def swept_points(message: SweptPoints, name: str, scene: Scene) -> Marks:
    """One slice of the cloud. The slices of `history_s` take turns, so at any time the last of them are all there."""
    xyz_m = message.xyz_vehicle_m[thin(message.xyz_vehicle_m, scene.max_points)]
    turn = message.stamp_ns // scene.slice_ns % scene.slices
    points = rr.Points3D(xyz_m, colors=scene.colours(xyz_m), radii=rr.Radius.ui_points(1.2))
    yield Mark(f"vehicle/{name}/slice_{turn:02d}", points, frame="vehicle")
    yield plot(f"plots/other/{name}", [message.pulses, len(message.xyz_vehicle_m)], ["pulses", "returns"])


def swept_pulses(message: SweptPulses, name: str, scene: Scene) -> Marks:
    """How many there were and how many saw nothing; where they went, the points and the range image show."""
    del scene
    count = message.range_m.size
    yield plot(f"plots/other/{name}/pulses", [count], ["pulses placed"])
    if count:
        empty = 100.0 * (count - np.count_nonzero(message.range_m)) / count
        yield plot(f"plots/other/{name}/empty", [empty], ["pulses without return [%]"])


def vehicle_motion(message: VehicleMotion, name: str, scene: Scene) -> Marks:
    """Where the vehicle has come to."""
    del scene
    R = message.R_map_vehicle
    yield plot(f"plots/other/{name}/position", message.xyz_map_m, [f"vehicle {axis} [m]" for axis in "xyz"])
    yield plot(f"plots/other/{name}/yaw", [math.degrees(math.atan2(R[1, 0], R[0, 0]))], ["vehicle yaw [deg]"])


def depth_image(message: DepthImage, name: str, scene: Scene) -> Marks:
    """A whole sweep."""
    scene.depth = message
    yield Mark(f"depth/{name}", images.depth_image(message))
    yield Mark("marks/axes", images.axes(message))
    counts = [message.points, message.returns]
    yield plot(f"plots/other/{name}", counts, ["returns in image", "returns of sweep"])
    yield scene.now(1, stage_of(name), f"{message.points} of {message.returns} returns fell into the depth image")


def score_image(message: ScoreImage, name: str, scene: Scene) -> Marks:
    """What the paper's detector makes of it."""
    del scene
    yield Mark(f"score/{name}", images.score_image(message))
