"""Measurements that wait for their time: they are used in order of time, up to the horizon.

The horizon is the time up to which the motions of the drone and of the vehicle are measured. It waits for LiDAR
positions as long as the slowest of the newest ones took to arrive. Without an IMU the images of the drone measure its
motion.

Source: ours; DESIGN, Fusion: late data attach at their own time.
"""

from __future__ import annotations

import heapq
from collections import deque

from stages.geometry.trajectory import VehicleTrajectory
from stages.heading.imu_buffer import ImuBuffer
from stages.messages import DroneCue, DroneFix, RelativeRotation, VisualMotion

DELAY_NS = 100_000_000  # least wait for positions, assumed
LATEST_NS = 500_000_000  # longest wait; a position that is older than the state by more is not used
FIXES = 10  # newest positions whose delay counts
VEHICLE_NS, WAIT_NS = 60_000_000, 350_000_000  # extrapolation of the vehicle's pose; longest wait for a newer one
IMAGE_NS = 300_000_000  # without an IMU, longest wait for the drone's next image
Measurement = DroneFix | RelativeRotation | VisualMotion | DroneCue


class MeasurementQueue:
    """Measurements in order of time."""

    def __init__(self, imu: ImuBuffer, vehicle: VehicleTrajectory) -> None:
        self._imu, self._vehicle = imu, vehicle
        self._waiting: list[tuple[int, int, Measurement]] = []
        self._count, self._now_ns = 0, 0
        self._delays_ns: deque[int] = deque([DELAY_NS], maxlen=FIXES)

    def add(self, measurement: Measurement) -> None:
        """Add a measurement."""
        self._count += 1
        if isinstance(measurement, DroneFix) and self._now_ns:
            self._delays_ns.append(min(max(self._now_ns - measurement.stamp_ns, DELAY_NS), LATEST_NS))
        heapq.heappush(self._waiting, (measurement.stamp_ns, self._count, measurement))

    def clear(self) -> None:
        """Drop all."""
        self._waiting.clear()

    def drop_fixes(self) -> None:
        """Drop the LiDAR positions."""
        self._waiting = [entry for entry in self._waiting if not isinstance(entry[2], DroneFix)]
        heapq.heapify(self._waiting)

    def until(self, horizon_ns: int) -> list[Measurement]:
        """Remove and return the measurements up to a time, in order."""
        ready: list[Measurement] = []
        while self._waiting and self._waiting[0][0] <= horizon_ns:
            ready.append(heapq.heappop(self._waiting)[2])
        return ready

    def horizon_ns(self, now_ns: int) -> int:
        """Time up to which the motion of the drone and of the vehicle is measured and positions have arrived."""
        self._now_ns = now_ns
        newest_ns, image_ns = self._imu.newest_ns, self._imu.newest_image_ns
        horizon_ns = now_ns
        if newest_ns is not None and self._imu.is_current(now_ns):
            horizon_ns = min(newest_ns, now_ns - max(self._delays_ns))
        elif image_ns is not None and now_ns - image_ns < IMAGE_NS:
            horizon_ns = min(image_ns, now_ns)
        vehicle_ns = self._vehicle.newest_ns if self._vehicle.known_at(now_ns) else None
        if vehicle_ns is not None:
            horizon_ns = min(horizon_ns, max(vehicle_ns + VEHICLE_NS, now_ns - WAIT_NS))
        return horizon_ns
