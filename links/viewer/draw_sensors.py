"""Draws the sensors' messages: LiDAR firings and points, servo, motion of vehicle and drone, depth and score images.

In the images zero means no data, and isolated pixels are enlarged so that they stay visible.

Source: ours; geometry of the depth image: `stages.messages.DepthImage`, P III.A.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from links.viewer.entities import Entities, Entity, plot, stage_of, state_change, state_path
from links.viewer.message_queue import thin
from links.viewer.scene import ViewerScene, beam_fan, turntable_transform
from stages.messages import (
    DepthImage,
    DroneMotion,
    LidarFirings,
    ScoreImage,
    ServoGoal,
    ServoState,
    SweptPoints,
    SweptPulses,
    VehicleMotion,
)

SERVO_COLOURS = np.array([colours.NEUTRAL, colours.FAN | 0xFF], dtype=np.uint32)
GOAL_COLOUR = np.array([colours.DRONE], dtype=np.uint32)
STEP_M = 0.002  # one count of the u16 images: the resolution of a VLP-16
COLUMNS = 900  # of the range image: 0.4 deg, the spacing of firings at 20 turns a second


def lidar_firings(message: LidarFirings, name: str, scene: ViewerScene) -> Entities:
    """The range image, the fan of the beams and the number of lost packets.

    The image is a tensor, because a tensor view stretches few rows to a readable height.
    """
    counts = range_counts(message)
    yield Entity(f"range/{name}", rr.Tensor(counts, dim_names=("laser", "azimuth"), value_range=(0.0, 60.0 / STEP_M)))
    lowest, highest = float(message.laser_elevation_rad.min()), float(message.laser_elevation_rad.max())
    if scene.mount is not None and scene.changed("lidar/fan", f"{lowest} {highest}"):
        yield beam_fan(lowest, highest)
    yield plot(f"plots/other/{name}/lost_packets", [message.lost_packets], [f"{name} lost packets"])
    yield from state_change(state_path(name), "packets lost" if message.lost_packets else "ok", scene)


def servo_state(message: ServoState, name: str, scene: ViewerScene) -> Entities:
    """Servo angle, goal and error; the orientation of the turntable."""
    angles_deg = np.rad2deg([message.position_rad, message.goal_rad])
    yield plot(f"plots/servo/{name}", angles_deg, ["servo position", "servo goal"], SERVO_COLOURS, dots=False)
    yield plot(f"plots/other/{name}/velocity", [math.degrees(message.velocity_radps)], ["servo [deg/s]"])
    yield from state_change(state_path(name), f"error 0x{message.error:02X}" if message.error else "ok", scene)
    if scene.mount is not None and scene.mount.turns and scene.turntable_is_due(message.stamp_ns):
        yield Entity("frames/turntable", turntable_transform(scene.mount, message.position_rad))


def servo_goal(message: ServoGoal, name: str, scene: ViewerScene) -> Entities:
    """The angle and speed that a stage requests of the servo."""
    del scene
    angle_deg = [math.degrees(message.position_rad)]
    yield plot(f"plots/servo/{name}", angle_deg, ["requested"], GOAL_COLOUR, dots=False, steps=True)
    yield plot(f"plots/other/{name}/speed", [math.degrees(message.speed_radps)], ["requested [deg/s]"])


def swept_points(message: SweptPoints, name: str, scene: ViewerScene) -> Entities:
    """One slice of the cloud. The slices reuse `history_s / slice_s` entity paths, so the last `history_s` is shown."""
    xyz_m = message.xyz_vehicle_m[thin(message.xyz_vehicle_m, scene.max_points)]
    index = message.stamp_ns // scene.slice_ns % scene.slices
    points = rr.Points3D(xyz_m, colors=scene.colours(xyz_m), radii=rr.Radius.ui_points(1.2))
    yield Entity(f"vehicle/{name}/slice_{index:02d}", points, frame="vehicle")
    yield plot(f"plots/count/{name}", [message.pulses, len(message.xyz_vehicle_m)], ["pulses", "returns"])


def swept_pulses(message: SweptPulses, name: str, scene: ViewerScene) -> Entities:
    """The number of pulses and the share without a return; points and range image show their geometry."""
    del scene
    count = message.range_m.size
    yield plot(f"plots/count/{name}/pulses", [count], ["pulses placed"])
    if count:
        empty = 100.0 * (count - np.count_nonzero(message.range_m)) / count
        yield plot(f"plots/other/{name}/empty", [empty], ["pulses without return [%]"])


def vehicle_motion(message: VehicleMotion, name: str, scene: ViewerScene) -> Entities:
    """Position and yaw of the vehicle in the map frame, as curves."""
    del scene
    R = message.R_map_vehicle
    yield plot(f"plots/other/{name}/position", message.xyz_map_m, [f"vehicle {axis} [m]" for axis in "xyz"])
    yield plot(f"plots/other/{name}/yaw", [math.degrees(math.atan2(R[1, 0], R[0, 0]))], ["vehicle yaw [deg]"])


def drone_motion(message: DroneMotion, name: str, scene: ViewerScene) -> Entities:
    """Specific force, rate and noise of the drone's IMU, as curves, and the numbers of its segments."""
    del scene
    axes, path = "xyz", f"plots/other/{name}"
    yield plot(f"{path}/force", message.specific_force_drone_mps2, [f"drone force {a} [m/s2]" for a in axes])
    rate_degps = np.degrees(message.angular_velocity_drone_radps)
    yield plot(f"{path}/rate", rate_degps, [f"drone rate {a} [deg/s]" for a in axes])
    yield plot(f"{path}/force_noise", message.specific_force_noise, [f"{a} [m/s2/sqrt(Hz)]" for a in axes])
    noise_degps = np.degrees(message.angular_velocity_noise)
    yield plot(f"{path}/rate_noise", noise_degps, [f"{a} [deg/s/sqrt(Hz)]" for a in axes])
    if message.gyro_bias is not None:
        bias_degps = [math.degrees(message.gyro_bias.bias_radps)]
        yield plot(f"{path}/gyro_bias", bias_degps, ["about the vertical by the magnetic field [deg/s]"])
    estimate = message.autopilot
    segments = [message.segment, math.nan if estimate is None else estimate.odom_segment]
    yield plot(f"{path}/segments", segments, ["IMU segment", "odom segment"])


def depth_image(message: DepthImage, name: str, scene: ViewerScene) -> Entities:
    """The depth image of a sweep; the colours span its depths without the farthest 2 %."""
    scene.depth = message
    pixels = depth_counts(message)
    far = float(np.percentile(pixels[pixels > 0], 98)) if pixels.any() else 1.0
    colormap = rr.components.Colormap.Turbo
    yield Entity(f"depth/{name}", rr.DepthImage(pixels, meter=1.0 / STEP_M, colormap=colormap, depth_range=(0.0, far)))
    yield Entity("overlays/axes", _vehicle_axes(message))
    counts = [message.points, message.returns]
    yield plot(f"plots/count/{name}", counts, ["returns in image", "returns of sweep"])
    text = f"{message.points} of {message.returns} returns are inside the depth image"
    yield scene.status(1, stage_of(name), text)


def score_image(message: ScoreImage, name: str, scene: ViewerScene) -> Entities:
    """The score image of the paper's detector."""
    del scene
    colormap = rr.components.Colormap.Inferno
    yield Entity(f"score/{name}", rr.DepthImage(score_counts(message), colormap=colormap, depth_range=(0.0, 65535.0)))


def range_counts(firings: LidarFirings) -> NDArray[np.uint16]:
    """Range by laser (rows, highest beam on top) and azimuth (columns, 0 along +y_lidar); the newest return wins."""
    row_of_laser = np.argsort(np.argsort(-firings.laser_elevation_rad))
    image = np.zeros((len(row_of_laser), COLUMNS), dtype=np.uint16)
    hit = (firings.range_m > 0) & (firings.return_kind == 0)
    column = (firings.azimuth_rad[hit] / (2 * np.pi) * COLUMNS).astype(np.int64) % COLUMNS
    image[row_of_laser[firings.laser[hit]], column] = _counts(firings.range_m[hit])
    return image


def depth_counts(message: DepthImage) -> NDArray[np.uint16]:
    """Depth in steps of 2 mm; an empty pixel takes the depth of its nearest non-empty neighbour, if there is one."""
    counts = _counts(message.depth_m)
    nearness = _thicken(np.where(counts > 0, 65535 - counts, 0).astype(np.uint16))
    return np.where(nearness > 0, 65535 - nearness, 0).astype(np.uint16)


def score_counts(message: ScoreImage) -> NDArray[np.uint16]:
    """Score of each candidate pixel on a logarithmic scale: best 65535, worst a fifth of it, no candidate 0."""
    known = np.isfinite(message.score)
    counts = np.zeros(message.score.shape, dtype=np.uint16)
    if known.any():
        worse = np.log1p(message.score[known] - message.score[known].min())
        counts[known] = np.round(65535 * (1 - 0.8 * worse / max(float(worse.max()), 1e-9)))
    return _thicken(counts)


def project_to_depth_image(
    image: DepthImage, xyz_vehicle_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels (n, 2) as (u, v), with the top left corner at 0, and a mask of those inside the image. P III.A."""
    height_px, width_px = image.depth_m.shape
    ray = xyz_vehicle_m - image.origin_vehicle_m
    above = ray[:, 2] > 0
    pixels = image.focal_px * ray[:, :2] / np.where(above, ray[:, 2], 1.0)[:, None] + [width_px / 2, height_px / 2]
    inside = above & (pixels >= 0).all(axis=1) & (pixels < [width_px, height_px]).all(axis=1)
    return pixels, inside


def _counts(distance_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    return np.clip(np.nan_to_num(distance_m) / STEP_M + 0.5, 0, 65535).astype(np.uint16)


def _thicken(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Empty pixels take the value of their largest neighbour, so that downscaling keeps isolated pixels."""
    grown = cv2.dilate(image, np.ones((3, 3), np.uint8))
    return np.where(image > 0, image, grown).astype(np.uint16)


def _vehicle_axes(image: DepthImage) -> rr.Arrows2D:
    """The vehicle's forward and left directions in the image."""
    height_px, width_px = image.depth_m.shape
    corner = [[0.03 * width_px, 0.03 * height_px]] * 2
    return rr.Arrows2D(
        origins=corner,
        vectors=[[0.12 * width_px, 0.0], [0.0, 0.12 * height_px]],
        colors=colours.AXES[:2],
        labels=["forward", "left"],
        show_labels=True,
        draw_order=40,
    )
