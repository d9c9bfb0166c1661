"""Preflight checks of the vehicle's own odometry: rate, age, and records that hold no pose."""

from __future__ import annotations

from collections.abc import Iterator

from flow.graph import Graph
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observations, ObservedSource
from links.vehicle_odometry.odometry import VehicleOdometry
from stages.geometry.trajectory import same_vertical
from stages.messages import VehicleMotion

OLD_MS = 200.0  # age of a pose
ODOMETRY_HZ = 5.0
ODOMETRY_SILENT_S = 1.0  # a sender that is silent for longer has stopped


class VehicleOdometryChecks(LinkChecks):
    """Checks of the vehicle's own odometry."""

    link_class = VehicleOdometry

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """Vehicle odometry is optional."""
        if not declares(graph, VehicleOdometry):
            yield warning("vehicle odometry", "not in this configuration: the vehicle is assumed parked")

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        assert isinstance(source.link, VehicleOdometry)
        yield odometry_check(source, source.link)
        motions = observations.all(VehicleMotion)
        if motions and all(same_vertical(motion.R_map_vehicle, motions[0].R_map_vehicle) for motion in motions):
            assumed = "if it does not measure them, those of a car are assumed (fuse.errors.vehicle_tilt_deg_per_mps2)"
            yield ok(f"{source.name} tilt", f"its roll and pitch do not change: {assumed}")


def odometry_check(source: ObservedSource, link: VehicleOdometry) -> CheckResult:
    """The result of one vehicle odometry source."""
    if source.live and link.settings.port is None:
        return warning(source.name, "no port is set: the vehicle is assumed parked")
    records = source.observation.records
    if not records.count:
        text = f"{source.no_data_reason}: the vehicle would be assumed parked"
        return fail(source.name, f"{text}; start it, or set port: null") if source.live else warning(source.name, text)
    rejected, age_ms = sum(source.counters.rejected.values()), 1e-6 * records.max_age_ns
    text = f"{records.rate_hz:.0f} poses/s, at most {age_ms:.0f} ms old" + (
        f", {rejected} rejected" if rejected else ""
    )
    if rejected >= records.count:
        return fail(source.name, f"{text}: none is a valid pose (recordings/README.md, /vehicle/odometry)")
    silent_s = records.longest_silence_s(source.end_ns)
    if source.live and silent_s > ODOMETRY_SILENT_S:
        return fail(source.name, f"{text}; then none for {silent_s:.1f} s: is its sender still running?")
    if not records.rate_hz >= ODOMETRY_HZ or age_ms > OLD_MS or rejected:
        return warning(source.name, f"{text}: check its rate, its age_s and its clock")
    return ok(source.name, text)
