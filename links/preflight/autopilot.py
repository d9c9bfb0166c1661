"""Is the autopilot's link as it must be: heartbeat, clock, rates, losses, and what its EKF says it fuses.

Source: https://mavlink.io/en/messages/common.html; ArduPilot and PX4 by `links.mavlink.profiles`; the limits are ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from links.mavlink import Autopilot
from links.preflight.arrivals import Arrivals
from links.preflight.heard import Heard
from links.preflight.seen import AutopilotSeen
from links.preflight.verdict import Verdict, fail, ok, warning
from stages.messages import AutopilotEstimator, AutopilotStatus
from stages.odometry.drone.trajectory import BRIDGED_NS

KINDS = {"ardupilot": 3, "px4": 12}  # MAV_AUTOPILOT
HEARTBEAT_GAP_S = 3.0
SOME_LOSS, WORST_LOSS = 0.01, 0.2
UNSURE_MS, USELESS_MS = 10.0, 50.0  # at 5 m/s 10 ms are 5 cm
LEAST_HZ, GOOD_HZ = 4.0, 10.0
MOST_GAP_S = 1e-9 * BRIDGED_NS
NEAR_GATE = 0.5  # an innovation test ratio; at 1 the EKF refuses what it is told
STEADY = "is the radio too far, or too slow for what is asked of it?"
ASK = "ask for more (SRn_EXTRA1, SRn_POSITION of that port; PX4: its mavlink mode)"


def autopilot_checks(
    heard: Heard, statuses: Sequence[AutopilotStatus], estimators: Sequence[AutopilotEstimator]
) -> Iterator[Verdict]:
    """All checks of one autopilot but its parameters and its axes."""
    link, seen = heard.link, heard.seen
    assert isinstance(link, Autopilot)
    assert isinstance(seen, AutopilotSeen)
    who = f"system {link.settings.system_id}, component {link.settings.component_id}"
    if not seen.kinds["HEARTBEAT"].count or not statuses:
        yield _silent(heard, seen, who)
        return
    yield _heartbeat(heard, link, seen, statuses[-1])
    yield _losses(heard)
    yield _clock(heard, statuses[-1])
    yield _rates(heard, seen)
    yield _estimate(heard.name, estimators)


def _silent(heard: Heard, seen: AutopilotSeen, who: str) -> Verdict:
    name = f"{heard.name} heartbeat"
    if seen.others:
        others = ", ".join(f"system {s} component {c}" for s, c in seen.others)
        return fail(name, f"none from {who}, but {others} speak here: set system_id and component_id")
    if sum(kind.count for kind in seen.kinds.values()):
        return fail(
            name, f"none from {who}, though it sends other messages: is its link set to MAVLink 2, is it booting?"
        )
    unsigned = heard.counters.get("not signed with our key", 0)
    if unsigned:
        return fail(name, f"{unsigned} frames came that are not signed with our key: check signing_key on both sides")
    old = heard.counters.get("signed with our key, but not new", 0)
    if old:
        return fail(name, f"{old} frames came that are signed with an old time: does it hear us? Check both directions")
    return fail(name, heard.silence if heard.status else f"no word from {who}: {heard.silence}")


def _heartbeat(heard: Heard, link: Autopilot, seen: AutopilotSeen, status: AutopilotStatus) -> Verdict:
    name, beats = f"{heard.name} heartbeat", seen.kinds["HEARTBEAT"]
    silent_s = beats.longest_silence_s(heard.end_ns)
    wanted = KINDS[link.settings.profile]
    if seen.autopilot is not None and seen.autopilot in KINDS.values() and seen.autopilot != wanted:
        says = next(kind for kind, number in KINDS.items() if number == seen.autopilot)
        return fail(name, f"it says it is {says}, the configuration {link.settings.profile}: set profile: {says}")
    if status.failsafe:
        return fail(name, "it says critical, emergency or termination: look at its own messages")
    if heard.live and status.armed:
        return fail(name, "it is armed: disarm it before a preflight")
    if heard.live and silent_s > HEARTBEAT_GAP_S:
        return fail(name, f"none for {silent_s:.1f} s: check the radio and its range")
    rate = "one" if beats.count == 1 else f"{beats.rate_hz:.1f} a second"
    if seen.autopilot not in KINDS.values():
        return warning(name, f"{rate}, of MAV_AUTOPILOT {seen.autopilot}: only ArduPilot and PX4 are known")
    return ok(name, f"{rate}, {link.settings.profile}" + (", armed" if status.armed else ", disarmed"))


def _losses(heard: Heard) -> Verdict:
    name, counters = f"{heard.name} frames", heard.counters
    lost, came = counters.get("lost", 0), max(counters.get("decoded", 0) + counters.get("of no use here", 0), 1)
    foreign = counters.get("from other senders", 0)
    share = lost / (lost + came)
    text = f"{lost} of {lost + came} lost" + (f", {foreign} datagrams from other senders ignored" if foreign else "")
    if share > WORST_LOSS:
        return fail(name, f"{text}: is the line too slow for what is asked of it, or the radio too far?")
    return warning(name, text) if share > SOME_LOSS or foreign else ok(name, text)


def _clock(heard: Heard, status: AutopilotStatus) -> Verdict:
    """TIMESYNC: the offset, and by how much it may be wrong at most."""
    name = f"{heard.name} clock"
    restarts = heard.counters.get("clock restarts", 0)
    if restarts:
        return fail(name, f"its clock began anew {restarts} times: did it reboot, or do two autopilots share one id?")
    if status.clock_offset_ns is None:
        return fail(name, "no message carried its time: ask for ATTITUDE")
    if status.clock_uncertainty_ns is None:
        named = heard.counters.get("refused: timesync for another", 0)
        why = "does it hear us (both ways)?" if not named else f"{named} name another: own_system_id, own_component_id?"
        return warning(name, f"no TIMESYNC reply: a constant delay of the link stays unknown; {why}")
    unsure_ms = 1e-6 * status.clock_uncertainty_ns
    text = f"offset {1e-9 * status.clock_offset_ns:.3f} s to its time since boot, known to {unsure_ms:.1f} ms"
    if status.clock_drift_ppm is not None and status.clock_drift_sigma_ppm is not None:
        text += f", drifting by {status.clock_drift_ppm:.1f} +- {status.clock_drift_sigma_ppm:.1f} ppm"
    if unsure_ms > USELESS_MS:
        return fail(name, f"{text}: the link is too slow or too full; lower its rates or use a wire")
    return (
        warning(name, f"{text}: at 5 m/s that is {5 * unsure_ms / 10:.0f} cm")
        if unsure_ms > UNSURE_MS
        else ok(name, text)
    )


def _rates(heard: Heard, seen: AutopilotSeen) -> Verdict:
    """How often it tells what we need; a rate hides gaps, so the longest is looked at, too."""
    name = f"{heard.name} rates"

    def hz(kind: str) -> float:
        arrivals: Arrivals = seen.kinds[kind]
        return 0.0 if math.isnan(arrivals.rate_hz) else arrivals.rate_hz

    def gap(what: str, *kinds: str) -> str | None:
        gap_s = min(seen.kinds[kind].longest_silence_s(heard.end_ns) for kind in kinds)
        return (
            f"{text}; no {what} for {gap_s:.1f} s, {MOST_GAP_S:g} s at most: {STEADY}" if gap_s > MOST_GAP_S else None
        )

    kinds = ("ATTITUDE", "ODOMETRY", "LOCAL_POSITION_NED")
    attitude, odometry, position = (hz(kind) for kind in kinds)
    text = ", ".join(f"{kind} {hz(kind):.0f} Hz" for kind in kinds)
    if max(attitude, odometry) < LEAST_HZ:
        return fail(name, f"{text}: its attitude is needed at {GOOD_HZ:.0f} Hz or more: {ASK}")
    turned = gap("attitude", "ATTITUDE", "ODOMETRY")
    if turned is not None:
        return fail(name, turned) if heard.live else warning(name, turned)
    if max(odometry, position) < LEAST_HZ:
        return warning(
            name, f"{text}: without its odometry the pose ends where the LiDAR does not see the drone: {ASK}"
        )
    moved = gap("odometry or position", "ODOMETRY", "LOCAL_POSITION_NED")
    if moved is not None:
        return warning(name, moved)
    slow = max(attitude, odometry) < GOOD_HZ or max(odometry, position) < GOOD_HZ
    return warning(name, f"{text}: slow; {ASK}") if slow else ok(name, text)


def _estimate(name: str, estimators: Sequence[AutopilotEstimator]) -> Verdict:
    """What the EKF says of itself, as told last."""
    name = f"{name} estimate"
    if not estimators:
        return warning(name, "its EKF does not report (EKF_STATUS_REPORT, ESTIMATOR_STATUS): " + ASK)
    newest = estimators[-1]
    ratios = {
        "velocity": newest.velocity_ratio,
        "position": newest.horizontal_ratio,
        "height": newest.height_ratio,
        "compass": newest.compass_ratio,
    }
    refused = [f"{what} ({ratio:.1f})" for what, ratio in ratios.items() if ratio > 1]
    if not newest.attitude_good:
        return fail(name, "its EKF has no attitude yet: keep it still and wait, then look at its own messages")
    if refused:
        return fail(name, f"its EKF refuses {', '.join(refused)}: is another source wrong, as its compass or GPS?")
    if newest.constant_position or not newest.position_good:
        return warning(name, "attitude good, no position: right before poses are sent; look again once grd run sends")
    near = [f"{what} ({ratio:.1f})" for what, ratio in ratios.items() if ratio > NEAR_GATE]
    if near:
        return warning(name, f"{', '.join(near)} nearly refused by its EKF")
    return ok(name, "attitude and position good, nothing near its gates")
