"""Preflight checks of the autopilot: heartbeat, losses, clock, rates, EKF status, parameters and firmware.

Source: https://mavlink.io/en/messages/common.html; parameters: `links.mavlink.profiles`; the limits are ours.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from flow.graph import Graph
from flow.link import LinkError, Record, Source
from links.mavlink.autopilot import Autopilot
from links.mavlink.frame_decoder import FOREIGN_TIMESYNC
from links.mavlink.origin import OriginState
from links.mavlink.parameters import ParameterValues, ask_parameters
from links.mavlink.profiles import ARDUPILOT_STREAMS, PROFILES, Profile, ProfileName, RequiredParameter, findings
from links.mavlink.transport.framing import header, parse_frame
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observation, Observations, ObservedSource
from links.preflight.record_statistics import RecordStatistics
from stages.heading.imu_buffer import CURRENT_NS
from stages.messages import AutopilotEstimator, AutopilotStatus, RelativePose

MAV_AUTOPILOT = {"ardupilot": 3, "px4": 12}
HEARTBEAT_GAP_S = 3.0
WARN_LOSS, FAIL_LOSS = 0.01, 0.2  # share of frames
WARN_MS, FAIL_MS = 10.0, 50.0  # clock uncertainty; at 5 m/s, 10 ms are 5 cm
MIN_HZ, GOOD_HZ = 4.0, 10.0
MAX_GAP_S = 1e-9 * CURRENT_NS
WARN_RATIO = 0.5  # innovation test ratio; above 1 the EKF rejects the measurement
LINK_HINT = "is the radio out of range, or too slow for the requested messages?"


class AutopilotObservation(Observation):
    """Message types of one autopilot, other senders on its connection, and its MAV_AUTOPILOT."""

    def __init__(self, topic: str, sender: tuple[int, int]) -> None:
        super().__init__(topic)
        self._sender = sender
        self.kinds: defaultdict[str, RecordStatistics] = defaultdict(RecordStatistics)
        self.others: Counter[tuple[int, int]] = Counter()  # (system, component)
        self.autopilot: int | None = None  # MAV_AUTOPILOT

    def add(self, record: Record) -> None:
        """See Observation. Damaged frames are counted by the link."""
        super().add(record)
        if record.topic != self.topic:
            return
        try:
            frame: Any = parse_frame(record.data)
        except ValueError:
            return
        sender, _ = header(record.data)
        if sender != self._sender:
            self.others[sender] += 1
            return
        self.kinds[frame.get_type()].add(record)
        if frame.get_type() == "HEARTBEAT":
            self.autopilot = int(frame.autopilot)


class AutopilotChecks(LinkChecks):
    """Checks of a MAVLink autopilot."""

    link_class = Autopilot

    def observation(self, source: Source) -> AutopilotObservation:
        """See LinkChecks."""
        assert isinstance(source, Autopilot)
        return AutopilotObservation(source.topic, (source.settings.system_id, source.settings.component_id))

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """An autopilot is optional; one that gets no pose is reported."""
        if not declares(graph, Autopilot):
            yield warning("autopilot", "not in this configuration: no pose is sent, and no telemetry is received")
        elif not any(
            e.message is RelativePose and issubclass(graph.nodes[e.consumer].cls, Autopilot) for e in graph.edges
        ):
            yield warning(
                "autopilot pose", "not wired (inputs: {pose: fuse.relative_pose}): no pose is sent to the drone"
            )

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        return autopilot_checks(source, observations.all(AutopilotStatus), observations.all(AutopilotEstimator))

    def check_device(self, graph: Graph, observations: Observations, out_dir: Path) -> Iterator[CheckResult]:
        """The parameters of each autopilot that sent anything."""
        for source in observations.of(Autopilot):
            if not observations.live:
                yield warning(f"{source.name} parameters", "not in a recording: not checked")
            elif isinstance(source.link, Autopilot) and source.observation.records.count:
                yield from _parameters(source.name, source.link)


def autopilot_checks(
    source: ObservedSource, statuses: Sequence[AutopilotStatus], estimators: Sequence[AutopilotEstimator]
) -> Iterator[CheckResult]:
    """All checks of one autopilot but its parameters and its axes."""
    link, observation = source.link, source.observation
    assert isinstance(link, Autopilot)
    assert isinstance(observation, AutopilotObservation)
    who = f"system {link.settings.system_id}, component {link.settings.component_id}"
    if not observation.kinds["HEARTBEAT"].count or not statuses:
        yield _silent(source, observation, who)
        return
    yield _heartbeat(source, link, observation, statuses[-1])
    yield _losses(source)
    yield _clock(source, statuses[-1])
    yield _rates(source, link, observation)
    yield _estimate(source.name, link, estimators)
    if link.settings.global_origin is not None and source.live:
        yield _origin(source.name, link.origin)


def _silent(source: ObservedSource, observation: AutopilotObservation, who: str) -> CheckResult:
    name = f"{source.name} heartbeat"
    if observation.others:
        others = ", ".join(f"system {s} component {c}" for s, c in observation.others)
        return fail(name, f"none from {who}, but from {others}: set system_id and component_id")
    if sum(kind.count for kind in observation.kinds.values()):
        return fail(name, f"none from {who}, but other messages: is its link set to MAVLink 2, is it booting?")
    unsigned = source.counters.get("not signed with our key", 0)
    if unsigned:
        return fail(name, f"{unsigned} frames without a valid signature: check signing_key on both sides")
    old = source.counters.get("signed with our key, but not new", 0)
    if old:
        return fail(name, f"{old} frames signed with an old time: does it receive our frames? Check both directions")
    return fail(name, source.no_data_reason if source.status else f"no frame from {who}: {source.no_data_reason}")


def _heartbeat(
    source: ObservedSource, link: Autopilot, observation: AutopilotObservation, status: AutopilotStatus
) -> CheckResult:
    name, beats = f"{source.name} heartbeat", observation.kinds["HEARTBEAT"]
    silent_s = beats.longest_silence_s(source.end_ns)
    expected = MAV_AUTOPILOT[link.settings.profile]
    if (
        observation.autopilot is not None
        and observation.autopilot in MAV_AUTOPILOT.values()
        and observation.autopilot != expected
    ):
        reported = next(kind for kind, number in MAV_AUTOPILOT.items() if number == observation.autopilot)
        return fail(
            name, f"the autopilot is {reported}, the configuration has {link.settings.profile}: set profile: {reported}"
        )
    if status.failsafe:
        return fail(
            name,
            "its state is critical, emergency or termination: read its own messages (after a landing on grd's source "
            "set: select set 1, or reboot it)",
        )
    if source.live and status.armed:
        return fail(name, "it is armed: disarm it before a preflight")
    if source.live and silent_s > HEARTBEAT_GAP_S:
        return fail(name, f"none for {silent_s:.1f} s: check the radio and its range")
    rate = "one heartbeat" if beats.count == 1 else f"{beats.rate_hz:.1f} Hz"
    if observation.autopilot not in MAV_AUTOPILOT.values():
        return warning(name, f"{rate}, of MAV_AUTOPILOT {observation.autopilot}: only ArduPilot and PX4 are supported")
    return ok(name, f"{rate}, {link.settings.profile}" + (", armed" if status.armed else ", disarmed"))


def _losses(source: ObservedSource) -> CheckResult:
    name, counters = f"{source.name} frames", source.counters
    lost, received = counters.get("lost", 0), max(counters.get("decoded", 0) + counters.get("unused", 0), 1)
    foreign = counters.get("from other senders", 0)
    share = lost / (lost + received)
    text = f"{lost} of {lost + received} lost" + (
        f", {foreign} datagrams from other senders ignored" if foreign else ""
    )
    if share > FAIL_LOSS:
        return fail(name, f"{text}: is the line too slow for the requested messages, or the radio out of range?")
    return warning(name, text) if share > WARN_LOSS or foreign else ok(name, text)


def _clock(source: ObservedSource, status: AutopilotStatus) -> CheckResult:
    """Clock offset by TIMESYNC, and the bound of its error."""
    name = f"{source.name} clock"
    restarts = source.counters.get("clock restarts", 0)
    if restarts:
        return fail(name, f"its clock was reset {restarts} times: did it reboot, or do two autopilots share one id?")
    if status.clock_offset_ns is None:
        return fail(name, "no message has a time stamp: request ATTITUDE")
    if status.clock_uncertainty_ns is None and source.counters.get("timesync replies", 0):
        return warning(
            name,
            "its TIMESYNC replies are earlier than its other messages allow, so the error of its clock is not known "
            "(SITL subtracts the time of a slow line that it does not have: set SERIALn_BAUD of this port to 1500)",
        )
    if status.clock_uncertainty_ns is None:
        foreign = source.counters.rejected.get(FOREIGN_TIMESYNC, 0)
        why = (
            "does it receive our frames?"
            if not foreign
            else f"{foreign} were for another component: check own_system_id, own_component_id"
        )
        return warning(name, f"no TIMESYNC reply: a constant delay of the link is unknown; {why}")
    error_ms = 1e-6 * status.clock_uncertainty_ns
    text = f"offset {1e-9 * status.clock_offset_ns:.3f} s to its time since boot, +- {error_ms:.1f} ms"
    if status.clock_drift_ppm is not None and status.clock_drift_sigma_ppm is not None:
        text += f", drift {status.clock_drift_ppm:.1f} +- {status.clock_drift_sigma_ppm:.1f} ppm"
    if error_ms > FAIL_MS:
        return fail(name, f"{text}: the link is too slow or overloaded; lower its rates or use a cable")
    return (
        warning(name, f"{text}: at 5 m/s that is {5 * error_ms / 10:.0f} cm") if error_ms > WARN_MS else ok(name, text)
    )


def _rates(source: ObservedSource, link: Autopilot, observation: AutopilotObservation) -> CheckResult:
    """Rates of the messages that grd needs, and their longest gaps."""
    name = f"{source.name} rates"

    def hz(kind: str) -> float:
        rate_hz = observation.kinds[kind].rate_hz
        return 0.0 if math.isnan(rate_hz) else rate_hz

    def gap(what: str, *kinds: str) -> str | None:
        gap_s = min(observation.kinds[kind].longest_silence_s(source.end_ns) for kind in kinds)
        return (
            f"{text}; no {what} for {gap_s:.1f} s, at most {MAX_GAP_S:g} s allowed: {LINK_HINT}"
            if gap_s > MAX_GAP_S
            else None
        )

    kinds = ("ATTITUDE", "ODOMETRY", "LOCAL_POSITION_NED")
    attitude, odometry, position = (hz(kind) for kind in kinds)
    text = ", ".join(f"{kind} {hz(kind):.0f} Hz" for kind in kinds)
    if max(attitude, odometry) < MIN_HZ:
        hint = rate_hint(link.settings.profile, "ATTITUDE")
        return fail(name, f"{text}: attitude is needed at {GOOD_HZ:.0f} Hz or more: {hint}")
    attitude_gap = gap("attitude", "ATTITUDE", "ODOMETRY")
    if attitude_gap is not None:
        return fail(name, attitude_gap) if source.live else warning(name, attitude_gap)
    hint = rate_hint(link.settings.profile, *kinds)
    if max(odometry, position) < MIN_HZ:
        return warning(
            name, f"{text}: without odometry there is no pose while the LiDAR does not measure the drone: {hint}"
        )
    position_gap = gap("odometry or position", "ODOMETRY", "LOCAL_POSITION_NED")
    if position_gap is not None:
        return warning(name, position_gap)
    slow = max(attitude, odometry) < GOOD_HZ or max(odometry, position) < GOOD_HZ
    return warning(name, f"{text}: low rate; {hint}") if slow else ok(name, text)


def rate_hint(profile: ProfileName, *kinds: str) -> str:
    """How to increase the rate of messages."""
    if profile == "px4":
        return "increase its rate (MAV_n_MODE 2, onboard)"
    return f"increase its rate ({', '.join(f'{kind}: {ARDUPILOT_STREAMS[kind]}' for kind in kinds)}; n: its port)"


def _origin(name: str, state: OriginState | None) -> CheckResult:
    """Whether the autopilot has a global origin."""
    name = f"{name} origin"
    if state in (OriginState.CONFIRMED, OriginState.PRESENT):
        return ok(name, state.value)
    if state is OriginState.UNSUPPORTED:
        return warning(name, f"{state.value}: set it by the ground station")
    return fail(name, f"{'not requested' if state is None else state.value}: without it the EKF uses no position")


def _estimate(name: str, link: Autopilot, estimators: Sequence[AutopilotEstimator]) -> CheckResult:
    """Newest status of the EKF."""
    name = f"{name} estimate"
    if not estimators:
        hint = rate_hint(link.settings.profile, "EKF_STATUS_REPORT")
        return warning(name, f"no EKF status (EKF_STATUS_REPORT, ESTIMATOR_STATUS): {hint}")
    newest = estimators[-1]
    ratios = {
        "velocity": newest.velocity_ratio,
        "position": newest.horizontal_ratio,
        "height": newest.height_ratio,
        "compass": newest.compass_ratio,
    }
    rejected = [f"{what} ({ratio:.1f})" for what, ratio in ratios.items() if ratio > 1]
    if rejected:
        return fail(name, f"its EKF rejects {', '.join(rejected)}: is another sensor wrong, such as compass or GPS?")
    if not newest.attitude_good and link.settings.profile == "px4" and link.settings.yaw == "measured":
        return warning(name, "its EKF has no yaw: normal without compass before poses are sent; keep it still and wait")
    if not newest.attitude_good:
        return fail(name, "its EKF has no attitude yet: keep it still and wait, then read its own messages")
    held = newest.constant_position and link.settings.profile == "ardupilot"  # newer PX4: also at rest on the ground
    if held or not newest.position_good:
        return warning(name, "attitude good, no position: normal before poses are sent; check again when grd run sends")
    near = [f"{what} ({ratio:.1f})" for what, ratio in ratios.items() if ratio > WARN_RATIO]
    if near:
        return warning(name, f"{', '.join(near)} close to rejection by its EKF")
    return ok(name, "attitude and position good, all test ratios small")


def _parameters(name: str, link: Autopilot) -> Iterator[CheckResult]:
    try:
        received = ask_parameters(link)
    except LinkError as error:
        yield fail(f"{name} parameters", str(error))
        return
    yield parameter_check(name, link.settings.required_parameters, received)
    if received.frames:
        yield version_check(name, PROFILES[link.settings.profile], received.version)


def version_check(name: str, profile: Profile, version: tuple[int, int, int] | None) -> CheckResult:
    """Whether grd supports the firmware."""
    name, least = f"{name} firmware", ".".join(map(str, profile.least_version))
    if version is None:
        return warning(name, f"its version was not received: check that it is {profile.name} {least} or later")
    text = f"{profile.name} {'.'.join(map(str, version))}"
    if profile.unknown_version is not None and version[:2] >= profile.unknown_version:
        before = ".".join(map(str, profile.unknown_version))
        return fail(name, f"{text}: before {before} is needed: {profile.unknown_version_why}")
    if version[:2] < profile.least_version:
        return fail(name, f"{text}: {least} or later is needed: {profile.least_version_why}")
    return ok(name, text)


def parameter_check(name: str, required: Sequence[RequiredParameter], received: ParameterValues) -> CheckResult:
    """One result that names every wrong or missing parameter."""
    name = f"{name} parameters"
    if not received.frames:
        return fail(name, "the autopilot does not reply")
    if not received.values:
        return fail(name, "none was received: does it receive our frames, and may this link read parameters?")
    wrong = findings(required, received.values)
    if wrong:
        return fail(name, "; ".join(wrong))
    return ok(name, f"all {len({parameter.name for parameter in required})} as required")
