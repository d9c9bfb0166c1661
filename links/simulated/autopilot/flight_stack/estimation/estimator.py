"""The EKF cores of the autopilot together: inputs for all of them, the primary one, and what is reported.

Source: ArduPilot AP_NavEKF3.cpp (UpdateFilter, updateLaneSwitchPosResetData, checkLaneSwitch: cores by error score).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from links.simulated.autopilot.flight_stack import telemetry
from links.simulated.autopilot.flight_stack.estimation.ekf2 import Ekf2
from links.simulated.autopilot.flight_stack.estimation.ekf3 import Ekf3
from links.simulated.autopilot.flight_stack.estimation.external_input import ArduPilotInput, Px4Input
from links.simulated.autopilot.flight_stack.estimation.source_rules import SOURCE_SETS, AidingSource, Sources
from links.simulated.autopilot.flight_stack.failsafe import EkfAction, EkfCheck
from links.simulated.autopilot.flight_stack.quadrotor import TICK_S
from links.simulated.autopilot.flight_stack.sensors import GpsFix
from links.simulated.autopilot.flight_stack.settings import FlightStackSettings
from stages.geometry.frames import Array64


class Estimators:
    """Cores (one, or two with an IMU each), and, as a test instrument, one that reports independently of poses."""

    def __init__(self, settings: FlightStackSettings, yaw_rad: float, seed: int) -> None:
        self._settings = settings
        self._sets = tuple(SOURCE_SETS[name] for name in settings.source_sets)
        self.px4 = settings.kind == "px4"
        self._rng = np.random.default_rng([seed, 43])
        imu = settings.imu
        self._other = np.concatenate(  # bias of the second IMU relative to the first
            [
                math.radians(imu.gyro_bias_degps) * self._rng.standard_normal(3),
                imu.accelerometer_bias_mps2 * self._rng.standard_normal(3),
            ]
        )
        self.in_flight = False
        self.restart(yaw_rad)

    def restart(self, yaw_rad: float) -> None:
        """Boot: all cores begin again, with the yaw of the compass."""
        compass = any(one.yaw is AidingSource.BARO for one in self._sets)
        count = self._settings.lanes
        self.cores = [self._core(self._sets, yaw_rad if compass else None) for _ in range(count)]
        self._independent = self._core(self._sets[:1], yaw_rad) if self._settings.independent_telemetry else None
        self._primary = 0
        self._resets: list[tuple[Array64, float]] = []
        delay = self._settings.viso_delay_ms
        px4 = Px4Input(ekf2_ev_delay_ms=delay, compass=compass)
        self.input = px4 if self.px4 else ArduPilotInput(viso_delay_ms=delay)

    def _core(self, sets: tuple[Sources, ...], yaw_rad: float | None) -> Ekf3:
        s = self._settings
        cls = Ekf2 if self.px4 else Ekf3
        return cls(sets, s.source_options, s.gps, yaw_rad)

    @property
    def primary(self) -> Ekf3:
        """The core that flies."""
        return self.cores[self._primary]

    @property
    def reported(self) -> Ekf3:
        """The core whose estimate is sent."""
        return self._independent or self.primary

    @property
    def sources(self) -> Sources:
        """The active source set."""
        return self.primary.sources

    @property
    def uses_external(self) -> bool:
        """Whether any set has an external source: VISO_TYPE is then set."""
        return any(AidingSource.EXTERNAL in (s.position, s.velocity, s.height, s.climb, s.yaw) for s in self._sets)

    @property
    def has_origin(self) -> bool:
        """Whether the frame has a global origin."""
        return self.primary.origin

    def external_healthy(self, device_ns: int) -> bool:
        """Whether external poses arrive."""
        if isinstance(self.input, ArduPilotInput):
            return self.input.healthy(device_ns)
        return self.primary.used_external_ns is not None

    def use_set(self, index: int) -> bool:
        """Make a set active."""
        if not 0 <= index < len(self._sets):
            return False
        for core in self.cores:
            core.active = index
        return True

    def set_origin(self) -> None:
        """Take a global origin."""
        for core in self.cores:
            core.set_origin()

    def jump(self, jump_m: Array64) -> None:
        """The estimate of the primary core jumps."""
        self.primary.jump(jump_m)

    def take_pose(self, message: Any, device_ns: int) -> None:
        """A message that may be an external pose."""
        self.input.receive(message, device_ns)
        for pose in self.input.taken:
            for core in self.cores:
                core.write_external(pose)
        self.input.taken.clear()

    def write(self, device_ns: int, fixes: list[GpsFix], yaws: list[float], heights: list[float]) -> None:
        """Measurements of the drone's own sensors."""
        for core in self._all():
            for fix in fixes:
                core.write_gps(fix)
            for yaw in yaws:
                core.write_compass(device_ns, yaw)
            for height in heights:
                core.write_baro(device_ns, height)

    def step(self, device_ns: int, moved: Array64) -> None:
        """One tick of the IMUs."""
        for i, core in enumerate(self.cores):
            core.in_flight = self.in_flight
            core.step(device_ns, moved if i == 0 else self._second_imu(moved))
        if self._independent is not None:
            self._independent.in_flight = self.in_flight
            self._independent.step(device_ns, moved)

    def output(self) -> Array64:
        """State of the primary core now (16,)."""
        return self.primary.lane.output()

    def take_resets(self) -> list[tuple[Array64, float]]:
        """Jumps of the primary core since the last call: position [m], yaw [rad]."""
        found = self._resets + self.primary.lane.resets
        self._resets = []
        for core in self._all():
            core.lane.resets.clear()
        return found

    def take_texts(self) -> list[tuple[int, str]]:
        """STATUSTEXTs of the primary core."""
        found = list(self.primary.texts)
        for core in self._all():
            core.texts.clear()
        return found

    def failsafe_action(self, check: EkfCheck) -> EkfAction | None:
        """What the check of the filter asks for now."""
        return check.update(self.primary)

    def switch_lane(self) -> int | None:
        """Make the core with the lower error score primary; None: no other is better."""
        scores = [max(c.status.velocity, c.status.position, c.status.height) for c in self.cores]
        best = int(np.argmin(scores))
        if best == self._primary:
            return None
        before, after = self.output(), self.cores[best].lane.output()
        yaw = self.cores[best].lane.yaw_rad - self.primary.lane.yaw_rad
        self._resets.append((after[0:3] - before[0:3], math.remainder(yaw, math.tau)))
        self._primary = best
        self.primary.lane.reset_count += 1
        return best

    def report(self, device_ns: int) -> Any:
        """EKF_STATUS_REPORT or ESTIMATOR_STATUS of the primary core."""
        core, s = self.primary, self.primary.status
        flags = telemetry.status_flags(
            attitude=True,
            velocity=not (core.velocity_timeout and core.position_timeout) and core.aiding,
            position=core.has_position,
            height=not core.height_timeout,
            constant=not core.aiding,
            gps=core.sources.position is AidingSource.GPS,
        )
        ratios = s.velocity, s.position, s.height, s.yaw
        if self.px4:
            return telemetry.estimator_status(device_ns, flags, ratios, core.lane.P)
        return telemetry.ekf_status(flags, ratios)

    def _second_imu(self, moved: Array64) -> Array64:
        white = math.radians(self._settings.imu.gyro_white_degps), self._settings.imu.accelerometer_white_mps2
        noise = self._rng.standard_normal(6) * np.repeat(white, 3) * 0.5  # of the mean of four samples
        return moved + TICK_S * (self._other + noise)

    def _all(self) -> list[Ekf3]:
        return self.cores if self._independent is None else [*self.cores, self._independent]
