"""ArduPilot's EKF3: aiding by position, velocity, height and yaw, with its sources, gates, timeouts and resets.

While a GPS receiver reports an accuracy, that is the noise of every position, also of an external one, whose covariance
and VISO_POS_M_NSE then do not count (until 4.6). Aiding that begins with an external source resets the height to it,
whatever the source of the height is.

Not modelled: wind and magnetic field states (the compass is fused as a heading), optical flow, ranges, the GSF yaw
estimator, ground effect.

Source: https://github.com/ArduPilot/ardupilot, libraries/AP_NavEKF3: AP_NavEKF3_Control.cpp (setAidingMode,
updateFilterStatus), AP_NavEKF3_PosVelFusion.cpp (SelectVelPosFusion, FuseVelPosNED, ResetPosition, ResetVelocity,
selectHeightForFusion), AP_NavEKF3_MagFusion.cpp (SelectMagFusion, alignYawAngle), AP_NavEKF3_Measurements.cpp
(writeExtNavData, writeExtNavVelData).
"""

from __future__ import annotations

import math

import numpy as np

from links.simulated.autopilot.flight_stack.estimation.lane import Lane
from links.simulated.autopilot.flight_stack.estimation.observations import External, InnovationRatios, ObservationBuffer
from links.simulated.autopilot.flight_stack.estimation.source_rules import (
    EKF3,
    AidingSource,
    Sources,
    fuses_climb,
    fuses_velocity,
)
from links.simulated.autopilot.flight_stack.sensors import GpsFix
from links.simulated.autopilot.flight_stack.settings import GpsSettings
from stages.geometry.frames import Array64

NS = 1_000_000_000
RECENT_NS = 500_000_000  # minTestTime_ms: a source in use
FRESH_NS = 250_000_000  # a reset uses data not older than this
LEAST_POSITION_NOISE_M = 0.5  # EK3_POSNE_M_NSE, of a position with GPS accuracy
BARO_OFFSET_GAIN, BARO_OFFSET_STEP_M = 0.1, 5.0  # calcFiltBaroOffset, while another height source is used


class Ekf3:
    """One core of EKF3 with its sources."""

    def __init__(self, sets: tuple[Sources, ...], options: int, gps: GpsSettings, yaw_rad: float | None) -> None:
        """yaw_rad: of the compass at boot; None without a compass: the yaw is not aligned."""
        self.lane = Lane(EKF3, np.zeros(3), yaw_rad or 0.0)
        self.status = InnovationRatios()
        self.active = 0
        self.origin = False
        self.aiding = False  # AID_ABSOLUTE; else AID_NONE, constant position
        self.position_timeout = self.velocity_timeout = self.height_timeout = False
        self.yaw_aligned = yaw_rad is not None
        self.texts: list[tuple[int, str]] = []  # severity and STATUSTEXT, until taken
        self.in_flight = False
        self.used_external_ns: int | None = None
        self._sets, self._options, self._gps_settings = sets, options, gps
        self._gps: ObservationBuffer[GpsFix] = ObservationBuffer()
        self._baro: ObservationBuffer[float] = ObservationBuffer()
        self._compass: ObservationBuffer[float] = ObservationBuffer()
        self._external: ObservationBuffer[External] = ObservationBuffer()
        self._external_ns = -NS
        self._last_external: External | None = None
        self._last_gps: GpsFix | None = None
        self._position_pass_ns = self._velocity_pass_ns = self._height_pass_ns = 0
        self._position_source = self._yaw_source = AidingSource.NONE
        self._position_source_reset = self._yaw_source_reset = False
        self._height_source = AidingSource.BARO
        self._baro_offset = 0.0
        self._held: Array64 | None = None  # position held without aiding
        self._ran = False

    @property
    def sources(self) -> Sources:
        """The active source set."""
        return self._sets[self.active]

    def write_gps(self, fix: GpsFix) -> None:
        """A fix; the first one sets the origin, which is that of the frame."""
        if not self.origin:
            self.origin = True
            self.texts.append((6, "EKF3 IMU0 origin set"))
        self._gps.push(fix.time_ns, fix)

    def write_baro(self, now_ns: int, height_m: float) -> None:
        """A height."""
        self._baro.push(now_ns - 60_000_000, height_m)  # HGT_DELAY 60 ms

    def write_compass(self, now_ns: int, yaw_rad: float) -> None:
        """A heading."""
        self._compass.push(now_ns - 60_000_000, yaw_rad)  # magDelay_ms

    def write_external(self, pose: External) -> None:
        """An external pose; time_ns has VISO_DELAY_MS subtracted."""
        self._external_ns = pose.time_ns
        self._external.push(max(pose.time_ns - 5_000_000, self.lane.horizon_ns), pose)  # half a filter step

    def step(self, now_ns: int, moved: Array64) -> None:
        """One tick of the IMU."""
        if not self.lane.advance(now_ns, moved):
            return
        if not self._ran:
            self._ran = True
            self._position_pass_ns = self._velocity_pass_ns = self._height_pass_ns = self.lane.horizon_ns
            self._held = self.lane.x[0:2].copy()
        now = self.lane.horizon_ns
        external, gps = self._external.recall(now), self._gps.recall(now)
        self._last_external, self._last_gps = external or self._last_external, gps or self._last_gps
        self._select_aiding(now, external, gps)
        self._fuse_yaw(external)
        self._fuse_horizontal(now, external, gps)
        self._fuse_height(now, external)

    # --- aiding mode ---

    def _select_aiding(self, now: int, external: External | None, gps: GpsFix | None) -> None:
        source = self.sources.position
        if not self.aiding:
            ready = self.yaw_aligned and (
                (source is AidingSource.GPS and gps is not None and self.origin)
                or (source is AidingSource.EXTERNAL and external is not None)
            )
            if ready:
                self.aiding = True
                name = "GPS" if source is AidingSource.GPS else "external nav data"
                self.texts.append((6, f"EKF3 IMU0 is using {name}"))
                self.position_timeout = self.velocity_timeout = False
                self._position_pass_ns = self._velocity_pass_ns = now
                self._reset_velocity(now)
                self._reset_position(now)
                if source is AidingSource.EXTERNAL and external is not None:
                    self.lane.reset(2, external.xyz_m[2:], external.position_sigma_m**2)
            return
        position_aiding = now - self._position_pass_ns <= RECENT_NS
        velocity_aiding = now - self._velocity_pass_ns <= RECENT_NS
        rules = self.lane.rules
        longest = min(now - self._position_pass_ns, now - self._velocity_pass_ns)
        if not (position_aiding or velocity_aiding) and longest > rules.stop_aiding_s * NS:
            self.aiding = False
            self.position_timeout = self.velocity_timeout = True
            self.status.velocity = self.status.position = 0.0
            self._held = self.lane.x[0:2].copy()
            self.texts.append((4, "EKF3 IMU0 stopped aiding"))
            return
        retry_s = rules.position_retry_with_velocity_s if velocity_aiding else rules.position_retry_s
        if not position_aiding and now - self._position_pass_ns > retry_s * NS:
            self.position_timeout = self.velocity_timeout = True

    # --- yaw ---

    def _fuse_yaw(self, external: External | None) -> None:
        source = self.sources.yaw
        if source is not self._yaw_source:
            self._yaw_source, self._yaw_source_reset = source, True
        compass = self._compass.recall(self.lane.horizon_ns)
        if source is AidingSource.EXTERNAL:
            if external is None or not math.isfinite(external.yaw_rad):
                return
            variance = max(external.yaw_sigma_rad, 0.05) ** 2
            measured = external.yaw_rad
        else:
            if compass is None or source is AidingSource.NONE:
                return
            variance, measured = self.lane.rules.compass_noise_rad**2, compass
        if not self.yaw_aligned or self._yaw_source_reset:
            self.lane.reset_yaw(measured, variance if source is AidingSource.EXTERNAL else math.radians(10) ** 2)
            self.yaw_aligned, self._yaw_source_reset = True, False
            self.texts.append((6, "EKF3 IMU0 yaw aligned"))
            return
        self.status.yaw, innovation = self.lane.yaw_ratio(measured, variance, self.lane.rules.yaw_gate)
        if self.status.yaw <= 1 or not self.in_flight:
            self.lane.fuse_yaw(innovation, variance)

    def request_yaw_reset(self) -> None:
        """AP_AHRS::request_yaw_reset: the next yaw is taken over, with GPS only: the EKF-GSF needs its velocity."""
        if self.sources.position is AidingSource.GPS and self.sources.velocity is AidingSource.GPS:
            self._yaw_source_reset = True

    # --- horizontal position and velocity ---

    def _fuse_horizontal(self, now: int, external: External | None, gps: GpsFix | None) -> None:
        source = self.sources.position
        if source is not self._position_source:
            self._position_source_reset = source is not AidingSource.NONE
            self._position_source = source
        if not self.aiding:
            self._hold_position()
            return
        position: Array64 | None = None
        velocity: Array64 | None = None
        climb = False
        variance, velocity_sigma = 0.0, 0.0
        if gps is not None and source is AidingSource.GPS:
            position, variance = gps.xyz_m[:2], self._gps_settings.reported_m**2
            velocity_sigma = self._gps_settings.reported_mps
            if fuses_velocity(AidingSource.GPS, self.sources, self._sets, self._options):
                velocity = gps.velocity_mps
                climb = fuses_climb(AidingSource.GPS, self.sources, self._sets, self._options)
        elif external is not None and source is AidingSource.EXTERNAL:
            position, variance = external.xyz_m[:2], self._external_variance_m2(external)
            self.used_external_ns = now
        if (
            external is not None
            and external.velocity_mps is not None
            and fuses_velocity(AidingSource.EXTERNAL, self.sources, self._sets, self._options)
        ):
            velocity, velocity_sigma = external.velocity_mps, self.lane.rules.external_velocity_noise_mps
            climb = fuses_climb(AidingSource.EXTERNAL, self.sources, self._sets, self._options)
        fresh = gps if source is AidingSource.GPS else external
        reset = source is AidingSource.EXTERNAL and external is not None and external.reset
        if fresh is not None and (reset or self._position_source_reset):
            self._position_source_reset = False
            self._reset_position(now)
            if (
                source is AidingSource.EXTERNAL
                and self._height_source is AidingSource.EXTERNAL
                and external is not None
            ):
                self.lane.reset(2, external.xyz_m[2:], external.position_sigma_m**2)
        if velocity is not None:
            self._test_velocity(now, velocity[: 3 if climb else 2], velocity_sigma)
        if position is not None:
            self._test_position(now, position, variance)

    def _external_variance_m2(self, external: External) -> float:
        """Noise of an external horizontal position (FuseVelPosNED): that of GPS, if there has been a fix."""
        if self._last_gps is None:
            return external.position_sigma_m**2
        return max(self._gps_settings.reported_m, LEAST_POSITION_NOISE_M) ** 2

    def _hold_position(self) -> None:
        """AID_NONE: a synthetic position keeps the tilt."""
        assert self._held is not None
        self.lane.fuse_states(
            0, self._held - self.lane.x[0:2], 10.0**2 if self.in_flight else 0.5**2
        )  # EK3_NOAID_M_NSE

    def _test_velocity(self, now: int, measured: Array64, sigma: float) -> None:
        lane = self.lane
        innovation = measured - lane.x[3 : 3 + len(measured)]
        self.status.velocity = lane.ratio(slice(3, 3 + len(measured)), innovation, sigma**2, lane.rules.velocity_gate)
        timeout = now - self._velocity_pass_ns > lane.rules.velocity_retry_s * NS
        if self.status.velocity < 1:
            self._velocity_pass_ns, self.velocity_timeout = now, False
        elif timeout:
            lane.reset(3, measured, sigma**2)
            self._velocity_pass_ns, self.velocity_timeout = now, False
            return
        else:
            return
        lane.fuse_states(3, innovation, sigma**2)

    def _test_position(self, now: int, measured: Array64, variance: float) -> None:
        lane = self.lane
        innovation = measured - lane.x[0:2]
        self.status.position = lane.ratio(slice(0, 2), innovation, variance, lane.rules.position_gate)
        if self.status.position < 1:
            self._position_pass_ns, self.position_timeout = now, False
            lane.fuse_states(0, innovation, variance)
        elif self.position_timeout or now - self._position_pass_ns > lane.rules.position_retry_s * NS:
            self._reset_position(now)
            self._reset_velocity(now)
            self._position_pass_ns, self.position_timeout = now, False
            self.status.position = 0.0

    def _reset_position(self, now: int) -> None:
        source = self.sources.position
        if source is AidingSource.GPS and self._last_gps is not None:
            self.lane.reset(0, self._last_gps.xyz_m[:2], self._gps_settings.reported_m**2)
        elif source is AidingSource.EXTERNAL and self._last_external is not None:
            self.lane.reset(0, self._last_external.xyz_m[:2], self._last_external.position_sigma_m**2)

    def _reset_velocity(self, now: int) -> None:
        gps, external = self._last_gps, self._last_external
        if self.sources.velocity is AidingSource.GPS and gps is not None and now - gps.time_ns < 4 * FRESH_NS:
            self.lane.reset(3, gps.velocity_mps[:2], self._gps_settings.reported_mps**2)
        elif (
            self.sources.velocity is AidingSource.EXTERNAL
            and external is not None
            and external.velocity_mps is not None
            and now - external.time_ns < FRESH_NS
        ):
            self.lane.reset(3, external.velocity_mps[:2], self.lane.rules.external_velocity_noise_mps**2)
        else:
            self.lane.reset(3, np.zeros(2), 0.3**2)

    # --- height ---

    def _fuse_height(self, now: int, external: External | None) -> None:
        lane, rules = self.lane, self.lane.rules
        baro = self._baro.recall(now)
        lost = now - self._external_ns > rules.external_height_lost_s * NS
        before = self._height_source
        self._height_source = (
            AidingSource.EXTERNAL if self.sources.height is AidingSource.EXTERNAL and not lost else AidingSource.BARO
        )
        if baro is not None and self._height_source is not AidingSource.BARO:
            step = min(max(baro - lane.x[2] - self._baro_offset, -BARO_OFFSET_STEP_M), BARO_OFFSET_STEP_M)
            self._baro_offset += BARO_OFFSET_GAIN * step
        if self._height_source is AidingSource.EXTERNAL:
            if external is None:
                return
            measured, variance = float(external.xyz_m[2]), external.position_sigma_m**2
        else:
            if baro is None:
                return
            measured, variance = baro - self._baro_offset, rules.baro_noise_m**2
        if before is AidingSource.BARO and self._height_source is AidingSource.EXTERNAL and external is not None:
            lane.reset(2, external.xyz_m[2:], variance)
        innovation = np.array([measured - lane.x[2]])
        self.status.height = lane.ratio(slice(2, 3), innovation, variance, rules.height_gate)
        if self.status.height < 1:
            self._height_pass_ns, self.height_timeout = now, False
            lane.fuse_states(2, innovation, variance)
        elif now - self._height_pass_ns > rules.height_retry_s * NS:
            lane.reset(2, np.array([measured]), variance)
            self._height_pass_ns, self.height_timeout = now, False

    # --- status ---

    @property
    def has_position(self) -> bool:
        """filterStatus.flags.horiz_pos_abs."""
        return self.aiding and not self.position_timeout and self.yaw_aligned

    def set_origin(self) -> bool:
        """SET_GPS_GLOBAL_ORIGIN: rejected when an origin is set already."""
        if self.origin:
            return False
        self.origin = True
        return True

    def jump(self, jump_m: Array64) -> None:
        """The position estimate jumps, as at a glitch."""
        self.lane.reset(0, self.lane.x[0:3] + jump_m, 0.25)
