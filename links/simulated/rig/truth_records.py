"""Ground truth records: poses, the pulses that a drone returned, and the LiDAR's line of sight to it.

The first drone has /truth/drone, /truth/hits and /truth/visible; other drones have the same topics with their number:
/truth/drone_2, /truth/hits_2, /truth/visible_2.

Source: ours; recording format in recordings/README.md (/truth/*).
"""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flow.link import Record
from links.simulated.sensors.lidar import Pulses
from links.simulated.world.clearance import visible
from links.simulated.world.mesh import RayScene
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64, quaternions_xyzw

POSE_PERIOD_NS = 10_000_000
SIGHT_PERIOD_NS = 50_000_000


class TruthRecords:
    """Poses every 10 ms; lines of sight, where requested, at the start and at each change, checked every 50 ms."""

    def __init__(self, truth: Truth, world: RayScene, lidar_at: Callable[[NDArray[np.int64]], Array64] | None) -> None:
        """`lidar_at`: position of the LiDAR (n, 3) at times (n,), world frame; None: no lines of sight.

        Only the static scene blocks a line of sight, not the vehicle, a bird or the distance.
        """
        self._truth = truth
        self._world = world
        self._lidar_at = lidar_at
        self._poses_ns = self._sight_ns = truth.start_ns
        self._in_sight: dict[int, bool] = {}

    def records(self, until_ns: int) -> list[Record]:
        """Ground truth before `until_ns` that was not returned yet."""
        stamps_ns, self._poses_ns = _due(self._poses_ns, until_ns, POSE_PERIOD_NS)
        records = self._poses(stamps_ns)
        if self._lidar_at is not None:
            stamps_ns, self._sight_ns = _due(self._sight_ns, until_ns, SIGHT_PERIOD_NS)
            if len(stamps_ns):
                records += self._sight(stamps_ns, self._lidar_at(stamps_ns))
        return records

    def hits(self, pulse_ns: NDArray[np.int64], pulses: Pulses) -> list[Record]:
        """Pulses (packets, n) that each drone returned: a record per packet with hits, and one for the first packet."""
        records: list[Record] = []
        for number in self._truth.drones:
            hit = pulses.hits(number).reshape(pulse_ns.shape)
            for stamps, is_hit in zip(pulse_ns, hit, strict=True):
                if is_hit.any() or stamps[0] == self._truth.start_ns:
                    content = {"pulse_stamp_ns": stamps[is_hit].tolist()}
                    records.append(_record("/truth/hits", number, int(stamps[-1]), int(stamps[0]), content))
        return records

    def _poses(self, stamps_ns: NDArray[np.int64]) -> list[Record]:
        truth = self._truth
        poses = [("/truth/vehicle", 1, truth.T_world_vehicle(stamps_ns))]
        poses += [("/truth/drone", number, truth.T_world_drone(stamps_ns, number)) for number in truth.drones]
        records: list[Record] = []
        for topic, number, (rotations, positions) in poses:
            turns = np.round(quaternions_xyzw(rotations), 9).tolist()
            for stamp, q, t in zip(stamps_ns.tolist(), turns, np.round(positions, 6).tolist(), strict=True):
                records.append(_record(topic, number, stamp, stamp, {"xyz_m": t, "quaternion_xyzw": q}))
        return records

    def _sight(self, stamps_ns: NDArray[np.int64], lidar_m: Array64) -> list[Record]:
        records: list[Record] = []
        for number in self._truth.drones:
            in_sight = visible(self._world, lidar_m, self._truth.T_world_drone(stamps_ns, number)[1])
            for stamp, is_visible in zip(stamps_ns.tolist(), in_sight.tolist(), strict=True):
                if is_visible != self._in_sight.get(number):
                    self._in_sight[number] = is_visible
                    records.append(_record("/truth/visible", number, stamp, stamp, {"visible": is_visible}))
        return records


def _due(first_ns: int, until_ns: int, period_ns: int) -> tuple[NDArray[np.int64], int]:
    """Times from `first_ns` on and before `until_ns`, and the time after them."""
    count = -(-(until_ns - first_ns) // period_ns)
    return first_ns + period_ns * np.arange(count), first_ns + period_ns * max(count, 0)


def _record(topic: str, number: int, arrival_ns: int, stamp_ns: int, content: dict[str, object]) -> Record:
    name = topic if number == 1 else f"{topic}_{number}"
    return Record(name, arrival_ns=arrival_ns, stamp_ns=stamp_ns, data=json.dumps(content).encode())
