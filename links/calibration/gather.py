"""What a calibration needs of a recording: returns, servo states, the rig, and where the vehicle says it was.

Source: ours. Records go through the same decoders as in a run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from pydantic import ValidationError

from flow.link import LinkError
from links.dynamixel import Servo
from links.dynamixel.servo import TICK_RAD
from links.recording import Progress, RecordingReader
from links.vehicle_odometry import VehicleOdometry
from links.velodyne import Lidar
from stages.calibration.looks import Returns, ServoTrace
from stages.geometry import Array64, LidarMount
from stages.messages import LidarFirings, ServoState

MOST_RETURNS = 300_000  # more add seconds and no accuracy: firing sequences are left out evenly
LASERS = 16
LIDAR = "links.velodyne.Lidar"
MIN_RANGE_M = 1.0  # nearer returns are the sensor's own mount and the roof's edge


@dataclass(frozen=True)
class Gathered:
    """A recording, or a part of it, as a calibration takes it."""

    returns: Returns
    trace: ServoTrace
    rig: dict[str, object]  # the whole rig file
    mount: LidarMount
    driven_m: float | None  # by the vehicle's own odometry; None: it has none
    seconds: float


def gather(
    recording: Path, rig_yaml: str | None, part_s: tuple[float, float], progress: Progress | None = None
) -> Gathered:
    """Read a recording from and to a time in it [s]; `rig_yaml` stands in for its own rig. Errors are LinkError."""
    servo, odometry = Servo.model_validate({}), VehicleOdometry.model_validate({})
    firings: list[LidarFirings] = []
    states: list[ServoState] = []
    places_m: list[Array64] = []
    with RecordingReader(recording) as reader:
        lidar = lidar_of(reader.config_yaml)
        text = rig_yaml or reader.rig_yaml
        if text is None:
            raise LinkError(f"{recording} holds no rig, which is what is to be improved: give one with --rig FILE")
        begin_ns, end_ns = (reader.start_ns + 1e9 * s for s in part_s)
        for record in reader.records([lidar.topic, servo.topic, odometry.topic], progress=progress):
            if not begin_ns <= record.arrival_ns <= end_ns:
                continue
            if record.topic == lidar.topic:
                firings += [decoded] if (decoded := lidar.decode(record)) is not None else []
            elif record.topic == servo.topic:
                states += [state] if (state := servo.decode(record)) is not None else []
            elif (motion := odometry.decode(record)) is not None:
                places_m.append(motion.xyz_start_m)
    rig, mount = checked_rig(text, str(recording if rig_yaml is None else "--rig"))
    if not firings:
        raise LinkError(f"{recording} holds no LiDAR packets in that time: is it the right recording, and the part?")
    if not states:
        raise LinkError(
            f"{recording} holds no servo states in that time: a LiDAR that does not turn sees nothing twice, "
            "so there is no servo mount to calibrate"
        )
    driven_m = None
    if places_m:
        driven_m = float(np.linalg.norm(np.array(places_m) - places_m[0], axis=1).max())
    trace = ServoTrace.of(np.array([s.stamp_ns for s in states]), np.array([s.position_rad for s in states]), TICK_RAD)
    seconds = (firings[-1].stamp_ns - firings[0].stamp_ns) * 1e-9
    return Gathered(returns_of(firings), trace, rig, mount, driven_m, seconds)


def lidar_of(config_yaml: str | None) -> Lidar:
    """The LiDAR with its clock as the recorded run had it: another would move all its pulses against the servo.

    Free, a sensor's clock is set by the packets that come soonest: late by the shortest way, in the simulated rig 2 ms.
    """
    clock: dict[str, object] = {}
    tree = None if config_yaml is None else yaml.safe_load(config_yaml)
    links = tree.get("links") if isinstance(tree, dict) else None
    for node in links.values() if isinstance(links, dict) else ():
        if isinstance(node, dict) and node.get("use") == LIDAR:
            config = node.get("config") or {}
            clock = {name: config[name] for name in ("clock", "clock_limit_s") if name in config}
    return Lidar.model_validate(clock)


def returns_of(firings: list[LidarFirings]) -> Returns:
    """Returns beyond MIN_RANGE_M of evenly chosen firing sequences: every laser stays."""
    seen = [packet.range_m > MIN_RANGE_M for packet in firings]
    step = max(-(-sum(int(s.sum()) for s in seen) // MOST_RETURNS), 1)
    before = 0
    kept: list[tuple[LidarFirings, np.ndarray]] = []
    for packet, good in zip(firings, seen, strict=True):
        sequence = (before + np.arange(len(good))) // LASERS
        before += len(good)
        kept.append((packet, np.nonzero(good & (sequence % step == 0) & (packet.return_kind == 0))[0]))
    return Returns(
        stamp_ns=np.concatenate([p.pulse_stamp_ns[k] for p, k in kept]),
        laser=np.concatenate([p.laser[k] for p, k in kept]),
        xyz_lidar_m=np.concatenate([p.xyz_lidar_m[k] for p, k in kept]).astype(np.float64),
    )


def checked_rig(text: str, where: str) -> tuple[dict[str, object], LidarMount]:
    """A rig file's tree and its LiDAR's mount. LinkError says what is wrong with it."""
    try:
        rig = yaml.safe_load(text)
        return rig, LidarMount.model_validate(rig["lidar"]["mount"])
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise LinkError(f"{where}: the rig cannot be read: {str(error).splitlines()[0]}") from None
    except ValidationError as errors:
        first = errors.errors(include_url=False)[0]
        at = ".".join(str(part) for part in ("lidar", "mount", *first["loc"]))
        raise LinkError(f"{where}: the rig's {at}: {first['msg']}") from None
