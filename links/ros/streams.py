"""Messages of a bag as records of a recording: servo, cameras, odometry, and the autopilot's MAVLink frames.

A header's time is the time of the measurement. One further than EPOCH_LIMIT_S from the time of recording is of another
clock (a simulation, a sensor's time since power-up) and an error, unless the mapping says `stamp: arrival`.

Source: ROS 2 common_interfaces and mavros_msgs (messages), REP-103 (units, axes), nav_msgs/Odometry (covariance in
fixed axes, translation first).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError, Record
from links.recording.compressed_image import CompressedImage, encode_compressed_image
from links.ros.bag import BagMessage
from links.ros.mapping import DRONE_CAMERA, ODOMETRY, SERVO, VEHICLE_CAMERA, TopicUse
from stages.geometry.frames import rotation_from_quaternion_xyzw

EPOCH_LIMIT_S = 60.0
JPEG_QUALITY = 95  # of raw images
_JPEG = b"\xff\xd8\xff"
_FRAME = {VEHICLE_CAMERA: "camera_vehicle", DRONE_CAMERA: "camera_drone"}
_TO_BGR = {
    "mono8": None,
    "8UC1": None,
    "bgr8": None,
    "8UC3": None,
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2BGR,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2BGR,
}
_CHANNELS = {"mono8": 1, "8UC1": 1, "rgba8": 4, "bgra8": 4, "rgb8": 3, "bgr8": 3, "8UC3": 3}


def time_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time in ns."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_ns(message: BagMessage, use: TopicUse, stamp: Any | None = None) -> int:
    """Time of the measurement: `stamp` or the header's, or of recording. LinkError for a clock of another epoch."""
    if stamp is None:
        header = getattr(message.value, "header", None)
        stamp = None if header is None else header.stamp
    if stamp is None or use.stamp == "arrival":
        return message.time_ns
    at_ns = time_ns(stamp)
    difference_s = abs(at_ns - message.time_ns) * 1e-9
    if difference_s > EPOCH_LIMIT_S:
        raise LinkError(
            f"{message.topic}: its header's clock is {difference_s:.0f} s from the bag's, another epoch: "
            "set `stamp: arrival` for this topic in the mapping file (`grd info BAG --map FILE` writes it), to use the "
            "time of recording"
        )
    return at_ns


class ServoReader:
    """JointState or a float as the servo's state; its goal is not known, and taken as its position."""

    def __init__(self) -> None:
        self._before: tuple[int, float] | None = None

    def records(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        """One state."""
        at_ns, value = stamp_ns(message, use), message.value
        velocity: float | None = None
        if message.type.endswith("JointState"):
            index = _joint(message, use)
            position = float(value.position[index])
            velocity = float(value.velocity[index]) if index < len(value.velocity) else None
        else:
            position = float(value.data)
        if use.unit == "deg":
            position, velocity = math.radians(position), None if velocity is None else math.radians(velocity)
        if velocity is None:  # between this state and the one before
            since_s = 0.0 if self._before is None else (at_ns - self._before[0]) * 1e-9
            velocity = 0.0 if self._before is None or since_s <= 0 else (position - self._before[1]) / since_s
        self._before = at_ns, position
        state = {"position_rad": position, "velocity_radps": velocity, "goal_rad": position, "error": 0}
        yield Record(SERVO, message.time_ns, at_ns, json.dumps(state).encode())


def _joint(message: BagMessage, use: TopicUse) -> int:
    """Index of the servo's joint. LinkError where it is not known or not there."""
    names = [str(name) for name in message.value.name]
    joint = names[0] if use.joint is None and len(names) == 1 else use.joint
    if joint not in names:
        wanted = "several joints" if joint is None and names else "no joint" if joint is None else f"no joint {joint!r}"
        raise LinkError(
            f"{message.topic}: {wanted} ({', '.join(names) or 'it names none'}): set `joint` of {SERVO} in the "
            f"mapping file (`grd info BAG --map FILE` writes it), or delete the line {SERVO} if there is no servo"
        )
    index = names.index(joint)
    if index >= len(message.value.position):
        raise LinkError(
            f"{message.topic}: a message without the position of joint {joint!r}: set another `joint` or topic for "
            f"{SERVO} in the mapping file (`grd info BAG --map FILE` writes it), or delete its line"
        )
    return index


def image_records(stream: str, message: BagMessage, use: TopicUse) -> Iterator[Record]:
    """One image as JPEG: a JPEG as it is, others encoded."""
    at_ns, value = stamp_ns(message, use), message.value
    if message.type.endswith("CompressedImage"):
        data = bytes(value.data)
        if not data.startswith(_JPEG):
            unturned = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), unturned) if data else None
            if pixels is None:
                raise LinkError(
                    f"{message.topic}: an image of format {value.format!r} is not read: convert the topic to JPEG or "
                    "PNG, or remove it from the mapping file"
                )
            data = _jpeg(pixels)
    else:
        data = _jpeg(_pixels(message))
    image = CompressedImage(at_ns, _FRAME[stream], data)
    yield Record(stream, message.time_ns, at_ns, encode_compressed_image(image))


def _pixels(message: BagMessage) -> NDArray[np.uint8]:
    """BGR or grey of a sensor_msgs/Image. LinkError for other encodings and sizes that do not fit."""
    value = message.value
    encoding, height, width, step = str(value.encoding), int(value.height), int(value.width), int(value.step)
    if encoding not in _TO_BGR:
        raise LinkError(
            f"{message.topic}: images of encoding {encoding!r} are not read: convert the topic to one of "
            f"{', '.join(_TO_BGR)}, or remove it from the mapping file"
        )
    channels = _CHANNELS.get(encoding, 1)
    if not (height and width and step >= width * channels and len(value.data) == height * step):
        raise LinkError(
            f"{message.topic}: an image of {width} x {height} {encoding} with rows of {step} bytes has "
            f"{len(value.data)} bytes: it is damaged; remove the topic from the mapping file to import the others"
        )
    pixels = np.asarray(value.data, np.uint8).reshape(height, step)[:, : width * channels]
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    conversion = _TO_BGR[encoding]
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


def _jpeg(pixels: Any) -> bytes:
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def odometry_records(message: BagMessage, use: TopicUse) -> Iterator[Record]:
    """The vehicle's odometry."""
    at_ns, pose = stamp_ns(message, use), message.value.pose
    p, q = pose.pose.position, pose.pose.orientation
    fields = {
        "xyz_m": [p.x, p.y, p.z],
        "quaternion_xyzw": [q.x, q.y, q.z, q.w],
        "covariance": body_covariance(np.asarray(pose.covariance, np.float64), (q.x, q.y, q.z, q.w)),
    }
    yield Record(ODOMETRY, message.time_ns, at_ns, json.dumps(fields).encode())


def body_covariance(
    fixed: NDArray[np.float64], quaternion_xyzw: tuple[float, float, float, float]
) -> list[float] | None:
    """36 numbers, rotation first, tangent at the body, of ROS's: translation first, fixed axes; None: not known."""
    if fixed.shape != (36,) or not np.isfinite(fixed).all() or fixed[0] < 0 or not fixed.any():
        return None
    R_body_fixed = rotation_from_quaternion_xyzw(quaternion_xyzw).T
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = R_body_fixed, R_body_fixed
    covariance = J @ fixed.reshape(6, 6) @ J.T
    return (0.5 * (covariance + covariance.T)).ravel().tolist()
