"""Draws messages in Rerun: one function per message type. A type without a function is drawn field by field.

Entity paths consist of a group, the output (`vehicle/sweep/swept_points`) and the drone (`.../drone_1`):

| group                             | content                                                          |
| --------------------------------- | ---------------------------------------------------------------- |
| vehicle/, labels/, lidar/         | 3D: in the vehicle frame, labelled points there, in the lidar frame |
| frames/                           | transforms: turntable, lidar, drone_position, sphere_vehicle, sphere_drone |
| depth/, score/, range/, overlays/ | images, and overlays on them                                     |
| camera/                           | per camera: its image, and the detections in it                  |
| sphere/                           | directions, on the unit spheres of vehicle and drone             |
| plots/                            | curves, per quantity; plots/fields: numbers of all other messages |
| states/                           | state lanes                                                      |
| log/, status, candidates, about/  | text log, current status, reasons per candidate, graph and settings |

Source: ours.
"""

from __future__ import annotations

import dataclasses
import enum
from functools import singledispatch
from typing import Any

import numpy as np
import rerun as rr

from flow.events import EventMessage
from flow.message import Message
from links.viewer import colours, draw_cameras, draw_drone, draw_pose, draw_sensors
from links.viewer.entities import Entities, Entity, log_entry, plot, state_change
from links.viewer.message_queue import thin
from links.viewer.scene import ViewerScene
from stages.messages import (
    AutopilotEstimator,
    Candidates,
    DepthImage,
    Detections,
    DroneFix,
    DroneMotion,
    FollowedFeatures,
    HeadingEstimate,
    Image,
    LidarFirings,
    RelativePose,
    RelativeRotation,
    ScoreImage,
    ServoGoal,
    ServoOffset,
    ServoState,
    SweptPoints,
    SweptPulses,
    TrackState,
    VanishingDirections,
    VehicleMotion,
    VisualMotion,
)


@singledispatch
def draw(message: Any, name: str, scene: ViewerScene) -> Entities:
    """Entities of a message of output `name` ("track/drone_fix"). This body draws the remaining types."""
    for field in dataclasses.fields(message):
        if field.name != "stamp_ns":
            yield from _draw_field(getattr(message, field.name), f"{name}/{field.name}", scene)


@draw.register
def event(message: EventMessage, name: str, scene: ViewerScene) -> Entities:
    """A status event of the run, with the text of the terminal."""
    yield log_entry(f"{name}/{message.node}", message.text, "INFO" if message.resolved else "WARN")


draw.register(LidarFirings)(draw_sensors.lidar_firings)
draw.register(ServoState)(draw_sensors.servo_state)
draw.register(ServoGoal)(draw_sensors.servo_goal)
draw.register(SweptPoints)(draw_sensors.swept_points)
draw.register(SweptPulses)(draw_sensors.swept_pulses)
draw.register(VehicleMotion)(draw_sensors.vehicle_motion)
draw.register(DroneMotion)(draw_sensors.drone_motion)
draw.register(DepthImage)(draw_sensors.depth_image)
draw.register(ScoreImage)(draw_sensors.score_image)
draw.register(Candidates)(draw_drone.candidates)
draw.register(Detections)(draw_drone.detections)
draw.register(DroneFix)(draw_drone.drone_fix)
draw.register(TrackState)(draw_drone.track_state)
draw.register(Image)(draw_cameras.image)
draw.register(VanishingDirections)(draw_cameras.vanishing_directions)
draw.register(FollowedFeatures)(draw_cameras.followed_features)
draw.register(RelativeRotation)(draw_pose.relative_rotation)
draw.register(VisualMotion)(draw_pose.visual_motion)
draw.register(RelativePose)(draw_pose.relative_pose)
draw.register(HeadingEstimate)(draw_pose.heading_estimate)
draw.register(AutopilotEstimator)(draw_pose.autopilot_estimator)
draw.register(ServoOffset)(draw_pose.servo_offset)


def _draw_field(value: Any, name: str, scene: ViewerScene) -> Entities:
    if isinstance(value, Message) or dataclasses.is_dataclass(value):
        yield from draw.registry[object](value, name, scene)
    elif isinstance(value, enum.Enum):
        yield from state_change(f"states/{name}", value.name, scene)
    elif isinstance(value, str | tuple | None):
        if scene.changed(name, str(value)):
            yield log_entry(name, str(value))
    elif isinstance(value, bytes):
        yield plot(f"plots/fields/{name}", [len(value)], [f"{name} bytes"])
    elif 0 < np.size(value) <= 9:
        names = [name] if np.size(value) == 1 else [f"{name} {i}" for i in range(np.size(value))]
        yield plot(f"plots/fields/{name}", np.ravel(value).astype(np.float64), names)
    elif np.ndim(value) == 2 and np.shape(value)[1] == 3 and name.endswith("_vehicle_m"):
        shown = value[thin(np.asarray(value, dtype=np.float32), scene.max_points)]
        yield Entity(f"vehicle/{name}", rr.Points3D(shown, colors=colours.NEUTRAL), frame="vehicle")
    else:
        finite = np.asarray(value, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        summary = [finite.size, finite.min(), finite.mean(), finite.max()] if finite.size else [0, 0, 0, 0]
        yield plot(f"plots/fields/{name}", summary, [f"{name} {w}" for w in ("finite", "min", "mean", "max")])
