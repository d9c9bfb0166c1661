"""Where the turntable must stand for one beam of the fan to point at a place, and when the rotor passes there.

    n . (Rz(-theta) p - o) = d sin(w)        n = R_turntable_lidar e_z, o the LiDAR's origin, d = |Rz(-theta) p - o|

A beam of elevation w over the scan plane lies on a cone about the spin axis n. Between the beams of a VLP-16 are 2 deg
of nothing, and none lies in the middle: a fan that is centred on a small drone misses it.

Source: ours; DESIGN, "putting a *beam* on the drone ... gives 2-4x the returns"; the plane w = 0 is P III.C's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64, LidarMount
from stages.messages import LidarFirings


@dataclass(slots=True, eq=False)
class Rotor:
    """Where the rotor is and how fast it turns."""

    stamp_ns: int = 0
    azimuth_rad: float = 0.0
    rate_radps: float = 0.0

    def next_pass_ns(self, azimuth_rad: float, after_ns: int) -> int:
        """When it looks along an azimuth first after a time."""
        at = (self.azimuth_rad + self.rate_radps * (after_ns - self.stamp_ns) * 1e-9) % math.tau
        return after_ns + round(((azimuth_rad - at) % math.tau) / self.rate_radps * 1e9)

    def hear(self, firings: LidarFirings) -> None:
        """What a packet tells of it."""
        n = firings.pulse_stamp_ns.size
        if n < 2:
            return
        stamp_ns, azimuth = int(firings.pulse_stamp_ns[-1]), float(firings.azimuth_rad[-1])
        dt = (stamp_ns - int(firings.pulse_stamp_ns[0])) * 1e-9
        rate = ((azimuth - float(firings.azimuth_rad[0])) % math.tau) / dt if dt > 0 else 0.0
        if rate > 0:
            self.rate_radps = rate if self.rate_radps == 0 else self.rate_radps + 0.05 * (rate - self.rate_radps)
        self.stamp_ns, self.azimuth_rad = stamp_ns, azimuth


class Pointing(NamedTuple):
    """How a place is looked at."""

    servo_rad: float
    table_rad: float
    beam: int  # index of its elevation; -1: none meets it, the table stands as near as it gets


def table_angles_rad(T_turntable_lidar: Array64, p_turntable_m: Array64, elevation_rad: float) -> tuple[float, ...]:
    """Turntable angles in [0, 2 pi) at which a beam of this elevation meets a point (3,); none when it never does."""
    n, o = T_turntable_lidar[:3, 2].tolist(), T_turntable_lidar[:3, 3].tolist()  # Python's floats are faster here
    n_o = float(T_turntable_lidar[:3, 2] @ T_turntable_lidar[:3, 3])
    x, y, z = p_turntable_m.tolist()
    m, rho = math.hypot(n[0], n[1]), math.hypot(x, y)
    if m * rho < 1e-9:
        return ()
    middle = math.atan2(y, x) - math.atan2(n[1], n[0])
    found: list[float] = []
    for side in (-1.0, 1.0):
        d = math.sqrt(rho * rho + (z - o[2]) ** 2)  # |o| is small beside it; refined below
        theta = math.nan
        for _ in range(2):
            share = (n_o - n[2] * z + d * math.sin(elevation_rad)) / (m * rho)
            if abs(share) > 1.0:
                theta = math.nan
                break
            theta = middle + side * math.acos(share)
            c, s = math.cos(theta), math.sin(theta)
            d = math.sqrt((c * x + s * y - o[0]) ** 2 + (-s * x + c * y - o[1]) ** 2 + (z - o[2]) ** 2)
        if not math.isnan(theta):
            found.append(theta % math.tau)
    return tuple(found)


def servo_positions_rad(mount: LidarMount, theta_rad: float, travel_rad: tuple[float, float]) -> list[float]:
    """Servo positions within the travel that turn the table to theta."""
    servo = mount.servo_rad(theta_rad)
    first = servo + math.tau * math.ceil((travel_rad[0] - servo) / math.tau)
    return [s for s in (first, first + math.tau) if s <= travel_rad[1]]


def rotor_azimuth_rad(T_turntable_lidar: Array64, p_turntable_m: Array64, theta_rad: float) -> float:
    """The rotor's azimuth [0, 2 pi) at which it looks at a point, the table at theta. 0 along +y_lidar, towards +x."""
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    x, y, z = p_turntable_m
    turned = np.array([c * x + s * y, -s * x + c * y, z]) - T_turntable_lidar[:3, 3]
    lidar = T_turntable_lidar[:3, :3].T @ turned
    return math.atan2(lidar[0], lidar[1]) % math.tau


def cheapest(
    mount: LidarMount,
    travel_rad: tuple[float, float],
    elevations_rad: tuple[float, ...],
    at_rad: float,
    place_m: Array64,
    offset_rad: float,
    inner_rad: float,
) -> Pointing | None:
    """Which beam is best put `offset_rad` beside a place (3,), turntable frame, from a servo position; None: none can.

    Beams farther out than inner_rad are dear: beyond the last one nothing is seen of a drone that flies on.
    """
    T = mount.T_turntable_lidar.matrix()
    best, least = None, math.inf
    for beam, w in enumerate(elevations_rad):
        far_out = 0.5 * abs(w) + 3.0 * max(abs(w) - inner_rad, 0.0)
        if far_out >= least:  # however near it is
            continue
        for theta in table_angles_rad(T, place_m, w + offset_rad):
            for servo in servo_positions_rad(mount, theta, travel_rad):
                cost = abs(servo - at_rad) + far_out
                if cost < least:
                    best, least = Pointing(servo, theta, beam), cost
    return best


def nearest(mount: LidarMount, travel_rad: tuple[float, float], place_m: Array64) -> Pointing | None:
    """The middle of the fan as near to a place (3,) as the travel allows: nearly on the axis, or just beyond."""
    best, least = None, math.inf
    for theta in table_angles_rad(mount.T_turntable_lidar.matrix(), place_m, 0.0):
        for turn in (-math.tau, 0.0, math.tau):
            servo = mount.servo_rad(theta) + turn
            kept = min(max(servo, travel_rad[0]), travel_rad[1])
            if abs(kept - servo) < least:
                best, least = Pointing(kept, theta, -1), abs(kept - servo)
    return best


def low_discrepancy(k: int) -> float:
    """The k-th of a sequence that fills (-1, 1) evenly from its first members on: van der Corput's, base 2."""
    value, share = 0.0, 0.5
    k += 1
    while k:
        value += share * (k & 1)
        k >>= 1
        share *= 0.5
    return 2.0 * value - 1.0


def sweep_step_rad(spacing_rad: float, wanted_rad: float) -> float:
    """A step of the table per turn of the rotor near `wanted_rad` that never lets beams fall on beams.

    The fan's beams lie `spacing_rad` apart. After k turns they have moved by k steps; when steps and spacing have a
    simple ratio, the same directions are looked at again and those between never (beat blindness). The step's part
    beyond whole spacings is the golden section here, whose multiples spread best.
    """
    golden = (math.sqrt(5.0) - 1.0) / 2.0
    whole = max(round(wanted_rad / spacing_rad - golden), 0)
    return (whole + golden) * spacing_rad
