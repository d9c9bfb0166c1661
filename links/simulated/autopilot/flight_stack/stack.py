"""The autopilot in the loop: it flies the airframe on its own estimate, which depends on what it is sent.

Time runs in ticks of 10 ms. At the start of a tick the frames that have arrived are handled, sensors are read, the EKF
runs, the plan gives a target and the controller a command; then the airframe flies the tick. Messages are sent in
between at the steps of the main loop (2.5 ms), over the radio. A tick needs no frame that arrives after its start.

Source: ours; the parts name theirs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.profiles import best_values, required_parameters
from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.autopilot.flight_stack.commands import handle_frame, send_origin
from links.simulated.autopilot.flight_stack.downlink import Downlink
from links.simulated.autopilot.flight_stack.estimation.estimator import Estimators
from links.simulated.autopilot.flight_stack.estimation.source_rules import EKF_CHECK_HZ, SOURCE_SETS, AidingSource
from links.simulated.autopilot.flight_stack.failsafe import EkfAction, EkfCheck, arming_refusal
from links.simulated.autopilot.flight_stack.guidance import (
    LAND_FAST_ABOVE_M,
    LAND_FAST_MPS,
    LAND_MPS,
    FlightTarget,
    Guidance,
    PositionController,
    SurveyFrame,
    rotate,
)
from links.simulated.autopilot.flight_stack.outcomes.events import EventKind, FlightEvent
from links.simulated.autopilot.flight_stack.quadrotor import TICK_S, Quadrotor
from links.simulated.autopilot.flight_stack.sensors import Sensors
from links.simulated.autopilot.flight_stack.settings import Hold, TakeOff, UseSources
from links.simulated.autopilot.flight_stack.telemetry import gps_raw
from links.simulated.autopilot.radio import Radio
from links.simulated.kernels.airframe import QUATERNION, THRUST
from links.simulated.kernels.motion import GRAVITY_MPS2
from links.simulated.world.path import Path
from stages.cues.geodesy import Geographic, moved
from stages.geometry.frames import Array64, heading_rad, rotation_from_quaternion_xyzw, rotation_z

mavlink: Any = ardupilotmega
NS = 1_000_000_000
TICK_NS = round(TICK_S * NS)
GUIDED, LAND = 4, 9  # custom modes of ArduCopter
BOOT_S = 2.0  # a reboot is silent for so long
RESET_S = 1.0  # after a change of sources; then the frame is theirs, reset or not
ORIGIN = (356_895_000, 1_396_917_000, 40_000)  # latitude, longitude [1e-7 deg], altitude [mm] of the first GPS fix


class FlightStack:
    """An autopilot that flies. `motion` is the truth for the simulated sensors of the rig."""

    def __init__(
        self,
        settings: AutopilotSettings,
        path: Path,
        vehicle: Path,
        ground_m: float,
        start_ns: int,
        duration_s: float,
        seed: int,
        drift_m: Callable[[float], Array64] | None = None,
    ) -> None:
        """`drift_m`: error of the vehicle's odometry at a time, world axes (3,): of the frame of external positions."""
        assert settings.flight_stack is not None
        s = self.settings = settings.flight_stack
        self._autopilot, self._start_ns = settings, start_ns
        self.own, self.px4 = (1, 1), s.kind == "px4"
        fuses_yaw = any(SOURCE_SETS[name].yaw is AidingSource.EXTERNAL for name in s.source_sets[1:])
        required = required_parameters(s.kind, "measured" if fuses_yaw else "none")
        self.parameters = best_values(required)
        if not self.px4:
            self.parameters["EK3_SRC_OPTIONS"] = float(s.source_options)
        self._downlink = Downlink(settings, start_ns, seed)
        self.streams = self._downlink.streams
        self.origin: tuple[int, int, int] | None = None
        self.events: list[FlightEvent] = []  # for the outcome
        position, _, _, yaw = (part[0] for part in path.at(np.zeros(1)))
        home = np.array([position[0], position[1], ground_m + 0.2]) if s.on_ground else position
        self._home, self._world_yaw = home, -math.radians(settings.heading_of_world_x_deg)
        self._map = vehicle.at(np.zeros(1))[0][0], float(vehicle.at(np.zeros(1))[3][0])  # position and yaw of map
        self.sent_frame: SentFrame | None = None
        """Frame of external positions, as grd states it; None: not known, with axes that point north."""
        self.quadrotor = Quadrotor(s, home, float(yaw), ground_m, duration_s, seed)
        self.motion = self.quadrotor.motion
        self._sensors, self._tick = Sensors(s, seed), 0
        self.ekf = Estimators(s, self._compass_yaw(), seed)
        self._drift_m = drift_m or (lambda time_s: np.zeros(3))
        self._guidance = Guidance(path, vehicle, FlightTarget(np.zeros(3), yaw_rad=self._true_yaw()), self._drift_m)
        self._controller, self._check = PositionController(), EkfCheck()
        self.armed, self.mode = not s.on_ground, GUIDED
        self._plan: deque[Any] = deque(s.plan)
        self._step_ends_s = 0.0
        self._climbing_to: float | None = None
        self._uplink = Radio(settings.uplink, start_ns, np.random.default_rng([seed, 32]))
        self._received: deque[tuple[int, bytes]] = deque()
        self._boot_ns = start_ns - round(NS * settings.boot_s)
        self._silent_until_ns = 0
        self._reboots, self._jumps = deque(sorted(s.reboot_s)), deque(sorted(s.estimate_resets_m))
        self._next = {"check": 0.0, "arm": 0.0}
        self._switched_s = -10.0
        self._frame_before: SurveyFrame | None = None  # of the sources of before, until the estimate is reset
        self.target_error_m = self.worst_target_error_m = 0.0  # distance of the true position from the true target
        self._texts: set[str] = set()

    # --- the link ---

    def device_ns(self, host_ns: int) -> int:
        """The autopilot's time since boot at a host time."""
        since_ns = host_ns - self._boot_ns
        return since_ns + round(1e-6 * self._autopilot.clock_ppm * since_ns)

    def receive(self, frame: bytes, sent_ns: int) -> None:
        """A frame leaves the host; call in order of sending."""
        arrival_ns = self._uplink.arrival_ns(sent_ns, len(frame))
        if arrival_ns is not None:
            self._received.append((arrival_ns, frame))

    def records(self, until_ns: int) -> list[Record]:
        """Frames sent before `until_ns` that were not returned yet, stamped with their arrival."""
        self.advance(until_ns)
        return self._downlink.records(until_ns)

    def advance(self, until_ns: int) -> None:
        """Fly until the truth is known up to a time."""
        while self._start_ns + self._tick * TICK_NS < until_ns:
            self._fly_tick(self._start_ns + self._tick * TICK_NS)
            self._tick += 1

    def send(self, message: Any) -> None:
        """Queue a message; it is sent at the next step of the main loop."""
        self._downlink.send(message)

    def take_pose(self, message: Any, device_ns: int) -> None:
        """See Vehicle."""
        self.ekf.take_pose(message, device_ns)

    def use_sources(self, number: int) -> bool:
        """See Vehicle."""
        frame = self._frame()
        if not self.ekf.use_set(number - 1):
            return False
        self._switched_s, self._frame_before = self._tick * TICK_S, frame
        self._note(EventKind.SOURCE_SET, number=number)
        return True

    def set_origin(self, origin: tuple[int, int, int]) -> bool:
        """See Vehicle."""
        if self.origin is not None:
            return False
        self.origin = origin
        self.ekf.set_origin()
        return True

    def reboot(self) -> bool:
        """See Vehicle: refused while armed."""
        if self.armed:
            return False
        self._restart(self._start_ns + self._tick * TICK_NS)
        return True

    def text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT."""
        self.send(mavlink.MAVLink_statustext_message(severity, text.encode("ascii")[:50]))

    # --- one tick ---

    def _fly_tick(self, now_ns: int) -> None:
        time_s = self._tick * TICK_S
        device_ns = self.device_ns(now_ns)
        self._do_faults(time_s, now_ns)
        alive = now_ns >= self._silent_until_ns
        while self._received and self._received[0][0] <= now_ns:
            frame = self._received.popleft()[1]
            if alive:
                handle_frame(self, frame, device_ns)
        state = self.quadrotor.state
        measured = self._sensors.measure(
            time_s,
            device_ns,
            rotate(state[0:3] - self._home, self._world_yaw),
            rotate(state[3:6], self._world_yaw),
            self._R_odom_drone(),
            float(state[THRUST]) / GRAVITY_MPS2,
        )
        self.ekf.write(device_ns, *measured)
        self.ekf.in_flight = self.armed and not self.quadrotor.grounded
        for jump, yaw in self.ekf.take_resets():
            self._guidance.shift(jump, yaw)
            if np.any(jump):
                self._frame_before = None
        if self.ekf.has_origin and self.origin is None:
            self.origin = ORIGIN
            send_origin(self, device_ns)
        for severity, text in self.ekf.take_texts():
            self.text(severity, text)
        estimate = self.ekf.output()
        self._do_plan(time_s)
        self._do_checks(time_s, device_ns)
        command = self._command(time_s, estimate) if alive else np.array([0.0, 0.0, 9.81, 0.0, 0.0, float(self.armed)])
        tick = self.quadrotor.fly(estimate, command)
        self.ekf.step(self.device_ns(now_ns + TICK_NS), tick.moved)
        if alive:
            self._downlink.send_due(
                now_ns,
                tick,
                self._sensors.magnetometer.field_ut,
                self._gps_raw,
                self.ekf,
                self.device_ns,
                self._heartbeat(),
            )

    def _command(self, time_s: float, estimate: Array64) -> Array64:
        """(6,) for the airframe."""
        if not self.armed or self.quadrotor.crashed:
            return np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])
        if self.mode == LAND:
            if self.quadrotor.grounded:
                self.armed = False
                self._note(EventKind.LANDED)
            above_m = estimate[2] - self._frame().xyz_m[2] - self.quadrotor.ground_m
            climb = -LAND_FAST_MPS if above_m > LAND_FAST_ABOVE_M else -LAND_MPS
            yaw = math.atan2(2 * estimate[8] * estimate[9], 1 - 2 * estimate[8] ** 2)
            return self._controller.land(climb, estimate[3:6], yaw, False)
        if time_s > self._switched_s + RESET_S:
            self._frame_before = None
        target = self._guidance.update(time_s, self._frame_before or self._frame())
        if self._climbing_to is not None:
            target.xyz_m[2] = min(target.xyz_m[2] + 1.0 * TICK_S, self._climbing_to)
        frame = self._frame()
        if time_s > self._switched_s + RESET_S:  # until the estimate is reset, the target is in the frame of before
            away = rotate(target.xyz_m - frame.xyz_m, -frame.yaw_rad) - self.quadrotor.state[0:3]
            if self.ekf.sources.position is AidingSource.EXTERNAL:
                away -= self._drift_m(time_s)
            self.target_error_m = float(np.linalg.norm(away))
        self.worst_target_error_m = max(self.worst_target_error_m, self.target_error_m)
        return self._controller.command(target, estimate[0:3], estimate[3:6])

    @property
    def external_sets(self) -> list[bool]:
        """Whether the position of each source set is external."""
        return [SOURCE_SETS[name].position is AidingSource.EXTERNAL for name in self.settings.source_sets]

    def _frame(self) -> SurveyFrame:
        """Where the sources in use put the world: GPS in axes that point north, external ones in the frame of grd."""
        sources, (map_m, map_yaw) = self.ekf.sources, self._map
        external, sent = sources.position is AidingSource.EXTERNAL, self.sent_frame
        if external and sent is not None:
            yaw = -map_yaw - sent.yaw_rad
            xyz = sent.offset_m - rotate(map_m, yaw)
        else:
            yaw = self._world_yaw
            xyz = -rotate(map_m if external else self._home, yaw)
        if sources.height is not AidingSource.EXTERNAL:
            xyz[2] = -self._home[2]
        return SurveyFrame(yaw, xyz)

    def _do_plan(self, time_s: float) -> None:
        while self._plan and time_s >= self._step_ends_s - 1e-9:
            step = self._plan.popleft()
            self._step_ends_s += step.for_s
            if isinstance(step, UseSources):
                if self.use_sources(step.set) and not self.px4:
                    self.text(6, f"Using EKF Source Set {step.set}")
                continue
            self._note(EventKind.PLAN, step.do, holds=isinstance(step, Hold))
            self._guidance.begin(step, time_s)
            self._climbing_to = None
            if isinstance(step, TakeOff):
                self._climbing_to = self._frame().position(np.array([0, 0, self.quadrotor.ground_m + step.height_m]))[2]

    def _do_checks(self, time_s: float, device_ns: int) -> None:
        if time_s >= self._next["check"]:
            self._next["check"] = time_s + 1 / EKF_CHECK_HZ
            if self.armed:
                self._ekf_check()
        if self._climbing_to is not None and not self.armed and time_s >= self._next["arm"]:
            self._next["arm"] = time_s + 1.0
            refusal = arming_refusal(
                self.ekf.primary,
                self.ekf.external_healthy(device_ns),
                self.ekf.uses_external and self.settings.check_visual_odometry,
            )
            if refusal is None and not self.quadrotor.crashed and self.mode == GUIDED:
                self.armed = True
                self._guidance.target.xyz_m = self.ekf.output()[0:3].copy()
                self._guidance.target.yaw_rad = self.ekf.primary.lane.yaw_rad
                self._controller.reset()
                self._note(EventKind.ARMED)
            elif refusal is not None:
                self.text(2, refusal)
                if refusal not in self._texts:
                    self._texts.add(refusal)
                    self._note(EventKind.NOT_ARMED, refusal)

    def _ekf_check(self) -> None:
        action = self.ekf.failsafe_action(self._check)
        if action is EkfAction.YAW_RESET:
            self.ekf.primary.request_yaw_reset()
        elif action is EkfAction.LANE_SWITCH:
            lane = self.ekf.switch_lane()
            if lane is not None:
                self.text(4, f"EKF primary changed:{lane}")
                self._note(EventKind.LANE, number=lane)
        elif action is EkfAction.FAILSAFE:
            self.text(2, "EKF Failsafe: changed to LAND Mode" if not self.px4 else "Failsafe: no local position")
            self._note(EventKind.EKF_FAILSAFE)
            self.mode = LAND

    def _do_faults(self, time_s: float, now_ns: int) -> None:
        while self._reboots and time_s >= self._reboots[0]:
            self._reboots.popleft()
            self._restart(now_ns)
        while self._jumps and time_s >= self._jumps[0][0]:
            self.ekf.jump(rotate(np.array(self._jumps.popleft()[1]), self._frame().yaw_rad))
            self._note(EventKind.EKF_RESET)

    def _restart(self, now_ns: int) -> None:
        """Boot again; in flight the motors keep the airframe level at hover thrust meanwhile."""
        self._note(EventKind.REBOOT)
        self._boot_ns, self._silent_until_ns = now_ns, now_ns + round(BOOT_S * NS)
        self._downlink.restart()
        self.origin = None
        self.ekf.restart(self._compass_yaw())
        self._controller.reset()
        self._check = EkfCheck()

    # --- status ---

    def _gps_raw(self, device_ns: int) -> Any:
        """GPS_RAW_INT: the newest fix, in axes x north, y west, z up from home."""
        fix, position = self._sensors.gps_fix, None
        if fix is not None:
            north, west, up = fix.xyz_m.tolist()
            latitude, longitude, altitude_mm = ORIGIN
            home = Geographic(math.radians(1e-7 * latitude), math.radians(1e-7 * longitude), 1e-3 * altitude_mm)
            position = moved(home, np.array([-west, north, up]))
        return gps_raw(device_ns, position, self.settings.gps.reported_m)

    def _heartbeat(self) -> Any:
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
        autopilot = mavlink.MAV_AUTOPILOT_PX4 if self.px4 else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        critical = self.mode == LAND or self.quadrotor.crashed
        flying = mavlink.MAV_STATE_ACTIVE if self.armed else mavlink.MAV_STATE_STANDBY
        state = mavlink.MAV_STATE_CRITICAL if critical else flying
        return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, autopilot, base, self.mode, state, 3)

    def _R_odom_drone(self) -> Array64:
        """True attitude in the north-aligned frame."""
        x, y, z, w = self.quadrotor.state[QUATERNION]
        return rotation_z(self._world_yaw) @ rotation_from_quaternion_xyzw((x, y, z, w))

    def _true_yaw(self) -> float:
        """True yaw in the north-aligned frame."""
        return heading_rad(self._R_odom_drone())

    def _compass_yaw(self) -> float:
        """Yaw in the north-aligned frame by the compass, at boot."""
        R = self._R_odom_drone()
        self._sensors.magnetometer.sample(self._tick * TICK_S, R, float(self.quadrotor.state[THRUST]) / GRAVITY_MPS2)
        return self._sensors.magnetometer.heading_rad(R)

    def _note(self, kind: EventKind, detail: str = "", number: int = 0, holds: bool = False) -> None:
        self.events.append(FlightEvent(self._tick * TICK_S, kind, detail, number, holds))
