"""The checks of one configuration in their order: what it declares is looked at, what it lacks is said.

Source: ours; issue 6, point 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from flow.graph import Graph
from flow.link import Link, LinkError
from links.camera import Camera
from links.clock import Clock
from links.dynamixel import Servo
from links.mavlink import Autopilot
from links.preflight.autopilot import autopilot_checks
from links.preflight.by_hand import STEPS, Step, hand_check
from links.preflight.camera import camera_checks
from links.preflight.disk import disk_check
from links.preflight.graphs import listening, sees_drones, tracking
from links.preflight.heard import AllHeard, Ear, Heard
from links.preflight.lidar import lidar_checks
from links.preflight.listen import listen_live, listen_to_recording, simulated_rig
from links.preflight.motion import motion_checks
from links.preflight.parameters import ask_parameters, parameter_check
from links.preflight.servo import servo_checks
from links.preflight.verdict import Verdict, fail, ok, warning
from links.recording import Progress, Recorder, Session
from links.vehicle_odometry import VehicleOdometry
from links.velodyne import Lidar
from stages.messages import (
    AutopilotEstimator,
    AutopilotStatus,
    DroneAttitude,
    DroneOdometry,
    RelativePose,
)

OUT_DIR = Path("out")  # where `grd run` puts its folders
OLD_MS = 200.0  # of a pose of the vehicle's odometry
ODOMETRY_HZ = 5.0
ODOMETRY_SILENT_S = 1.0  # one that told poses and then none for so long has died

Wait = Callable[[float], None]
Ask = Callable[[Step], None]  # tells a person what to do and returns when they begin


def preflight_live(
    graph: Graph, seconds: float, wait: Wait, ask: Ask | None, step_s: float = 6.0, out_dir: Path = OUT_DIR
) -> Iterator[Verdict]:
    """All checks on live hardware, as they are known. `ask` None: no motion by hand. LinkError: the simulated rig.

    `out_dir` is where the run's folder would be: the disk there is looked at.

    First the sources are heard alone for some seconds, then the autopilot's parameters are read, then the drone is
    moved by hand while the LiDAR looks for it.
    """
    with simulated_rig(graph):
        heard = listen_live(listening(graph), lambda _: wait(seconds))
        yield from declared_checks(graph, heard)
        for recorder in (spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Recorder)):
            assert isinstance(recorder, Recorder)
            yield disk_check(recorder, heard, out_dir)
        for autopilot in heard.of(Autopilot):
            if isinstance(autopilot.link, Autopilot) and autopilot.seen.arrivals.count:
                yield _parameters(autopilot.name, autopilot.link)
        if not heard.all(DroneAttitude) and not heard.all(DroneOdometry):
            return
        if ask is None:
            yield from motion_checks(heard)
            yield warning("by hand", "left out (--no-motion): signs of the axes are known only as far as said above")
            return
        moved: list[Verdict] = []
        heard = listen_live(tracking(graph), lambda ear: moved.extend(_by_hand(ear, wait, ask, step_s)))
        yield from moved
        yield from motion_checks(heard)


def preflight_recording(
    graph: Graph, session: Session, motion: bool, progress: Progress | None = None
) -> Iterator[Verdict]:
    """The same checks on a recording, all its parts; parameters and motions that are asked for are live only."""
    heard = listen_to_recording(tracking(graph) if motion else listening(graph), session, progress)
    yield from declared_checks(graph, heard)
    for autopilot in heard.of(Autopilot):
        yield warning(f"{autopilot.name} parameters", "a recording does not tell them: not checked")
    if motion and (heard.all(DroneAttitude) or heard.all(DroneOdometry)):
        yield from motion_checks(heard)
    elif not motion:
        yield warning("axes", "left out (--no-motion): not checked")


def declared_checks(graph: Graph, heard: AllHeard) -> Iterator[Verdict]:
    """All that listening alone tells: each link of the configuration, and those that it has not."""
    rig: dict[str, Any] = graph.values.get("rig") or {}
    for part in heard.sources:
        link = part.link
        if isinstance(link, Lidar):
            yield from lidar_checks(part)
        elif isinstance(link, Servo):
            yield from servo_checks(part)
        elif isinstance(link, Camera):
            yield from camera_checks(part, rig_size_px(rig, link), rig_readout_ms(rig, link))
        elif isinstance(link, Autopilot):
            yield from autopilot_checks(part, heard.all(AutopilotStatus), heard.all(AutopilotEstimator))
        elif isinstance(link, VehicleOdometry):
            yield odometry_check(part, link)
        elif not isinstance(link, Clock):
            yield other_check(part)
    yield from absences(graph, rig)


def absences(graph: Graph, rig: dict[str, Any]) -> Iterator[Verdict]:
    """What the configuration does not declare, and what that means."""

    def has(kind: type[Link]) -> bool:
        return any(issubclass(spec.cls, kind) for spec in graph.nodes.values())

    turns = ((rig.get("lidar") or {}).get("mount") or {}).get("turns", True)
    if not has(Lidar):
        yield fail("lidar", "not in this configuration: nothing sees the drone; add links.velodyne.Lidar")
    if not has(Servo):
        text = "not in this configuration"
        yield (
            fail("servo", f"{text}, but the rig's LiDAR turns; add links.dynamixel.Servo")
            if turns
            else ok("servo", text)
        )
    if not has(Camera):
        yield warning("cameras", "not in this configuration: the drone's rotation comes from its motion alone")
    if not has(Autopilot):
        yield warning("autopilot", "not in this configuration: nobody is told the pose, and the drone says nothing")
    elif not any(e.message is RelativePose and issubclass(graph.nodes[e.consumer].cls, Autopilot) for e in graph.edges):
        yield warning("autopilot pose", "not wired (inputs: {pose: fuse.relative_pose}): the drone is told no pose")
    if not has(VehicleOdometry):
        yield warning("vehicle odometry", "not in this configuration: the vehicle is taken to be parked")
    if not has(Recorder):
        yield warning("recorder", "not in this configuration: the flight will not be recorded")
    if not sees_drones(graph):
        yield fail("stages", "no stage of this configuration tells where the drone is")


def rig_size_px(rig: dict[str, Any], link: Camera) -> tuple[int, int] | None:
    """What a camera's lens was calibrated for: its own setting, or the rig's."""
    size: Any = link.settings.size_px or rig_camera(rig, link).get("size_px")
    if size is None:
        return None
    return (size, size) if isinstance(size, int) else (int(size[0]), int(size[1]))


def rig_readout_ms(rig: dict[str, Any], link: Camera) -> float | None:
    """How long a camera's rows take: its own setting, or the rig's; None: neither says (a link's 0 is the default)."""
    return link.settings.readout_ms or rig_camera(rig, link).get("readout_ms")


def rig_camera(rig: dict[str, Any], link: Camera) -> dict[str, Any]:
    """What the rig says of a camera: of the one with the topic's last word."""
    cameras: dict[str, Any] = rig.get("cameras") or {}
    return cameras.get(link.topic.rpartition("/")[2]) or {}


def odometry_check(heard: Heard, link: VehicleOdometry) -> Verdict:
    """The vehicle's own odometry, where it has one."""
    if heard.live and link.settings.port is None:
        return warning(heard.name, "it has no port: the vehicle is taken to be parked")
    arrivals = heard.seen.arrivals
    if not arrivals.count:
        text = f"{heard.silence}: the vehicle would be taken to be parked"
        return fail(heard.name, f"{text}; start it, or set port: null") if heard.live else warning(heard.name, text)
    refused, age_ms = heard.counters.get("refused", 0), 1e-6 * arrivals.most_age_ns
    text = f"{arrivals.rate_hz:.0f} a second, at most {age_ms:.0f} ms old" + (f", {refused} refused" if refused else "")
    if refused >= arrivals.count:
        return fail(heard.name, f"{text}: none holds a pose (recordings/README.md, /vehicle/odometry)")
    silent_s = arrivals.longest_silence_s(heard.end_ns)
    if heard.live and silent_s > ODOMETRY_SILENT_S:
        return fail(heard.name, f"{text}; then none came for {silent_s:.1f} s: is its sender still running?")
    if not arrivals.rate_hz >= ODOMETRY_HZ or age_ms > OLD_MS or refused:
        return warning(heard.name, f"{text}: check its rate, and that its age_s and clock are right")
    return ok(heard.name, text)


def other_check(heard: Heard) -> Verdict:
    """A source that has no checks of its own."""
    arrivals = heard.seen.arrivals
    if not arrivals.count:
        return fail(heard.name, heard.silence)
    rate = "one record" if math.isnan(arrivals.rate_hz) else f"{arrivals.rate_hz:.1f} records a second"
    return warning(heard.name, f"{rate}; {heard.status}") if heard.status else ok(heard.name, rate)


def _parameters(name: str, link: Autopilot) -> Verdict:
    try:
        return parameter_check(name, link.settings.profile, ask_parameters(link))
    except LinkError as error:
        return fail(f"{name} parameters", str(error))


def _by_hand(ear: Ear, wait: Wait, ask: Ask, step_s: float) -> Iterator[Verdict]:
    """Each motion is asked for, waited for and judged by the attitudes that came meanwhile."""
    for step in STEPS:
        ask(step)
        before = _newest(ear)
        wait(step_s if step.measure is not None else 3 * step_s)
        if step.measure is not None:
            came: list[Any] = ear.messages(DroneAttitude) or ear.messages(DroneOdometry)
            yield hand_check(step, [m for m in came if m.stamp_ns >= before])


def _newest(ear: Ear) -> int:
    came: list[Any] = ear.messages(DroneAttitude) or ear.messages(DroneOdometry)
    return came[-1].stamp_ns if came else 0
