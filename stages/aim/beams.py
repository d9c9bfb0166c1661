"""Turntable angle at which one beam of the LiDAR's fan points at a position, and the time at which the rotor passes it.

    n . (Rz(-theta) p - o) = d sin(w)        n = R_turntable_lidar e_z, o the LiDAR's origin, d = |Rz(-theta) p - o|

A beam with elevation w over the scan plane lies on a cone about the spin axis n. The beams of a VLP-16 are 2 deg apart
and none lies in the middle of the fan: a fan that is centred on a small drone misses it. A beam that is pointed at the
drone gives 2 to 4 times the returns.

Source: ours; the plane w = 0 is that of P III.C.
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
    """Azimuth and rate of the LiDAR's rotor, predicted with constant rate; with the lasers' offsets and delays."""

    azimuth_offset_rad: tuple[float, ...]
    azimuth_delay_ns: tuple[int, ...]
    stamp_ns: int = 0
    azimuth_rad: float = 0.0
    rate_radps: float = 0.0

    def next_pass_ns(self, azimuth_rad: float, after_ns: int) -> int:
        """First time at or after `after_ns` at which the rotor points along an azimuth."""
        predicted_rad = (self.azimuth_rad + self.rate_radps * (after_ns - self.stamp_ns) * 1e-9) % math.tau
        return after_ns + round(((azimuth_rad - predicted_rad) % math.tau) / self.rate_radps * 1e9)

    def update(self, firings: LidarFirings) -> None:
        """Update the azimuth with the last pulse of a packet, and the low-pass filtered rate."""
        n = firings.pulse_stamp_ns.size
        if n < 2:
            return
        first, last = int(firings.laser[0]), int(firings.laser[-1])
        stamp_ns = int(firings.pulse_stamp_ns[-1]) - self.azimuth_delay_ns[last]
        azimuth = float(firings.azimuth_rad[-1]) - self.azimuth_offset_rad[last]
        first_azimuth = float(firings.azimuth_rad[0]) - self.azimuth_offset_rad[first]
        dt = (stamp_ns - (int(firings.pulse_stamp_ns[0]) - self.azimuth_delay_ns[first])) * 1e-9
        rate = ((azimuth - first_azimuth) % math.tau) / dt if dt > 0 else 0.0
        if rate > 0:
            self.rate_radps = rate if self.rate_radps == 0 else self.rate_radps + 0.05 * (rate - self.rate_radps)
        self.stamp_ns, self.azimuth_rad = stamp_ns, azimuth


class Pointing(NamedTuple):
    """Position of servo and turntable for an observation of a position."""

    servo_rad: float
    table_rad: float
    beam: int  # index of its elevation; -1: no beam meets the position, this is the nearest pointing


def table_angles_rad(T_turntable_lidar: Array64, p_turntable_m: Array64, elevation_rad: float) -> tuple[float, ...]:
    """Turntable angles in [0, 2 pi) at which a beam of this elevation meets a point (3,); empty if there is none."""
    n, o = T_turntable_lidar[:3, 2].tolist(), T_turntable_lidar[:3, 3].tolist()  # Python's floats are faster here
    n_o = float(T_turntable_lidar[:3, 2] @ T_turntable_lidar[:3, 3])
    x, y, z = p_turntable_m.tolist()
    m, rho = math.hypot(n[0], n[1]), math.hypot(x, y)
    if m * rho < 1e-9:
        return ()
    middle = math.atan2(y, x) - math.atan2(n[1], n[0])
    found: list[float] = []
    for side in (-1.0, 1.0):
        d = math.sqrt(rho * rho + (z - o[2]) ** 2)  # for o = 0; refined below
        theta = math.nan
        for _ in range(2):
            cosine = (n_o - n[2] * z + d * math.sin(elevation_rad)) / (m * rho)
            if abs(cosine) > 1.0:
                theta = math.nan
                break
            theta = middle + side * math.acos(cosine)
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
    """Rotor azimuth [0, 2 pi) that points at a position, with the table at theta. 0 at +y_lidar, towards +x_lidar."""
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    x, y, z = p_turntable_m
    turned = np.array([c * x + s * y, -s * x + c * y, z]) - T_turntable_lidar[:3, 3]
    lidar = T_turntable_lidar[:3, :3].T @ turned
    return math.atan2(lidar[0], lidar[1]) % math.tau


def best_pointing(
    mount: LidarMount,
    travel_rad: tuple[float, float],
    elevations_rad: tuple[float, ...],
    start_rad: float,
    p_turntable_m: Array64,
    offset_rad: float,
    inner_rad: float,
) -> Pointing | None:
    """The beam of least cost that points `offset_rad` off a position (3,), or None if no beam can.

    The cost is the servo's movement from `start_rad` plus a cost of the beam's elevation. The latter grows faster
    beyond `inner_rad`: a drone that moves on past the outermost beam gives no returns.
    """
    T = mount.T_turntable_lidar.matrix()
    best, least = None, math.inf
    for beam, w in enumerate(elevations_rad):
        elevation_cost = 0.5 * abs(w) + 3.0 * max(abs(w) - inner_rad, 0.0)
        if elevation_cost >= least:
            continue
        for theta in table_angles_rad(T, p_turntable_m, w + offset_rad):
            for servo in servo_positions_rad(mount, theta, travel_rad):
                cost = abs(servo - start_rad) + elevation_cost
                if cost < least:
                    best, least = Pointing(servo, theta, beam), cost
    return best


def nearest_pointing(mount: LidarMount, travel_rad: tuple[float, float], p_turntable_m: Array64) -> Pointing | None:
    """The middle of the fan as near to a position (3,) as the travel allows; None on the turntable's axis."""
    best, least = None, math.inf
    for theta in table_angles_rad(mount.T_turntable_lidar.matrix(), p_turntable_m, 0.0):
        for turn in (-math.tau, 0.0, math.tau):
            servo = mount.servo_rad(theta) + turn
            clipped = min(max(servo, travel_rad[0]), travel_rad[1])
            if abs(clipped - servo) < least:
                best, least = Pointing(clipped, theta, -1), abs(clipped - servo)
    return best


def low_discrepancy(k: int) -> float:
    """The k-th member of the van der Corput sequence in base 2, scaled to (-1, 1)."""
    value, digit = 0.0, 0.5
    k += 1
    while k:
        value += digit * (k & 1)
        k >>= 1
        digit *= 0.5
    return 2.0 * value - 1.0


def sweep_step_rad(spacing_rad: float, wanted_rad: float) -> float:
    """Step of the table per rotor turn, near `wanted_rad`, at which the beams cover all directions.

    After k turns the beams, `spacing_rad` apart, have moved by k steps. If step and spacing have a simple ratio, the
    beams repeat the same directions and never cover those between (aliasing). The step is a whole number of spacings
    plus the golden ratio of one, whose multiples are spread most evenly.
    """
    golden = (math.sqrt(5.0) - 1.0) / 2.0
    whole = max(round(wanted_rad / spacing_rad - golden), 0)
    return (whole + golden) * spacing_rad
