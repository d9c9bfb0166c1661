"""Sweep: LiDAR slices and servo angles to points in the vehicle frame, and a depth image at the end of each sweep.

Slices wait in a queue until a servo state newer than their last pulse has arrived. Each return is then rotated by the
turntable angle at its own time (`stages/sweep/turntable.py`) and drawn into the depth image
(`stages/sweep/depth_image.py`). The image is published when the turntable has travelled `sweep_deg` in one direction. A
reversal or a gap in the servo states clears it, so vibration about a target never completes an image. A fixed LiDAR
gives one image per revolution. As in the paper, the motion of vehicle and drone during a sweep is not compensated.

Source: P III.A (sweep at 11.4 rpm over 180 deg, N = 512, 2 theta_max = 120 deg).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.geometry.frames import LidarMount
from stages.messages import DepthImage, LidarFirings, ServoState, SweptPoints, SweptPulses
from stages.sweep.depth_image import DepthCanvas
from stages.sweep.turntable import Turntable


class SweepSettings(Settings):
    """Settings of `Sweep`.

    `tolerance_deg`: a sweep is complete this much before `sweep_deg`, because a position servo stops short of its goal
    (an MX-28 under load by about 1 deg, encoder step 0.088 deg). The fan is 30 deg wide, so nothing remains unseen.
    `reversal_deg`: a smaller reversal is encoder jitter; vibration (+-5 deg) reverses by far more.
    """

    mount: LidarMount  # poses of turntable and LiDAR, and the servo's zero, sign and errors
    image_size_px: int = Field(512, ge=16, le=4096)  # N, side of the depth image
    fov_deg: float = Field(120.0, gt=0, lt=180)  # 2 theta_max, field of view of the depth image
    sweep_deg: float = Field(180.0, gt=0, le=360)  # travel of the turntable that completes a sweep
    tolerance_deg: float = Field(3.0, ge=0, lt=30)
    reversal_deg: float = Field(0.5, gt=0, lt=30)
    min_range_m: float = Field(0.6, ge=0)  # nearer returns come from the sensor's mount
    max_servo_gap_s: float = Field(0.1, ge=0.005)  # longest gap between two servo states that is interpolated
    max_wait_s: float = Field(0.34, gt=0)  # for a servo state; then the oldest slice is released without an angle

    @model_validator(mode="after")
    def _settings_agree(self) -> SweepSettings:
        if self.tolerance_deg >= self.sweep_deg:
            raise ValueError("tolerance_deg must be smaller than sweep_deg")
        return self


class Sweep(Stage[SweepSettings]):
    """Swept points and pulses per slice, a depth image per sweep. P III.A."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"servo"})

    def __init__(self, settings: SweepSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._waiting: deque[LidarFirings] = deque()
        settings = self.settings
        self._turntable = Turntable(settings.mount, settings.max_servo_gap_s, settings.min_range_m)
        self._canvas = DepthCanvas(
            settings.image_size_px, settings.fov_deg, self._turntable.T_vehicle_turntable[:3, 3].copy()
        )
        if settings.mount.turns:
            whole_rad = math.radians(settings.sweep_deg - settings.tolerance_deg)
            self._travel: Travel | Revolution = Travel(whole_rad, math.radians(settings.reversal_deg))
        else:
            self._travel = Revolution()

    def on_firings(self, firings: LidarFirings) -> Iterator[SweptPoints | SweptPulses | DepthImage]:
        """Queue the slice; yield what can be placed."""
        if firings.pulse_stamp_ns.size == 0:
            return
        waiting = self._waiting
        waiting.append(firings)
        yield from self._release()
        if waiting and firings.stamp_ns - waiting[0].stamp_ns >= self.settings.max_wait_s * 1e9:
            yield from self._place(waiting.popleft())

    def on_servo(self, servo: ServoState) -> Iterator[SweptPoints | SweptPulses | DepthImage]:
        """Add a servo state; yield the slices that waited for it."""
        self._turntable.add(servo)
        return self._release() if self._waiting else iter(())

    def finish(self) -> Iterator[SweptPoints | SweptPulses | DepthImage]:
        """Yield the slices still queued, as far as their angle is known. An incomplete sweep gives no image."""
        while self._waiting:
            yield from self._place(self._waiting.popleft())

    def _release(self) -> Iterator[SweptPoints | SweptPulses | DepthImage]:
        waiting, turntable, turns = self._waiting, self._turntable, self.settings.mount.turns
        while waiting:
            known_ns = turntable.known_until_ns
            if turns and (known_ns is None or known_ns < waiting[0].pulse_stamp_ns[-1]):
                return
            yield from self._place(waiting.popleft())

    def _place(self, firings: LidarFirings) -> Iterator[SweptPoints | SweptPulses | DepthImage]:
        turntable, travel, canvas = self._turntable, self._travel, self._canvas
        pulse_ns = firings.pulse_stamp_ns
        first_ns, last_ns = int(pulse_ns[0]), int(pulse_ns[-1])
        turns = turntable.turns(pulse_ns)
        angle_rad = float(turns[-1, 0])
        points, pulses = turntable.place(firings, turns)
        yield points
        yield pulses
        turntable.forget_before(last_ns)
        if math.isnan(angle_rad):
            travel.restart()
            canvas.clear()
            return
        azimuth_rad = float(firings.azimuth_rad[-1])
        if travel.advance(angle_rad, azimuth_rad):
            canvas.clear()
        if travel.moving:
            canvas.draw(first_ns, points.xyz_vehicle_m, firings.lost_packets)
        if travel.whole:
            yield canvas.take(last_ns, travel.turned_rad)
            travel.restart(angle_rad, azimuth_rad)


@dataclass
class Travel:
    """Travel of the turntable in one direction since its last reversal."""

    whole_rad: float  # a sweep is complete after this
    reversal_rad: float  # a smaller reversal is jitter
    _start_rad: float = field(default=math.nan, init=False)
    _furthest_rad: float = field(default=math.nan, init=False)

    def restart(self, angle_rad: float = math.nan, azimuth_rad: float = math.nan) -> None:
        """Count from this angle, or from the next one added."""
        del azimuth_rad
        self._start_rad = self._furthest_rad = angle_rad

    def advance(self, angle_rad: float, azimuth_rad: float) -> bool:
        """Add an angle. True after a reversal: travel and image start again."""
        del azimuth_rad
        if math.isnan(self._start_rad):
            self.restart(angle_rad)
        step_rad = angle_rad - self._furthest_rad
        if step_rad * (self._furthest_rad - self._start_rad) >= 0.0:
            self._furthest_rad = angle_rad
        elif abs(step_rad) > self.reversal_rad:
            self._start_rad, self._furthest_rad = self._furthest_rad, angle_rad
            return True
        return False

    @property
    def turned_rad(self) -> float:
        """Travel so far [rad]."""
        return abs(self._furthest_rad - self._start_rad)

    @property
    def moving(self) -> bool:
        """False while the turntable rests at its start: returns of that time belong to no sweep."""
        return self.turned_rad > self.reversal_rad

    @property
    def whole(self) -> bool:
        """True when the sweep is complete."""
        return self.turned_rad >= self.whole_rad


@dataclass
class Revolution:
    """Rotation of the LiDAR itself: the sweep of a LiDAR without servo."""

    turned_rad: float = field(default=0.0, init=False)  # travel of the servo, which does not exist
    moving: bool = field(default=True, init=False)
    _spun_rad: float = field(default=0.0, init=False)
    _azimuth_rad: float = field(default=math.nan, init=False)

    def restart(self, angle_rad: float = math.nan, azimuth_rad: float = math.nan) -> None:
        """Count from this azimuth, or from the next one added."""
        del angle_rad
        self._spun_rad, self._azimuth_rad = 0.0, azimuth_rad

    def advance(self, angle_rad: float, azimuth_rad: float) -> bool:
        """Add an azimuth, which only increases. Never True: a LiDAR does not reverse."""
        del angle_rad
        if not math.isnan(self._azimuth_rad):
            self._spun_rad += (azimuth_rad - self._azimuth_rad) % math.tau
        self._azimuth_rad = azimuth_rad
        return False

    @property
    def whole(self) -> bool:
        """True when one revolution is complete."""
        return self._spun_rad >= math.tau
