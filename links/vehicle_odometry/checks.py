"""Preflight checks of the vehicle's own odometry: rate, age, and records that hold no pose."""

from __future__ import annotations

from collections.abc import Iterator

from flow.graph import Graph
from flow.link import Record, Source
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observation, Observations, ObservedSource
from links.udp import MAX_AGE_S, MAX_AHEAD_S, WRONG_AGE
from links.vehicle_odometry.odometry import TILTED, VehicleOdometry
from stages.geometry.trajectory import RECENT_NS, same_vertical
from stages.messages import VehicleMotion

OLD_MS = 200.0  # age of a pose
ODOMETRY_HZ = 5.0
RECENT_S = 1e-9 * RECENT_NS  # the vehicle's motion is known this long after a pose


class OdometryObservation(Observation):
    """Also whether the poses have an age."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.has_age = False

    def add(self, record: Record) -> None:
        """See Observation."""
        super().add(record)
        self.has_age |= b'"age_s"' in record.data


class VehicleOdometryChecks(LinkChecks):
    """Checks of the vehicle's own odometry."""

    link_class = VehicleOdometry

    def observation(self, source: Source) -> OdometryObservation:
        """See LinkChecks."""
        return OdometryObservation(source.topic)

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """Vehicle odometry is optional."""
        if not declares(graph, VehicleOdometry):
            yield warning("vehicle odometry", "not in this configuration: the vehicle is assumed parked")

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        assert isinstance(source.link, VehicleOdometry)
        yield odometry_check(source, source.link)
        observation, link = source.observation, source.link
        if source.live and observation.records.count and not link.settings.latency_s:
            assert isinstance(observation, OdometryObservation)
            if not observation.has_age:
                yield warning(
                    f"{source.name} age",
                    "its poses have no age_s, so their latency is taken as 0; an error of 0.1 s in a turn of 30 deg/s "
                    f"is 0.8 m at 15 m: send age_s, or set {source.name}.latency_s",
                )
        motions = observations.all(VehicleMotion)
        if motions and all(same_vertical(motion.R_map_vehicle, motions[0].R_map_vehicle) for motion in motions):
            yield warning(
                f"{source.name} tilt",
                "its roll and pitch do not change. If it does not measure them, those of a car on a level road are "
                "assumed (fuse.errors.vehicle_tilt_deg_per_mps2); a slope of 1 deg is 0.17 m at 10 m: set "
                "fuse.errors.vehicle_tilt_deg to that of your roads",
            )


def odometry_check(source: ObservedSource, link: VehicleOdometry) -> CheckResult:
    """The result of one vehicle odometry source."""
    if source.live and link.settings.port is None:
        return warning(source.name, "no port is set: the vehicle is assumed parked")
    records = source.observation.records
    wrong_age = source.counters.get(WRONG_AGE, 0)
    limits = f"not from {-MAX_AHEAD_S:g} to {MAX_AGE_S:g} s"
    why_age = f"{wrong_age} poses with an age_s that is {limits}: check age_s and the sender's clock"
    if not records.count and wrong_age:
        return fail(source.name, why_age)
    if not records.count:
        text = f"{source.no_data_reason}: the vehicle would be assumed parked"
        return fail(source.name, f"{text}; start it, or set port: null") if source.live else warning(source.name, text)
    rejected, age_ms = sum(source.counters.rejected.values()), 1e-6 * records.max_age_ns
    text = f"{records.rate_hz:.0f} poses/s, at most {age_ms:.0f} ms old" + (
        f", {rejected} rejected" if rejected else ""
    )
    if source.counters.rejected.get(TILTED):
        asked = "is the quaternion x, y, z, w, and z up? If z is down, set rig.odometry.axes to frd"
        return fail(source.name, f"{text}: {TILTED}: {asked}")
    if rejected >= records.count:
        return fail(source.name, f"{text}: none is a valid pose (recordings/README.md, /vehicle/odometry)")
    silent_s = records.longest_silence_s(source.end_ns)
    if source.live and silent_s + 1e-3 * age_ms >= RECENT_S:
        text += f"; no pose for {silent_s:.1f} s, and {RECENT_S:g} s after a pose the vehicle's motion is unknown"
        return fail(source.name, f"{text}: is its sender still running, and fast enough?")
    if wrong_age:
        return warning(source.name, f"{text}; {why_age}")
    if not records.rate_hz >= ODOMETRY_HZ or age_ms > OLD_MS or rejected:
        return warning(source.name, f"{text}: check its rate, its age_s and its clock")
    return ok(source.name, text)
