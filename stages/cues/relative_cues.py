"""Measurements of GNSS, ranging and barometer as the drone's position relative to the vehicle, in the axes of map.

    gnss       drone and vehicle: the difference of two positions, turned to map by the yaw of north (map_north.py);
               without that yaw only its horizontal length and its height
    uwb        distance
    altitude   altitude above home by the autopilot's estimator (barometer), from the height of the take-off point

A receiver's position and a range have a latency (the measurement was true so long before its stamp); the autopilot's
estimate is that at its stamp. Each has noise, and a bias that changes slowly. The bias
of GNSS is that of one receiver; those of drone and vehicle add up. The autopilot's estimate is used only while it
cannot contain a pose that grd sent (`IndependentTelemetry`); a receiver's own position never contains one.

Source: ours. GNSS of a logged Pixhawk flight: 2.9 m off horizontally (median), nearly constant over 188 s: 2.5 m an
axis (a Rayleigh distribution's median is 1.18 sigma). In another flight of 334 s position minus integrated Doppler
velocity changes by 0.02, 0.07, 0.19, 0.29, 0.8 m an axis within 0.2, 1, 5, 10, 60 s
(tests/benchmarks/accuracy/bench_gnss_drift.py): a random walk of 0.09 m/sqrt(s) and noise below 0.02 m. A bias of 2.5 m
that walks twice as fast, as between buildings, has the correlation time 2 (2.5 / 0.18)^2 = 386 s; 0.1 m of noise are
five times the measured. Ranging noise: DW1000 data sheet. Latencies and the limits
below are ours, chosen, not measured: set those of your receivers.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage, StrictModel
from stages.cues.geodesy import Geographic, displacement_enu_m
from stages.cues.map_north import MapNorth
from stages.geometry.frames import Array64, heading_rad, rotation_z
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import CueKind, DroneCue, DroneGlobalPosition, DroneGnss, UwbRange, VehicleGnss, VehicleMotion

MAX_AGE_NS = 1_500_000_000  # between the measurements of drone and vehicle
RECEIVER_NS = 2_000_000_000  # so long after the receiver's position the autopilot's is not used
FARTHEST_M = 500.0  # beyond it a GNSS position is of another flight
MAX_YAW_SIGMA_RAD = math.radians(20.0)  # with a larger one only distance and height are used
ZERO_M = np.zeros(3)

Vector3 = tuple[float, float, float]


class GnssSettings(StrictModel):
    """Errors of one GNSS receiver, one sigma an axis, and the antenna on the vehicle."""

    latency_s: float = Field(default=0.2, ge=0, le=2)
    noise_m: float = Field(default=0.1, gt=0)
    noise_up_m: float = Field(default=0.15, gt=0)
    bias_m: float = Field(default=2.5, ge=0)
    bias_up_m: float = Field(default=4.0, ge=0)
    bias_time_s: float = Field(default=400.0, gt=1)  # correlation time of the bias
    antenna_vehicle_m: Vector3 = (0.0, 0.0, 0.0)  # position on the vehicle
    heading_sigma_deg: float = Field(default=3.0, gt=0, le=45)  # of a heading that comes without its own


class UwbSettings(StrictModel):
    """Errors of the ranging, one sigma, and the device on the vehicle. Decawave DW1000: 0.1 m in line of sight."""

    latency_s: float = Field(default=0.02, ge=0, le=2)
    noise_m: float = Field(default=0.1, gt=0)
    bias_m: float = Field(default=0.3, ge=0)  # antenna delays, and the device's position on the drone
    bias_time_s: float = Field(default=120.0, gt=1)
    anchor_vehicle_m: Vector3 = (0.0, 0.0, 0.0)  # position on the vehicle


class AltitudeSettings(StrictModel):
    """Errors of the altitude above home by the autopilot's estimator, one sigma, and the height of the take-off point.

    Without GNSS height its slow error is that of the barometer.
    """

    noise_m: float = Field(default=0.3, gt=0)
    bias_m: float = Field(default=1.5, ge=0)  # 0.18 hPa of weather, temperature and rotor wash since the take-off
    bias_time_s: float = Field(default=120.0, gt=1)
    home_up_m: float | None = Field(
        default=None, ge=-100, le=100
    )  # above the vehicle's origin at its start; None: not used


class RelativeCuesSettings(Settings):
    """Settings of `RelativeCues`. A cue that is null is not used."""

    gnss: GnssSettings | None = GnssSettings()
    uwb: UwbSettings | None = UwbSettings()
    altitude: AltitudeSettings | None = AltitudeSettings()


class RelativeCues(Stage[RelativeCuesSettings]):
    """One `DroneCue` for each measurement of which everything needed is known."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"gnss", "global_position", "vehicle_gnss", "uwb", "motion"})

    def __init__(self, settings: RelativeCuesSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        gnss = self.settings.gnss or GnssSettings()
        self._trail = VehicleTrajectory()
        self._north = MapNorth(gnss.noise_m)
        self._origin: Geographic | None = None  # of east-north-up: the vehicle's first position
        self._vehicle: tuple[int, Geographic, VehicleGnss] | None = None
        self._receiver_ns: int | None = None
        self._not_used: Counter[str] = Counter()

    @property
    def counters(self) -> dict[str, int]:
        """Measurements that were not used, by reason."""
        return dict(self._not_used)

    def on_motion(self, motion: VehicleMotion) -> None:
        """Update the vehicle's trajectory."""
        if self._trail.add(motion):
            self._north.reset()

    def on_vehicle_gnss(self, gnss: VehicleGnss) -> None:
        """Position, and heading if there is one, of the vehicle."""
        settings = self.settings.gnss
        if settings is None:
            return
        stamp_ns = gnss.stamp_ns - round(1e9 * settings.latency_s)
        here = Geographic(gnss.latitude_rad, gnss.longitude_rad, gnss.altitude_m)
        self._origin = self._origin or here
        self._vehicle = stamp_ns, here, gnss
        R, _ = self._trail.at(stamp_ns)
        if gnss.yaw_enu_rad is not None and (self._trail.known_at(stamp_ns) or not self._trail.known):
            sigma = gnss.yaw_sigma_rad or math.radians(settings.heading_sigma_deg)
            self._north.add_heading(stamp_ns, heading_rad(R), gnss.yaw_enu_rad, sigma)
        if self._trail.known_at(stamp_ns):
            antenna_m = self._on_vehicle_m(stamp_ns, settings.antenna_vehicle_m)
            self._north.add_position(stamp_ns, antenna_m[:2], displacement_enu_m(self._origin, here)[:2])

    def on_gnss(self, gnss: DroneGnss) -> DroneCue | None:
        """Position of the drone by its receiver."""
        self._receiver_ns = gnss.stamp_ns
        here = Geographic(gnss.latitude_rad, gnss.longitude_rad, gnss.altitude_m)
        latency_s = 0.0 if self.settings.gnss is None else self.settings.gnss.latency_s
        return self._gnss_cue(gnss.stamp_ns - round(1e9 * latency_s), here, gnss.sigma_m, gnss.sigma_up_m)

    def on_global_position(self, position: DroneGlobalPosition) -> list[DroneCue]:
        """Position by the autopilot, in place of its receiver's, and its altitude above home."""
        if not position.independent:
            self._not_used["not independent of sent poses"] += 1
            return []
        cues = [self._altitude_cue(position)]
        if self._receiver_ns is None or position.stamp_ns - self._receiver_ns > RECEIVER_NS:
            here = Geographic(position.latitude_rad, position.longitude_rad, position.altitude_m)
            cues.append(self._gnss_cue(position.stamp_ns, here, None, None))
        return [cue for cue in cues if cue is not None]

    def on_uwb(self, uwb: UwbRange) -> DroneCue | None:
        """Distance between the devices of vehicle and drone."""
        settings = self.settings.uwb
        if settings is None:
            return None
        stamp_ns = uwb.stamp_ns - round(1e9 * settings.latency_s)
        R, _ = self._trail.at(stamp_ns)
        return DroneCue(
            stamp_ns=stamp_ns,
            source="uwb",
            kind=CueKind.RANGE,
            value_m=np.array([uwb.range_m]),
            covariance_m2=np.array([[max(settings.noise_m, uwb.sigma_m or 0.0) ** 2]]),
            bias_covariance_m2=np.array([[settings.bias_m**2]]),
            bias_time_s=settings.bias_time_s,
            yaw_sigma_rad=0.0,
            reference_map_m=R @ np.array(settings.anchor_vehicle_m),
        )

    def _altitude_cue(self, position: DroneGlobalPosition) -> DroneCue | None:
        settings = self.settings.altitude
        if settings is None or settings.home_up_m is None:
            return None
        up_m = position.altitude_above_home_m + settings.home_up_m - float(self._trail.at(position.stamp_ns)[1][2])
        return DroneCue(
            stamp_ns=position.stamp_ns,
            source="altitude",
            kind=CueKind.HEIGHT,
            value_m=np.array([up_m]),
            covariance_m2=np.array([[settings.noise_m**2]]),
            bias_covariance_m2=np.array([[settings.bias_m**2]]),
            bias_time_s=settings.bias_time_s,
            yaw_sigma_rad=0.0,
            reference_map_m=ZERO_M,
        )

    def _gnss_cue(
        self, stamp_ns: int, drone: Geographic, sigma_m: float | None, sigma_up_m: float | None
    ) -> DroneCue | None:
        """The difference of both positions, at the time of the drone's."""
        settings, vehicle = self.settings.gnss, self._vehicle
        if settings is None:
            return None
        if vehicle is None or abs(stamp_ns - vehicle[0]) > MAX_AGE_NS:
            self._not_used["GNSS of the drone without one of the vehicle"] += 1
            return None
        vehicle_ns, antenna, report = vehicle
        enu_m = displacement_enu_m(antenna, drone)
        if not float(np.linalg.norm(enu_m)) < FARTHEST_M:
            self._not_used[f"GNSS more than {FARTHEST_M:.0f} m from the vehicle"] += 1
            return None
        bias_m2 = max(settings.bias_m, sigma_m or 0.0) ** 2 + max(settings.bias_m, report.sigma_m or 0.0) ** 2
        bias_up_m2 = (
            max(settings.bias_up_m, sigma_up_m or 0.0) ** 2 + max(settings.bias_up_m, report.sigma_up_m or 0.0) ** 2
        )
        noise_m2, noise_up_m2 = 2.0 * settings.noise_m**2, 2.0 * settings.noise_up_m**2
        north = self._north.yaw(stamp_ns)
        start_m = self._on_vehicle_m(vehicle_ns, settings.antenna_vehicle_m)
        moved_m = start_m - self._trail.at(stamp_ns)[1]
        if north is None or north[1] > MAX_YAW_SIGMA_RAD:
            level_m = float(np.linalg.norm(enu_m[:2]))
            unknown_m2 = float(moved_m[:2] @ moved_m[:2])
            return DroneCue(
                stamp_ns=stamp_ns,
                source="gnss",
                kind=CueKind.LEVEL_AND_HEIGHT,
                value_m=np.array([level_m, float(enu_m[2] + moved_m[2])]),
                covariance_m2=np.diag([noise_m2 + unknown_m2, noise_up_m2]),
                bias_covariance_m2=np.diag([bias_m2, bias_up_m2]),
                bias_time_s=settings.bias_time_s,
                yaw_sigma_rad=0.0,
                reference_map_m=ZERO_M,
            )
        offset_m = rotation_z(north[0]) @ enu_m
        return DroneCue(
            stamp_ns=stamp_ns,
            source="gnss",
            kind=CueKind.POSITION,
            value_m=offset_m + moved_m,
            covariance_m2=np.diag([noise_m2, noise_m2, noise_up_m2]),
            bias_covariance_m2=np.diag([bias_m2, bias_m2, bias_up_m2]),
            bias_time_s=settings.bias_time_s,
            yaw_sigma_rad=north[1],
            reference_map_m=ZERO_M,
        )

    def _on_vehicle_m(self, stamp_ns: int, point_vehicle_m: Vector3) -> Array64:
        """Position (3,) of a point on the vehicle, frame map."""
        R, t = self._trail.at(stamp_ns)
        return t + R @ np.array(point_vehicle_m)
