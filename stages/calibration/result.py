"""Acceptance of a calibration's parameters: which of them are written to the rig, and why the others are not.

A parameter is accepted when its sigma is below its limit. A rejected one keeps the rig's value; since all parameters
were estimated together, the accepted ones do not depend on it. The encoder error is accepted as one curve over the
swept angles: its terms are not separable over half a turn, and its mean there is not separable from the zero.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.calibration.parameters import PARAMETERS
from stages.calibration.servo_mount import ORDERS, ServoMount
from stages.calibration.solve import NAMES
from stages.geometry.frames import Array64

CURVE = tuple(f"{part}_{order}" for order in ORDERS for part in ("sin", "cos"))
CURVE_LIMIT_RAD = math.radians(0.03)  # limit for the RMS sigma of the curve over the sweep, without its mean
BLIND = 0.5  # of the prior sigma: a parameter with a larger sigma was not observed
ALIKE = 0.9  # correlation of two parameters that the sweep cannot separate
CURVE_POINTS = 181
SAME_SPEED = 1.5  # speeds within this factor count as one
MANY = 0.02  # least share of the moving time for a speed or direction to count as used


@dataclass(frozen=True)
class Finding:
    """One parameter before and after, in its unit; `rejected` states why it keeps its value, empty if accepted."""

    name: str
    what: str
    unit: str
    before: float
    after: float
    sigma: float
    rejected: str = ""


@dataclass(frozen=True)
class Travel:
    """Range, directions and speeds of the servo's motion."""

    low_rad: float
    high_rad: float
    both_ways: bool
    two_speeds: bool

    @staticmethod
    def of(position_rad: Array64, rate_radps: Array64) -> Travel:
        """From the positions and rates at the returns (n,)."""
        known = np.isfinite(position_rad)
        position, rate = position_rad[known], rate_radps[known]
        speed = np.abs(rate)
        moving = speed > 0.05 * max(float(speed.max(initial=0.0)), 1e-9)
        up, down = float((rate[moving] > 0).mean()), float((rate[moving] < 0).mean())
        slow, fast = np.quantile(speed[moving], [MANY + 0.1, 1 - MANY]).tolist()
        return Travel(
            low_rad=float(position.min()),
            high_rad=float(position.max()),
            both_ways=min(up, down) > MANY,
            two_speeds=fast > SAME_SPEED * slow,
        )

    @property
    def angle_rad(self) -> float:
        """Angle between the ends."""
        return self.high_rad - self.low_rad


def curve_rows(travel: Travel) -> Array64:
    """Basis (CURVE_POINTS, 4) of the encoder error curve over the sweep, one column per term of CURVE."""
    at = np.linspace(travel.low_rad, travel.high_rad, CURVE_POINTS)
    return np.column_stack([f(order * at) for order in ORDERS for f in (np.sin, np.cos)])


def curve_sigmas(covariance: Array64, travel: Travel) -> tuple[float, float]:
    """Sigma [rad] of the curve without its mean (root mean square over the sweep), and of its mean."""
    rows = curve_rows(travel)
    chosen = [NAMES.index(name) for name in CURVE]
    inner = covariance[np.ix_(chosen, chosen)]
    mean = rows.mean(axis=0)
    varying = rows - mean
    return math.sqrt(float(np.einsum("ij,jk,ik->i", varying, inner, varying).mean())), math.sqrt(
        float(mean @ inner @ mean)
    )


def assess(rig: ServoMount, found: ServoMount, covariance: Array64, travel: Travel) -> tuple[Finding, ...]:
    """A finding for each of PARAMETERS; those of CURVE are accepted or rejected together."""
    before, after = values_of(rig, rig), values_of(found, rig)
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    curve_rad, _ = curve_sigmas(covariance, travel)
    blind = unseen(travel)
    findings: list[Finding] = []
    for i, parameter in enumerate(PARAMETERS):
        if parameter.name in CURVE:
            accepted = curve_rad < CURVE_LIMIT_RAD
            limit = f"the curve's sigma is {math.degrees(curve_rad):.3f} deg, more than 0.03 deg"
        elif parameter.name in blind:
            accepted, sigma[i] = False, parameter.expected * parameter.per_unit
            limit = f"its sigma is assumed to be {parameter.expected:g} {parameter.unit}"
        else:
            accepted = sigma[i] < parameter.limit * parameter.per_unit
            sigma_unit = sigma[i] / parameter.per_unit
            limit = f"sigma is {sigma_unit:.3g} {parameter.unit}, more than {parameter.limit:g} {parameter.unit}"
        rejected = "" if accepted else f"{blind.get(parameter.name) or _why(i, sigma, correlation)} ({limit})"
        scale = 1 / parameter.per_unit
        findings.append(
            Finding(
                parameter.name,
                parameter.what,
                parameter.unit,
                before[parameter.name] * scale,
                (after if accepted else before)[parameter.name] * scale,
                float(sigma[i]) * scale,
                rejected,
            )
        )
    return tuple(findings)


def values_of(mount: ServoMount, rig: ServoMount) -> dict[str, float]:
    """Values of PARAMETERS in SI units; tilts are relative to the rig's LiDAR, offsets to the servo axis."""
    tilt = mount.R_turntable_lidar @ rig.R_turntable_lidar.T
    terms = {
        f"{part}_{order}": mount.sin_cos_rad.get(order, (0.0, 0.0))[side]
        for order in ORDERS
        for side, part in enumerate(("sin", "cos"))
    }
    return {
        "tilt_x": float(tilt[2, 1] - tilt[1, 2]) / 2,
        "tilt_y": float(tilt[0, 2] - tilt[2, 0]) / 2,
        "axis_x": float(mount.t_turntable_lidar_m[0]),
        "axis_y": float(mount.t_turntable_lidar_m[1]),
        **terms,
        "play": mount.play_rad,
        "time": mount.time_offset_s,
        "zero": mount.zero_rad,
    }


def accepted(
    rig: ServoMount, found: ServoMount, findings: tuple[Finding, ...], covariance: Array64, travel: Travel
) -> ServoMount:
    """The rig with the accepted parameters.

    The mean of the encoder error over the sweep acts as a zero offset. Where that mean is not well known, the zero
    compensates it, so that the mean direction of the sweep does not change.
    """
    before, after = values_of(rig, rig), values_of(found, rig)
    names = {f.name for f in findings if not f.rejected}
    step = {name: after[name] - before[name] for name in NAMES if name in names}
    step["play"] = max(step.get("play", 0.0), -before["play"])  # no negative play
    _, mean_sigma = curve_sigmas(covariance, travel)
    limit = next(p.limit * p.per_unit for p in PARAMETERS if p.name == "zero")
    if names.issuperset(CURVE) and "zero" not in names and mean_sigma > limit:
        turn = float(curve_rows(travel).mean(axis=0) @ np.array([step[name] for name in CURVE]))
        step["zero"] = -rig.sign * turn
    return rig.moved(step)


def unseen(travel: Travel) -> dict[str, str]:
    """Parameters that are unobservable with such a servo motion, each with the reason and the remedy.

    The few milliseconds in which a servo starts and stops do not count as a second speed: the time offset would be
    estimated from its braking.
    """
    found = {
        "zero": "a rotation about the servo's axis leaves every surface thin, so no scene determines it: "
        "measure it at the vehicle, or park parallel to a wall and pass --parallel"
    }
    if not travel.both_ways:
        found["time"] = (
            "the servo turned one way only, so a time offset is not separable from the zero: sweep there and back"
        )
        found["play"] = "the servo turned one way only, so the side of the play never changed: sweep there and back"
    elif not travel.two_speeds:
        found["time"] = found["play"] = (
            "the servo turned at one speed only, so a time offset and the play of the gear are not separable: sweep at "
            "a second speed, or vibrate"
        )
    return found


def _why(i: int, sigma: Array64, correlation: Array64) -> str:
    """The reason why the scene does not determine a parameter."""
    if sigma[i] > BLIND * PARAMETERS[i].expected * PARAMETERS[i].per_unit:
        if NAMES[i] in ("play", "time", *CURVE):
            return (
                "too few upright surfaces were observed more than once, and level ground does not determine a rotation"
            )
        return "the surfaces observed more than once do not determine it: walls in two directions are needed"
    other = max((k for k in range(len(NAMES)) if k != i), key=lambda k: abs(float(correlation[i, k])))
    if abs(float(correlation[i, other])) > ALIKE:
        return f"in this scene it is not separable from the {PARAMETERS[other].what}"
    return "too few surfaces were observed more than once from angles that determine it"
