"""Run all checks of one configuration in their order, live or on a recording.

The checks of a link are in its driver's `checks.py`; this module holds the loop over the links and the motion checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from flow.graph import Graph
from links.preflight.check_result import CheckResult, fail, warning
from links.preflight.collect import ObservationTap, collect_live, collect_recording, simulated_rig
from links.preflight.devices import DEVICES, checks_for
from links.preflight.graphs import locates_drones, sources_only, tracking
from links.preflight.hand_motion import MOTIONS, HandMotion, check_motion
from links.preflight.motion_checks import motion_checks
from links.preflight.observations import Observations
from links.recording import Progress, Session
from stages.messages import DroneAttitude, DroneOdometry

POLL_S = 0.05  # interval of the check whether every source has sent
OUT_DIR = Path("out")  # default folder for the output of `grd run`

Wait = Callable[[float], None]
Ask = Callable[[HandMotion], None]  # shows a person what to do and returns when they begin


def preflight_live(
    graph: Graph,
    seconds: float,
    wait: Wait,
    ask: Ask | None,
    step_s: float = 6.0,
    out_dir: Path = OUT_DIR,
    whole: Graph | None = None,
) -> Iterator[CheckResult]:
    """Check live hardware; yields each result as soon as it is known. Raises LinkError if the simulated rig fails.

    First the sources alone run: for `seconds` from when all have sent a record, or twice as long in all. Then the
    devices are asked (autopilot parameters, free disk space at `out_dir`). Then the drone is moved by hand while the
    LiDAR tracks it, unless `ask` is None. `whole`: the graph of all hosts, if `graph` is the part of one; what the
    configuration lacks is judged by it.
    """
    with simulated_rig(graph):
        observations = collect_live(sources_only(graph), lambda tap: observe(tap, wait, seconds))
        yield from link_checks(graph, observations, out_dir, whole)
        if not _has_attitude(observations):
            return
        if ask is None:
            yield from motion_checks(observations)
            yield warning(
                "by hand", "skipped (--no-motion): the signs of the axes are checked only as far as reported above"
            )
            return
        moved: list[CheckResult] = []
        observations = collect_live(tracking(graph), lambda tap: moved.extend(_hand_motions(tap, wait, ask, step_s)))
        yield from moved
        yield from motion_checks(observations)


def observe(tap: ObservationTap, wait: Wait, seconds: float) -> None:
    """Wait for `seconds` from when every source has sent a record: the process of a driver takes time to start.

    A source that sends nothing is waited for at most as long again.
    """
    waited_s = 0.0
    while not tap.every_source_has_sent and waited_s < seconds:
        wait(POLL_S)
        waited_s += POLL_S
    wait(seconds)


def preflight_recording(
    graph: Graph, session: Session, motion: bool, progress: Progress | None = None
) -> Iterator[CheckResult]:
    """Run the same checks on all parts of a recording, except those that ask a device or a person."""
    observations = collect_recording(tracking(graph) if motion else sources_only(graph), session, progress)
    yield from link_checks(graph, observations, OUT_DIR)
    if motion and _has_attitude(observations):
        yield from motion_checks(observations)
    elif not motion:
        yield warning("axes", "skipped (--no-motion): not checked")


def link_checks(
    graph: Graph, observations: Observations, out_dir: Path, whole: Graph | None = None
) -> Iterator[CheckResult]:
    """Results of every link of `graph`, and of those that the configuration (`whole`, or else `graph`) lacks."""
    for source in observations.sources:
        yield from checks_for(source.link).check_source(source, observations)
    yield from configuration_checks(whole or graph)
    for checks in DEVICES:
        yield from checks.check_device(graph, observations, out_dir)


def configuration_checks(graph: Graph) -> Iterator[CheckResult]:
    """Results that follow from the configuration alone."""
    for checks in DEVICES:
        yield from checks.check_configuration(graph)
    if not locates_drones(graph):
        yield fail("stages", "no stage of this configuration locates the drone")


def _has_attitude(observations: Observations) -> bool:
    return bool(observations.all(DroneAttitude) or observations.all(DroneOdometry))


def _hand_motions(tap: ObservationTap, wait: Wait, ask: Ask, step_s: float) -> Iterator[CheckResult]:
    """Ask for each motion, wait for it, and check the attitudes that arrived meanwhile."""
    for motion in MOTIONS:
        ask(motion)
        before_ns = _newest_ns(tap)
        wait(step_s if motion.measure is not None else 3 * step_s)
        if motion.measure is not None:
            attitudes: list[Any] = tap.messages(DroneAttitude) or tap.messages(DroneOdometry)
            yield check_motion(motion, [m for m in attitudes if m.stamp_ns >= before_ns])


def _newest_ns(tap: ObservationTap) -> int:
    attitudes: list[Any] = tap.messages(DroneAttitude) or tap.messages(DroneOdometry)
    return attitudes[-1].stamp_ns if attitudes else 0
