"""Pairs each image of the drone with the image of the vehicle that is nearest in time.

Source: ours.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from stages.messages import CameraMount, VanishingDirections

KEPT = 16


Pair = tuple[VanishingDirections | None, VanishingDirections]


class Pairing:
    """Yields each drone image with its nearest vehicle image, as soon as no nearer one can arrive."""

    def __init__(self, furthest_ns: int) -> None:
        self._furthest_ns = furthest_ns
        self._vehicle: deque[VanishingDirections] = deque(maxlen=KEPT)
        self._waiting: deque[VanishingDirections] = deque()

    def vehicle(self, seen: VanishingDirections) -> Iterator[Pair]:
        """Add a vehicle image; one that is not newer than the previous one is ignored."""
        if not self._vehicle or seen.stamp_ns > self._vehicle[-1].stamp_ns:
            self._vehicle.append(seen)
        yield from self._ready()

    def drone(self, seen: VanishingDirections) -> Iterator[Pair]:
        """Add a drone image."""
        self._waiting.append(seen)
        yield from self._ready()

    def rest(self) -> Iterator[Pair]:
        """Yield the waiting drone images with their nearest vehicle images; no more images will arrive."""
        while self._waiting:
            drone = self._waiting.popleft()
            yield self._nearest(drone), drone

    def _ready(self) -> Iterator[Pair]:
        while self._waiting and not self._may_arrive(self._waiting[0].stamp_ns):
            drone = self._waiting.popleft()
            yield self._nearest(drone), drone

    def _may_arrive(self, stamp_ns: int) -> bool:
        """Whether a vehicle image that is nearer than all so far may still arrive."""
        if self._waiting[-1].stamp_ns - stamp_ns > 2 * self._furthest_ns:
            return False  # it is late, or the camera has failed
        if not self._vehicle:
            return True
        newest_ns = self._vehicle[-1].stamp_ns
        period_ns = newest_ns - self._vehicle[-2].stamp_ns if len(self._vehicle) > 1 else 0
        return newest_ns < stamp_ns and 2 * (stamp_ns - newest_ns) > period_ns

    def _nearest(self, drone: VanishingDirections) -> VanishingDirections | None:
        nearest = min(self._vehicle, key=lambda seen: abs(seen.stamp_ns - drone.stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - drone.stamp_ns) > self._furthest_ns:
            return None
        return nearest


def of_mount(seen: VanishingDirections, camera_mount: CameraMount, port: str) -> VanishingDirections:
    """The message itself, or an error if it is of the other camera."""
    if seen.camera_mount is not camera_mount:
        raise ValueError(f"input {port!r} got the directions of the {seen.camera_mount.value}: wire the other camera")
    return seen
