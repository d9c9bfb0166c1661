"""A PointCloud2 with a time per point as the packets of its LiDAR, so that replay knows where nothing returned.

A point's ring names its beam and its time its firing sequence. The sequences between the first and the last point of a
cloud, and between two clouds, are filled with pulses without return: a gap in the data looks like open sky. The packets
hold ranges in the sensor's unit and azimuths within 0.005 deg; of several returns of a pulse the first is kept.

    horizontal distance of a beam from its origin: l = -o cos(a) + sqrt(rho^2 - o^2 sin(a)^2), o: origin's distance from
    the axis, a: azimuth offset, rho: the point's distance from the axis; range = hypot(l, z - z_offset) + o

A cloud that does not lie on the beams of the rig's model, or that does not turn steadily (motion-compensated, or in the
axes of another frame), is refused.

Source: ours; fields of velodyne_pointcloud, hesai_ros_driver, nebula and ouster-ros.
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.simulated.sensors.lidar_packets import PacketEncoder
from stages.geometry.rig_lidar import RigLidar

Axes = Literal["sensor", "ros"]
Array = NDArray[np.float64]

RINGS, TIMES = ("ring", "channel"), ("time", "t", "timestamp", "time_stamp")
REFLECTIVITIES = ("reflectivity", "intensity")
FAR_M = 2.0  # nearer points do not show which beam they are of
MIN_FAR = 30  # points, to know the order of the rings
MAX_WRONG = 0.1  # share of the points that are not on their beam
MAX_TURN_ERROR_RAD = math.radians(1.0)  # median of the columns' azimuths against a steady rotation
MAX_SPAN_NS = 1_000_000_000  # of the times in one cloud
MAX_GAP_NS = 60_000_000  # between two clouds; longer: packets are missing
MAX_TIME_S = 4e9  # of damaged times; in ns it fits 64 bits
RETURNS = 3  # of a pulse, at most
_NO_TIMES = (
    ": the drone would be smeared over a turn of the sensor. Record the packets, or set the driver to publish a time "
    "per point"
)
_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}


class CloudEncoder:
    """Packets of consecutive clouds of one LiDAR."""

    def __init__(self, unit: RigLidar, axes: Axes | None, topic: str) -> None:
        self._profile = profile = unit.profile
        self._encoder = PacketEncoder(unit, "strongest")
        self._sequence_ns = self._encoder.sequence_ns
        self._topic = topic
        self._axes = axes or ("ros" if profile.product_id is not None else "sensor")
        count = profile.lasers
        self._elevation = np.radians(unit.beams.elevation_deg if unit.beams else profile.elevation_deg)
        self._offset = np.array(unit.azimuth_offset_rad)
        self._z_offset_m = 1e-3 * np.array(profile.vertical_offset_mm or (0.0,) * count)
        self._origin_m = 1e-3 * unit.beams.origin_mm if unit.beams else 0.0
        self._delay_ns = np.array(profile.firing_ns, dtype=np.int64)
        self._columns_per_turn = unit.beams.columns if unit.beams and unit.model.startswith("OS") else 0
        self._first_column = self._last_column = 0  # of an Ouster: of this cloud, and of the waiting sequences
        self._epoch_ns = 0  # times of sequences count from it
        self._waiting = _Sequences(np.zeros(0), np.zeros(0), np.zeros((0, count, 2)))  # they do not fill a packet yet
        self._order: NDArray[np.int64] | None = None  # laser of each ring; None: not known yet
        self.second_returns = 0
        self.clouds_without_order = 0
        """Clouds that were skipped because the order of the rings was not known yet."""

    def packets(self, cloud: Any, stamp_ns: int) -> list[tuple[int, bytes]]:
        """(time of the first pulse, payload) of the packets that this cloud completes. LinkError if it does not fit."""
        points = self._points(cloud, stamp_ns)
        if points is None:
            return []
        xyz, ring, at_ns, shade = points
        span_ns = int(at_ns[-1]) - int(at_ns[0])
        if span_ns == 0 and len(at_ns) > RETURNS * self._profile.lasers:
            raise LinkError(f"{self._topic}: all points of a cloud have the same time{_NO_TIMES}")
        if span_ns > MAX_SPAN_NS:
            raise LinkError(
                f"{self._topic}: the times of the points in one cloud span {span_ns * 1e-9:.1f} s: times are damaged, "
                "or in another unit than s (floats) or ns (integers): remove this topic from the mapping file and "
                "import the packets, or correct the bag"
            )
        order = self._lasers(xyz, ring)
        if order is None:
            self.clouds_without_order += 1
            return []
        laser = order[ring]
        range_m, azimuth = self._beams(xyz, laser)
        number, start_ns = self._numbers(azimuth, at_ns, laser)
        turn_ns = self._delay_ns[laser] if self._profile.turns_while_firing else np.zeros(len(laser))
        pulses = np.zeros((number.max() + 1, self._profile.lasers, 2))
        first = np.unique(number * self._profile.lasers + laser, return_index=True)[1]
        self.second_returns += len(laser) - len(first)
        pulses[number[first], laser[first], 0] = range_m[first]
        pulses[number[first], laser[first], 1] = shade[first]
        self._epoch_ns = self._epoch_ns or int(start_ns[0])
        times_ns = _filled(number, (start_ns - self._epoch_ns).astype(np.float64))
        self._append(_Sequences(times_ns, self._rotation(azimuth, number, laser, turn_ns), pulses))
        if self._columns_per_turn:
            self._last_column = (self._first_column + int(number.max())) % self._columns_per_turn
        return self._full_packets()

    def _points(
        self, cloud: Any, stamp_ns: int
    ) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]] | None:
        """xyz in the lidar frame (N, 3), ring, time [ns] and reflectivity of the points that returned, by time."""
        fields = {str(field.name): field for field in cloud.fields}
        ring_name, time_name = (next((n for n in names if n in fields), None) for names in (RINGS, TIMES))
        if time_name is None:
            raise LinkError(f"{self._topic}: its points have no time (fields: {', '.join(fields)}){_NO_TIMES}")
        if ring_name is None or not {"x", "y", "z"} <= fields.keys():
            missing = [n for n in ("x", "y", "z", *(["ring"] if ring_name is None else [])) if n not in fields]
            raise LinkError(
                f"{self._topic}: its points have no {', '.join(missing)} (fields: {', '.join(fields)}), so that their "
                "beams are unknown. Record the packets, or set the driver to publish the ring of each point"
            )
        shade_name = next((n for n in REFLECTIVITIES if n in fields), None)
        names = ["x", "y", "z", ring_name, time_name, *([shade_name] if shade_name else [])]
        bad = [n for n in names if fields[n].count != 1 or fields[n].datatype not in _TYPES]
        points = int(cloud.width) * int(cloud.height)
        if bad or cloud.is_bigendian or cloud.point_step <= 0 or len(cloud.data) < points * cloud.point_step:
            raise LinkError(f"{self._topic}: a cloud that cannot be read (fields: {', '.join(bad or fields)})")
        kind = np.dtype(
            {
                "names": names,
                "formats": [_TYPES[fields[n].datatype] for n in names],
                "offsets": [fields[n].offset for n in names],
                "itemsize": cloud.point_step,
            }
        )
        table = np.frombuffer(np.asarray(cloud.data).tobytes(), kind, points)
        xyz = np.stack([table[n].astype(np.float64) for n in "xyz"], axis=1)
        times = self._times(table[time_name], stamp_ns)
        good = np.isfinite(xyz).all(1) & (np.abs(xyz) > 0).any(1) & np.isfinite(table[time_name])
        if not good.any():
            return None
        order = np.flatnonzero(good)[np.argsort(times[good], kind="stable")]
        if cloud.header.frame_id == "os_sensor":
            xyz = xyz * (-1.0, -1.0, 1.0) - (0.0, 0.0, 0.036180)  # ouster-ros: os_lidar in os_sensor
        elif self._axes == "ros":
            xyz = np.stack([-xyz[:, 1], xyz[:, 0], xyz[:, 2]], axis=1)
        ring = table[ring_name].astype(np.int64)
        shade = table[shade_name].astype(np.float64) if shade_name else np.zeros(points)
        shade = np.clip(np.nan_to_num(shade), 0, 255).astype(np.int64)
        return xyz[order], ring[order], times[order], shade[order]

    @staticmethod
    def _times(values: NDArray[Any], stamp_ns: int) -> NDArray[np.int64]:
        """Absolute times: integers are ns after the cloud's stamp, floats s after it or, above 1e6, s since 1970."""
        if values.dtype.kind != "f":
            return stamp_ns + values.astype(np.int64)
        finite = np.clip(np.nan_to_num(values.astype(np.float64)), -MAX_TIME_S, MAX_TIME_S)
        if np.median(finite) > 1e6:
            whole = np.floor(finite)
            return whole.astype(np.int64) * 1_000_000_000 + np.rint((finite - whole) * 1e9).astype(np.int64)
        return stamp_ns + np.rint(finite * 1e9).astype(np.int64)

    def _lasers(self, xyz: Array, ring: NDArray[np.int64]) -> NDArray[np.int64] | None:
        """The laser of each ring, by the first cloud that shows it: packet order or by elevation; None: not known yet.

        LinkError where the rings are not the model's beams.
        """
        lasers = self._profile.lasers
        if ring.min() < 0 or ring.max() >= lasers:
            raise LinkError(f"{self._topic}: rings {ring.min()} to {ring.max()}{self._not_the_model()}")
        rho = np.hypot(xyz[:, 0], xyz[:, 1])
        far = rho > FAR_M
        if np.count_nonzero(far) < MIN_FAR:
            return self._order
        orders = [np.arange(lasers), np.argsort(self._elevation, kind="stable")]
        known = orders if self._order is None else [self._order]
        wrong = [self._off_beam(rho[far], xyz[far, 2], order[ring[far]]) for order in known]
        if min(wrong) > MAX_WRONG:
            raise LinkError(
                f"{self._topic}: {100 * min(wrong):.0f} % of the points are not on their beam{self._not_the_model()}"
            )
        if self._order is None and (max(wrong) > MAX_WRONG or (orders[0] == orders[1]).all()):
            self._order = orders[int(np.argmin(wrong))]
        return self._order

    def _off_beam(self, rho: Array, z: Array, laser: NDArray[np.int64]) -> float:
        """Share of points that are not on the beam of their laser."""
        tolerance = max(0.5 * self._profile.beam_spacing_rad, math.radians(0.2))
        elevation = np.arctan2(z - self._z_offset_m[laser], self._level(rho, laser))
        return float(np.mean(np.abs(elevation - self._elevation[laser]) > tolerance))

    def _not_the_model(self) -> str:
        model = self._profile.model
        return f", and the rig's LiDAR is a {model}: is it another model, or is the cloud motion-compensated?"

    def _level(self, rho: Array, laser: NDArray[np.int64]) -> Array:
        """Horizontal distance from a beam's origin to its point."""
        along, across = self._origin_m * np.cos(self._offset[laser]), self._origin_m * np.sin(self._offset[laser])
        return np.sqrt(np.maximum(rho**2 - across**2, 0.0)) - along

    def _beams(self, xyz: Array, laser: NDArray[np.int64]) -> tuple[Array, Array]:
        """Range, and azimuth of the rotor when the laser fired."""
        rho = np.hypot(xyz[:, 0], xyz[:, 1])
        level = self._level(rho, laser)
        range_m = np.hypot(level, xyz[:, 2] - self._z_offset_m[laser]) + self._origin_m
        offset = self._offset[laser]
        bearing = np.arctan2(level * np.sin(offset), level * np.cos(offset) + self._origin_m)
        return range_m, np.arctan2(xyz[:, 0], xyz[:, 1]) - bearing

    def _numbers(self, azimuth: Array, at_ns: NDArray[np.int64], laser: NDArray[np.int64]) -> tuple[Any, Any]:
        """Firing sequence of each point, counted from the first, and its start [ns].

        Drivers give times by pulse or by sequence: the right one puts the points on fewer starts. An Ouster fires by
        its rotor's angle, the others by their clock.
        """
        candidates = [at_ns - self._delay_ns[laser], at_ns]
        starts = min(candidates, key=lambda times: len(np.unique(times // 500)))
        if self._columns_per_turn:
            at = np.rint((azimuth - np.pi / 2) / (2 * np.pi) * self._columns_per_turn).astype(np.int64)
            since = (starts - starts[0]) / self._sequence_ns
            number = at - at[0]
            number += self._columns_per_turn * np.rint((since - number) / self._columns_per_turn).astype(np.int64)
            self._first_column = int(at[0] + number.min()) % self._columns_per_turn
        else:
            since = (starts - starts[0]) / self._sequence_ns
            phase = np.angle(np.mean(np.exp(2j * np.pi * since))) / (2 * np.pi)
            number = np.rint(since - phase).astype(np.int64)
        return number - number.min(), starts

    def _rotation(
        self, azimuth: Array, number: NDArray[np.int64], laser: NDArray[np.int64], turn_ns: NDArray[Any]
    ) -> Array:
        """Azimuth of the rotor at the start of each sequence; between those that have points it turns steadily."""
        order = np.lexsort((number, laser))
        change, step = np.diff(azimuth[order]), np.diff(number[order])
        near = (step >= 1) & (step <= 3) & (np.diff(laser[order]) == 0)
        if not near.any():
            raise LinkError(f"{self._topic}: too few points to know how the sensor turns{self._not_the_model()}")
        rate = float(np.median(_wrapped(change[near]) / step[near]))  # [rad] per sequence
        turned = azimuth - rate * turn_ns / self._sequence_ns - rate * number
        middle = float(np.angle(np.mean(np.exp(1j * turned))))
        error = _wrapped(turned - middle)
        unsteady = error - np.polyval(np.polyfit(number, error, 1), number)
        if not rate > 0 or np.median(np.abs(unsteady)) > MAX_TURN_ERROR_RAD:
            raise LinkError(f"{self._topic}: the points do not turn steadily{self._not_the_model()}")
        return rate * np.arange(number.max() + 1) + middle + _filled(number, error)

    def _append(self, new: _Sequences) -> None:
        """Add sequences after the waiting ones, or in their place where packets are missing between them."""
        old = self._waiting
        if len(old.start_ns):
            lag = self._lag(new)
            if lag == 0:  # one sequence in two clouds
                old.pulses[-1] = np.where(old.pulses[-1] > 0, old.pulses[-1], new.pulses[0])
                self._waiting = _joined(old, new.after(1), 0)
                return
            if 0 < lag * self._sequence_ns < MAX_GAP_NS:
                self._waiting = _joined(old, new, lag - 1)
                return
        self._waiting = new

    def _lag(self, new: _Sequences) -> int:
        """Sequences from the last waiting one to the first new one."""
        since = (new.start_ns[0] - self._waiting.start_ns[-1]) / self._sequence_ns
        if not self._columns_per_turn:
            return round(since)
        apart = (self._first_column - self._last_column) % self._columns_per_turn
        return apart + self._columns_per_turn * round((since - apart) / self._columns_per_turn)

    def _full_packets(self) -> list[tuple[int, bytes]]:
        """Packets of the waiting sequences but the last, to which the next cloud may add."""
        size, waiting = self._encoder.sequences, self._waiting
        out: list[tuple[int, bytes]] = []
        for k in range(0, size * ((len(waiting.start_ns) - 1) // size), size):
            part = slice(k, k + size)
            ranges, shades = waiting.pulses[None, part, :, 0], waiting.pulses[None, part, :, 1].astype(np.uint8)
            at_ns = self._epoch_ns + round(waiting.start_ns[k])
            out.append((at_ns, self._encoder.encode(at_ns, waiting.azimuth_rad[part], ranges, shades)))
        self._waiting = waiting.after(size * len(out))
        return out


class _Sequences(NamedTuple):
    """Consecutive firing sequences."""

    start_ns: Array  # after the first cloud's
    azimuth_rad: Array  # of the rotor, not wrapped
    pulses: Array  # (sequences, lasers, 2): range [m], 0 where nothing returned; reflectivity

    def after(self, count: int) -> _Sequences:
        return _Sequences(*(values[count:] for values in self))


def _joined(old: _Sequences, new: _Sequences, between: int) -> _Sequences:
    """Two runs of sequences and as many between them in which nothing returned."""
    if not len(new.start_ns):
        return old
    share = np.arange(1, between + 1) / (between + 1)
    turn = (new.azimuth_rad[0] - old.azimuth_rad[-1]) % (2 * np.pi)
    return _Sequences(
        np.concatenate([old.start_ns, old.start_ns[-1] + share * (new.start_ns[0] - old.start_ns[-1]), new.start_ns]),
        np.concatenate([old.azimuth_rad, old.azimuth_rad[-1] + share * turn, new.azimuth_rad]),
        np.concatenate([old.pulses, np.zeros((between, *old.pulses.shape[1:])), new.pulses]),
    )


def _filled(number: NDArray[np.int64], values: Array) -> Array:
    """Mean of the values of each number from 0, interpolated between numbers that have some."""
    sums, points = np.bincount(number, values), np.bincount(number)
    there = np.flatnonzero(points)
    return np.interp(np.arange(len(points)), there, sums[there] / points[there])


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi
