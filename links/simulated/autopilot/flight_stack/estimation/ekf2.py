"""PX4's EKF2 as far as external vision, GPS, barometer and compass go: start, stop, gates, timeouts and resets.

The source sets stand for EKF2_EV_CTRL, EKF2_GPS_CTRL, EKF2_HGT_REF and EKF2_MAG_TYPE. External vision starts when two
samples are less than 200 ms apart, with a reset to it, and stops 400 ms after the newest; when its fusion fails for 1 s
the state is reset to it, at most 5 times in the air. Without aiding for EKF2_NOAID_TOUT the position is invalid.

Source: https://github.com/PX4/PX4-Autopilot, src/modules/ekf2/EKF: aid_sources/external_vision (ev_control.cpp,
ev_pos_control.cpp, ev_yaw_control.cpp), ekf_helper.cpp (updateDeadReckoningStatus), common.h.
"""

from __future__ import annotations

import numpy as np

from links.simulated.autopilot.flight_stack.estimation.ekf3 import NS, Ekf3
from links.simulated.autopilot.flight_stack.estimation.lane import Lane
from links.simulated.autopilot.flight_stack.estimation.observations import External
from links.simulated.autopilot.flight_stack.estimation.source_rules import (
    EKF2,
    PX4_EV_RESETS,
    PX4_EV_START_S,
    PX4_EV_STOP_S,
    PX4_NO_AID_S,
    AidingSource,
    Sources,
)
from links.simulated.autopilot.flight_stack.sensors import GpsFix
from links.simulated.autopilot.flight_stack.settings import GpsSettings
from stages.geometry.frames import Array64


class Ekf2(Ekf3):
    """EKF2 with the interface of Ekf3."""

    def __init__(self, sets: tuple[Sources, ...], options: int, gps: GpsSettings, yaw_rad: float | None) -> None:
        super().__init__(sets, 0, gps, yaw_rad)
        self.lane = Lane(EKF2, np.zeros(3), yaw_rad or 0.0)
        self._newest_ns: int | None = None  # of the samples of external vision
        self._resets_left = PX4_EV_RESETS
        self._started = False

    def _select_aiding(self, now: int, external: External | None, gps: GpsFix | None) -> None:
        source = self.sources.position
        if external is not None:
            gap_ns = None if self._newest_ns is None else external.time_ns - self._newest_ns
            self._newest_ns = external.time_ns
            if not self._started and gap_ns is not None and gap_ns < PX4_EV_START_S * NS:
                self._started, self._resets_left = True, PX4_EV_RESETS
                self._position_source_reset = self._yaw_source_reset = True
        elif self._newest_ns is not None and now - self._newest_ns > PX4_EV_STOP_S * NS:
            self._started = False
        usable = self._started if source is AidingSource.EXTERNAL else gps is not None and self.origin
        if not self.aiding and usable and source is not AidingSource.NONE:
            self.aiding = True
            self.position_timeout = self.velocity_timeout = False
            self._position_pass_ns = self._velocity_pass_ns = now
            self._position_source_reset = True
        elif self.aiding:
            last = max(self._position_pass_ns, self._velocity_pass_ns)
            if now - last > PX4_NO_AID_S * NS:
                self.position_timeout = self.velocity_timeout = True

    def _external_variance_m2(self, external: External) -> float:
        return external.position_sigma_m**2

    def _fuse_yaw(self, external: External | None) -> None:
        super()._fuse_yaw(external if self._started else None)

    def _fuse_horizontal(self, now: int, external: External | None, gps: GpsFix | None) -> None:
        super()._fuse_horizontal(now, external if self._started else None, gps)

    def _test_position(self, now: int, measured: Array64, variance: float) -> None:
        lane = self.lane
        innovation = measured - lane.x[0:2]
        per_axis = [
            lane.ratio(slice(i, i + 1), innovation[i : i + 1], variance, lane.rules.position_gate) for i in (0, 1)
        ]
        self.status.position = max(per_axis)
        if self.status.position <= 1:
            self._position_pass_ns, self.position_timeout = now, False
            lane.fuse_states(0, innovation, variance)
        elif now - self._position_pass_ns > lane.rules.position_retry_s * NS:
            if self._resets_left == 0:
                self._started = False
                return
            self._resets_left -= self.in_flight
            self._reset_position(now)
            self._position_pass_ns, self.position_timeout = now, False
