"""What is true, as records: poses, which pulses a drone returned, and whether the LiDAR has a line of sight to it.

The first drone is told on /truth/drone, /truth/hits and /truth/visible, each other one on the same with its number:
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
from stages.geometry import Array64, quaternions_xyzw

POSE_PERIOD_NS = 10_000_000
SIGHT_PERIOD_NS = 50_000_000


class TruthRecords:
    """Poses each 10 ms; lines of sight, where asked for, at the start and at each change seen every 50 ms."""

    def __init__(self, truth: Truth, world: RayScene, lidar_at: Callable[[NDArray[np.int64]], Array64] | None) -> None:
        """`lidar_at`: where the LiDAR is (n, 3) at times (n,), world frame; None: lines of sight are not told.

        Only the fixed world hides a drone: no vehicle, no bird, and no distance.
        """
        self._truth = truth
        self._world = world
        self._lidar_at = lidar_at
        self._poses_ns = self._sight_ns = truth.start_ns
        self._in_sight: dict[int, bool] = {}

    def records(self, until_ns: int) -> list[Record]:
        """What was true before `until_ns` and since the call before."""
        stamps_ns, self._poses_ns = _due(self._poses_ns, until_ns, POSE_PERIOD_NS)
        records = self._poses(stamps_ns)
        if self._lidar_at is not None:
            stamps_ns, self._sight_ns = _due(self._sight_ns, until_ns, SIGHT_PERIOD_NS)
            if len(stamps_ns):
                records += self._sight(stamps_ns, self._lidar_at(stamps_ns))
        return records

    def hits(self, pulse_ns: NDArray[np.int64], pulses: Pulses) -> list[Record]:
        """Which pulses (packets, n) each drone returned, by packet; the first packet tells it even of none."""
        records: list[Record] = []
        for number in self._truth.drones:
            hit = pulses.hits(number).reshape(pulse_ns.shape)
            for stamps, is_hit in zip(pulse_ns, hit, strict=True):
                if is_hit.any() or stamps[0] == self._truth.start_ns:
                    told = {"pulse_stamp_ns": stamps[is_hit].tolist()}
                    records.append(_record("/truth/hits", number, int(stamps[-1]), int(stamps[0]), told))
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
            seen = visible(self._world, lidar_m, self._truth.T_world_drone(stamps_ns, number)[1])
            for stamp, is_seen in zip(stamps_ns.tolist(), seen.tolist(), strict=True):
                if is_seen != self._in_sight.get(number):
                    self._in_sight[number] = is_seen
                    records.append(_record("/truth/visible", number, stamp, stamp, {"visible": is_seen}))
        return records


def _due(first_ns: int, until_ns: int, period_ns: int) -> tuple[NDArray[np.int64], int]:
    """Times from `first_ns` on and before `until_ns`, and the one after them."""
    count = -(-(until_ns - first_ns) // period_ns)
    return first_ns + period_ns * np.arange(count), first_ns + period_ns * max(count, 0)


def _record(topic: str, number: int, arrival_ns: int, stamp_ns: int, told: dict[str, object]) -> Record:
    name = topic if number == 1 else f"{topic}_{number}"
    return Record(name, arrival_ns=arrival_ns, stamp_ns=stamp_ns, data=json.dumps(told).encode())
