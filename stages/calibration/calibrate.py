"""Self-calibration: estimates the LiDAR's mount from returns and servo states, or states why it cannot.

Source: ours; issue 7, point 5: planes seen twice must coincide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.calibration.columns import Placed, place
from stages.calibration.motion import drift, shift
from stages.calibration.patches import Patches, thickness_m
from stages.calibration.result import CURVE, Finding, Travel, accepted, assess, curve_sigmas
from stages.calibration.scan_passes import Returns, ServoTrace, servo_at
from stages.calibration.servo_mount import ServoMount, lidar_mount, servo_mount
from stages.calibration.solve import COARSE_RAD, Solution, linearise, solve
from stages.geometry.frames import Array64, LidarMount

LEAST_TRAVEL_RAD = math.radians(40.0)  # the fan is 30 deg wide: with less, no surface is observed at two angles
STILL_RAD = math.radians(0.5)  # apparent motion from encoder steps
FEWEST_RETURNS = 2_000
FEWEST_PATCHES = 30
MOVED_M, TURNED_RAD = 0.03, math.radians(0.1)  # over the whole time; a smaller motion is negligible


class CannotCalibrate(Exception):
    """The recording cannot be used for calibration; the text states the reason and the remedy."""


@dataclass(frozen=True)
class Thickness:
    """RMS distance of the returns from their patch (m,) [m], before and after, and the patch's range (m,) [m]."""

    before_m: Array64
    after_m: Array64
    range_m: Array64

    @property
    def medians_m(self) -> tuple[float, float]:
        """Medians over the patches, before and after."""
        return float(np.median(self.before_m)), float(np.median(self.after_m))


ZERO_SIGMA_DEG = 0.1  # zero against the vehicle's axes, not observable by a sweep: 2 mm in a metre


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration: the mount, its findings and its uncertainty."""

    mount: LidarMount  # the rig with the accepted parameters
    findings: tuple[Finding, ...]
    covariance: Array64  # of all PARAMETERS, SI units
    curve_sigma_rad: float  # of the encoder's error over the sweep, without its mean
    curve_mean_sigma_rad: float  # of that mean, which is not separable from a zero
    travel: Travel
    thickness: Thickness
    before: Placed  # the returns of all patches under the rig
    after: Placed  # the same under the mount found
    patches: Patches
    numbers: ServoMount  # the mount found, as it is written


def calibrate(
    returns: Returns, trace: ServoTrace, rig: LidarMount, *, parked: bool = False, max_gap_s: float = 0.1
) -> Calibration:
    """Estimate the LiDAR's mount on its servo. Raises CannotCalibrate when no estimate is possible.

    `parked`: the vehicle is known to have stood still. A servo that sweeps in both directions does not need it.
    """
    _check_inputs(returns, trace, rig)
    numbers = servo_mount(rig)
    at = servo_at(trace, returns.stamp_ns, numbers, max_gap_s)
    if not np.isfinite(at.position_rad).any():
        raise CannotCalibrate("no pulse of the LiDAR is between two servo states: were both stamped by one clock?")
    travel = Travel.of(at.position_rad, at.rate_radps)
    _check_travel(travel.angle_rad)
    if not (travel.both_ways or parked):
        raise CannotCalibrate(
            "the servo turned one way only, which does not show whether the vehicle stood still: sweep there and back, "
            "or pass --parked if it did"
        )
    solution = solve(returns, trace, numbers, max_gap_s)
    _check_still(returns, trace, numbers, solution, travel.both_ways, max_gap_s)
    if solution is None or len(solution.system.patches.first) < FEWEST_PATCHES:
        raise CannotCalibrate("too few flat surfaces were observed more than once: park near walls")
    findings = assess(numbers, solution.mount, solution.covariance, travel)
    written = accepted(numbers, solution.mount, findings, solution.covariance, travel)
    curve_rad, mean_rad = curve_sigmas(solution.covariance, travel)
    chosen = solution.system.chosen
    on_patches = Returns(returns.stamp_ns[chosen], returns.laser[chosen], returns.xyz_lidar_m[chosen], returns.lasers)
    before, after = (
        place(on_patches, servo_at(trace, on_patches.stamp_ns, mount, max_gap_s), mount, solution.bias_m)
        for mount in (numbers, written)
    )
    patches = solution.system.patches
    centre = patches.centre_m
    mount = lidar_mount(written, rig)
    if {f.name for f in findings if not f.rejected}.issuperset({*CURVE, "play"}):
        pointing_deg = math.hypot(ZERO_SIGMA_DEG, math.degrees(curve_rad), math.degrees(mean_rad))
        mount = mount.model_copy(update={"pointing_sigma_deg": pointing_deg})
    return Calibration(
        mount=mount,
        findings=findings,
        covariance=solution.covariance,
        curve_sigma_rad=curve_rad,
        curve_mean_sigma_rad=mean_rad,
        travel=travel,
        thickness=Thickness(
            thickness_m(before.xyz_m, patches), thickness_m(after.xyz_m, patches), np.linalg.norm(centre, axis=1)
        ),
        before=before,
        after=after,
        patches=patches,
        numbers=written,
    )


def _check_inputs(returns: Returns, trace: ServoTrace, rig: LidarMount) -> None:
    """Raise CannotCalibrate unless a turning LiDAR returned enough pulses."""
    if not rig.turns:
        raise CannotCalibrate("the rig has a fixed LiDAR (turns: false): there is no servo mount")
    if len(trace.stamp_ns) < 2:
        raise CannotCalibrate(
            "the recording contains no servo states: a LiDAR that does not turn observes no surface twice"
        )
    if len(returns.stamp_ns) < FEWEST_RETURNS:
        raise CannotCalibrate(
            f"the LiDAR returned {len(returns.stamp_ns)} pulses, at least {FEWEST_RETURNS} are needed: was it running?"
        )
    _check_travel(float(np.ptp(trace.position_rad)))  # first: the side of the play is not known for a servo at rest


def _check_travel(angle_rad: float) -> None:
    """Raise CannotCalibrate if the servo turned too little."""
    if angle_rad < LEAST_TRAVEL_RAD:
        turned = f"turned by {math.degrees(angle_rad):.0f} deg only" if angle_rad > STILL_RAD else "stood still"
        raise CannotCalibrate(
            f"the servo {turned}, at least {math.degrees(LEAST_TRAVEL_RAD):.0f} deg are needed: record while it "
            "sweeps, best from end to end and back at two speeds"
        )


def _check_still(
    returns: Returns, trace: ServoTrace, rig: ServoMount, solution: Solution | None, both_ways: bool, max_gap_s: float
) -> None:
    """Raise CannotCalibrate if the vehicle moved, under the mount found or, without one, the rig's."""
    mount, bias_m = (solution.mount, solution.bias_m) if solution else (rig, np.zeros(returns.lasers))
    placed = place(returns, servo_at(trace, returns.stamp_ns, mount, max_gap_s), mount, bias_m)
    between = None if not both_ways else shift(placed.xyz_m, returns.stamp_ns)
    system = linearise(returns, trace, mount, bias_m, COARSE_RAD[0], max_gap_s)
    steady = drift(system, returns) if system and solution else None
    how = ""
    if between is not None and between.moved:
        how = "upright objects had moved when they were observed again"
    elif steady is not None and (steady.moved_m > MOVED_M or steady.turned_rad > TURNED_RAD):
        how = f"surfaces fit a drive by {steady.moved_m:.2f} m and a turn by {math.degrees(steady.turned_rad):.2f} deg"
    if how:
        raise CannotCalibrate(
            f"the vehicle did not stand still: {how}. Take a recording of a parked vehicle, or a part of this one "
            "in which it stands (--from, --to)"
        )
