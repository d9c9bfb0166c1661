"""What a calibration needs of a recording: returns, servo states, the rig, and where the vehicle says it was.

Source: ours. Records go through the same decoders as in a run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.config.yaml_text import yaml_values
from flow.link import LinkError, Record
from links.dynamixel import Servo
from links.dynamixel.servo import TICK_RAD
from links.lidar import Lidar, recorded_lidars, rig_unit
from links.recording import Progress, Session
from links.vehicle_odometry import VehicleOdometry
from stages.calibration.scan_passes import Returns, ServoTrace
from stages.geometry.frames import LidarMount
from stages.geometry.rig_lidar import RigLidar
from stages.messages import LidarFirings

MOST_RETURNS = 300_000  # more add seconds and no accuracy: firing sequences are left out evenly
Array = NDArray[Any]
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
    parts: int  # of the recording, that were read
    warnings: list[str]  # what of it could not be read


def gather(
    recording: Path, rig_yaml: str | None, part_s: tuple[float, float], progress: Progress | None = None
) -> Gathered:
    """Read a recording, all its parts, from and to a time in it [s]. `rig_yaml` stands in for its own rig. LinkError.

    It is read twice, to count the returns and to take some: an hour of them all would not fit into the memory.
    """
    servo, odometry = Servo(), VehicleOdometry()
    session = Session(recording)
    text = rig_yaml or session.rig_yaml
    if text is None:
        raise LinkError(f"{recording} holds no rig, which is what is to be improved: give one with --rig FILE")
    begin_ns, end_ns = (session.start_ns + 1e9 * s for s in part_s)

    def between(topics: list[str], half: int) -> Iterator[Record]:
        def step(done: int, of: int) -> None:
            if progress is not None:
                progress(half * of + done, 2 * of)

        for record in session.records(topics, progress=step):
            if record.arrival_ns > end_ns:
                return
            if record.arrival_ns >= begin_ns:
                yield record

    rig, unit = checked_rig(text, str(recording if rig_yaml is None else "--rig"))
    lidar = lidar_of(session.config_yaml, unit)
    good = 0
    ends_ns: list[int] = []  # of the first packet and of the last
    servo_stamps_ns: list[int] = []
    servo_rad: list[float] = []
    start_m, driven_m = None, None
    for record in between([lidar.topic, servo.topic, odometry.topic], half=0):
        if record.topic == lidar.topic:
            if (packet := lidar.decode(record)) is not None:
                good += int(np.count_nonzero(packet.range_m > MIN_RANGE_M))
                ends_ns[1:] = [packet.stamp_ns]
        elif record.topic == servo.topic:
            if (state := servo.decode(record)) is not None:
                servo_stamps_ns.append(state.stamp_ns)
                servo_rad.append(state.position_rad)
        elif (motion := odometry.decode(record)) is not None:
            start_m = motion.xyz_map_m if start_m is None else start_m
            driven_m = max(driven_m or 0.0, float(np.linalg.norm(motion.xyz_map_m - start_m)))
    if not ends_ns:
        raise LinkError(f"{recording} holds no LiDAR packets in that time: is it the right recording, and the part?")
    if not servo_rad:
        raise LinkError(
            f"{recording} contains no servo states in that time: a LiDAR that does not turn observes no surface twice, "
            "so there is no servo mount to calibrate"
        )
    trace = ServoTrace.of(np.array(servo_stamps_ns), np.array(servo_rad), TICK_RAD)
    seconds = (ends_ns[-1] - ends_ns[0]) * 1e-9
    again = lidar_of(session.config_yaml, unit)
    packets = (packet for record in between([again.topic], half=1) if (packet := again.decode(record)) is not None)
    returns = returns_of(packets, again.form.profile.lasers, step=max(-(-good // MOST_RETURNS), 1))
    return Gathered(returns, trace, rig, unit.mount, driven_m, seconds, len(session.parts), session.warnings)


def lidar_of(config_yaml: str | None, unit: RigLidar) -> Lidar:
    """The LiDAR with its clock as the recorded run had it: another would move all its pulses against the servo.

    Free, a sensor's clock is set by the packets that come soonest: late by the shortest way, in the simulated rig 2 ms.
    """
    config = next(reversed(recorded_lidars(config_yaml)), {})
    clock = {name: config[name] for name in ("clock", "clock_limit_s") if name in config}
    return Lidar(unit=unit, **clock)


def returns_of(packets: Iterable[LidarFirings], lasers_of_model: int, step: int) -> Returns:
    """Returns beyond MIN_RANGE_M of every step-th firing sequence: every laser stays."""
    before = 0
    stamps: list[Array] = []
    lasers: list[Array] = []
    points: list[Array] = []
    for packet in packets:
        good = packet.range_m > MIN_RANGE_M
        sequence = (before + np.arange(len(good))) // lasers_of_model
        before += len(good)
        kept = np.nonzero(good & (sequence % step == 0) & (packet.return_kind == 0))[0]
        stamps.append(packet.pulse_stamp_ns[kept])
        lasers.append(packet.laser[kept])
        points.append(packet.xyz_lidar_m[kept])
    return Returns(
        stamp_ns=np.concatenate(stamps),
        laser=np.concatenate(lasers),
        xyz_lidar_m=np.concatenate(points).astype(np.float64),
        lasers=lasers_of_model,
    )


def checked_rig(text: str, where: str) -> tuple[dict[str, object], RigLidar]:
    """A rig file's tree and its LiDAR. Raises LinkError with the reason."""
    unit = rig_unit(text, where)
    return yaml_values(text), unit
