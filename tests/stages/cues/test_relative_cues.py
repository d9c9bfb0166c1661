"""RelativeCues: GNSS differences in the axes of map, ranges, heights; what it does not use."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flow.message import check_arrays
from stages.cues import RelativeCues
from stages.cues.geodesy import Geographic, displacement_enu_m, moved
from stages.geometry.frames import rotation_z
from stages.messages import CueKind, DroneGlobalPosition, DroneGnss, UwbRange, VehicleGnss, VehicleMotion
from tests.stages.made import START_NS

TOKYO = Geographic(math.radians(35.66), math.radians(139.70), 40.0)
LATENCY_S = 0.2
NORTH_RAD = 0.6  # yaw of east-north-up in map


def at(t_s: float) -> int:
    return START_NS + round(1e9 * t_s)


def geographic(xyz_map_m) -> Geographic:
    return moved(TOKYO, rotation_z(-NORTH_RAD) @ np.asarray(xyz_map_m, dtype=np.float64))


def vehicle(t_s: float, xyz_map_m=(0.0, 0.0, 0.0), yaw_map_rad: float | None = 0.0) -> VehicleGnss:
    """As its receiver reports it: LATENCY_S late."""
    return VehicleGnss(
        stamp_ns=at(t_s + LATENCY_S),
        **geographic(xyz_map_m)._asdict(),
        sigma_m=None,
        sigma_up_m=None,
        yaw_enu_rad=None if yaw_map_rad is None else yaw_map_rad - NORTH_RAD,
        yaw_sigma_rad=math.radians(1.0),
    )


def drone(t_s: float, xyz_map_m) -> DroneGnss:
    return DroneGnss(stamp_ns=at(t_s + LATENCY_S), **geographic(xyz_map_m)._asdict(), sigma_m=None, sigma_up_m=None)


def motion(t_s: float, xyz_map_m, yaw_rad: float = 0.0) -> VehicleMotion:
    xyz = np.asarray(xyz_map_m, dtype=np.float64)
    return VehicleMotion(stamp_ns=at(t_s), xyz_map_m=xyz, R_map_vehicle=rotation_z(yaw_rad), covariance=None)


@pytest.mark.parametrize("latitude_deg", [-60.0, 0.0, 35.0, 80.0])
def test_a_displacement_and_a_move_are_inverse(latitude_deg):
    origin = Geographic(math.radians(latitude_deg), math.radians(179.9999), 500.0)  # next to the antimeridian
    enu_m = np.array([120.0, -310.0, 45.0])
    assert displacement_enu_m(origin, moved(origin, enu_m)) == pytest.approx(enu_m, abs=1e-3)


def test_a_degree_of_latitude_and_longitude_has_the_length_of_the_ellipsoid():
    """Tables of WGS84 at 45 deg: 111 131.8 m and 78 846.8 m per degree."""
    south, north = (Geographic(math.radians(45 + d), 0.0, 0.0) for d in (-0.05, 0.05))
    east = Geographic(math.radians(45), math.radians(0.1), 0.0)
    assert displacement_enu_m(south, north)[1] == pytest.approx(11_113.18, abs=0.1)
    assert displacement_enu_m(Geographic(math.radians(45), 0.0, 0.0), east)[0] == pytest.approx(7_884.68, abs=0.1)


def test_gnss_of_both_with_a_heading_gives_the_position_in_the_axes_of_map():
    stage = RelativeCues()
    stage.on_vehicle_gnss(vehicle(0.0))
    cue = stage.on_gnss(drone(0.0, (12.0, -5.0, 9.0)))
    assert cue is not None
    check_arrays(cue)
    assert (cue.kind, cue.source, cue.stamp_ns) == (CueKind.POSITION, "gnss", at(0.0))
    assert cue.value_m == pytest.approx([12.0, -5.0, 9.0], abs=0.01)


def test_turning_the_world_turns_nothing_in_map():
    """The vehicle's own yaw in map and its heading cancel."""
    stage = RelativeCues()
    stage.on_motion(motion(0.0, (0.0, 0.0, 0.0), yaw_rad=1.1))
    stage.on_vehicle_gnss(vehicle(0.0, yaw_map_rad=1.1))
    cue = stage.on_gnss(drone(0.0, (12.0, -5.0, 9.0)))
    assert cue is not None
    assert cue.value_m == pytest.approx([12.0, -5.0, 9.0], abs=0.01)


def test_without_a_heading_a_parked_vehicle_gives_distance_and_height_only():
    stage = RelativeCues()
    stage.on_vehicle_gnss(vehicle(0.0, yaw_map_rad=None))
    cue = stage.on_gnss(drone(0.0, (12.0, -5.0, 9.0)))
    assert cue is not None
    assert cue.kind is CueKind.LEVEL_AND_HEIGHT
    assert cue.value_m == pytest.approx([13.0, 9.0], abs=0.01)


def test_the_course_of_a_driving_vehicle_gives_north():
    stage = RelativeCues()
    for step in range(40):
        t_s, x_m = 0.2 * step, 5.0 * 0.2 * step
        stage.on_motion(motion(t_s, (x_m, 0.0, 0.0)))
        stage.on_vehicle_gnss(vehicle(t_s, (x_m, 0.0, 0.0), yaw_map_rad=None))
    cue = stage.on_gnss(drone(7.8, (39.0 + 12.0, -5.0, 9.0)))
    assert cue is not None
    assert cue.kind is CueKind.POSITION
    assert cue.value_m == pytest.approx([12.0, -5.0, 9.0], abs=0.05)
    assert math.radians(1.0) < cue.yaw_sigma_rad < math.radians(3.0)


def test_the_vehicles_motion_between_both_measurements_counts():
    stage = RelativeCues()
    for t_s in (0.0, 0.4):
        stage.on_motion(motion(t_s, (10.0 * t_s, 0.0, 0.0)))
    stage.on_vehicle_gnss(vehicle(0.0))
    cue = stage.on_gnss(drone(0.4, (12.0, 0.0, 9.0)))
    assert cue is not None
    assert cue.value_m == pytest.approx([8.0, 0.0, 9.0], abs=0.01)


def test_a_heading_is_not_used_while_the_vehicles_motion_is_unknown():
    stage = RelativeCues()
    stage.on_motion(motion(0.0, (0.0, 0.0, 0.0)))
    stage.on_vehicle_gnss(vehicle(1.0))  # 1 s after the last pose: the vehicle may have turned
    cue = stage.on_gnss(drone(1.0, (12.0, -5.0, 9.0)))
    assert cue is not None
    assert cue.kind is CueKind.LEVEL_AND_HEIGHT


def test_gnss_that_is_too_old_or_of_another_place_is_not_used():
    stage = RelativeCues()
    assert stage.on_gnss(drone(0.0, (1.0, 2.0, 3.0))) is None
    stage.on_vehicle_gnss(vehicle(0.0))
    assert stage.on_gnss(drone(1.6, (1.0, 2.0, 3.0))) is None
    assert stage.on_gnss(drone(0.2, (900.0, 2.0, 3.0))) is None
    assert sum(stage.counters.values()) == 3


def test_the_autopilots_position_replaces_a_silent_receiver_and_never_after_a_sent_pose():
    position = DroneGlobalPosition(
        stamp_ns=at(LATENCY_S), **geographic((4.0, 3.0, 9.0))._asdict(), altitude_above_home_m=10.0, independent=True
    )
    stage = RelativeCues(altitude={"home_up_m": -1.8})
    stage.on_vehicle_gnss(vehicle(0.0))
    sources = {cue.source: cue for cue in stage.on_global_position(position)}
    assert sources["altitude"].value_m == pytest.approx([8.2])
    assert sources["gnss"].value_m == pytest.approx([4.0, 3.0, 9.0], abs=0.01)
    stage.on_gnss(drone(0.0, (4.0, 3.0, 9.0)))
    assert [cue.source for cue in stage.on_global_position(position)] == ["altitude"]
    echo = DroneGlobalPosition(stamp_ns=at(0.3), **geographic((0.0, 0.0, 9.0))._asdict(), altitude_above_home_m=10.0)
    assert stage.on_global_position(echo) == []


def test_the_autopilots_position_is_its_estimate_at_its_stamp():
    position = DroneGlobalPosition(
        stamp_ns=at(0.4), **geographic((12.0, 0.0, 9.0))._asdict(), altitude_above_home_m=10.0, independent=True
    )
    stage = RelativeCues(altitude={"home_up_m": 0.0})
    for t_s in (0.0, 0.4):
        stage.on_motion(motion(t_s, (10.0 * t_s, 0.0, 5.0 * t_s)))
    stage.on_vehicle_gnss(vehicle(0.0))
    altitude, gnss = stage.on_global_position(position)
    assert (altitude.stamp_ns, gnss.stamp_ns) == (at(0.4), at(0.4))
    assert altitude.value_m == pytest.approx([8.0])  # the vehicle has risen by 2 m
    assert gnss.value_m == pytest.approx([8.0, 0.0, 7.0], abs=0.01)


def test_a_range_is_measured_from_the_device_on_the_turned_vehicle():
    stage = RelativeCues(uwb={"anchor_vehicle_m": (1.0, 0.0, 0.5)})
    stage.on_motion(motion(0.0, (5.0, 5.0, 0.0), yaw_rad=math.pi / 2))
    cue = stage.on_uwb(UwbRange(stamp_ns=at(0.02), range_m=17.0, sigma_m=0.4))
    assert cue is not None
    assert cue.reference_map_m == pytest.approx([0.0, 1.0, 0.5])
    assert cue.covariance_m2[0, 0] == pytest.approx(0.16)


def test_a_cue_that_is_null_is_not_used():
    stage = RelativeCues(gnss=None, uwb=None, altitude=None)
    stage.on_vehicle_gnss(vehicle(0.0))
    assert stage.on_gnss(drone(0.0, (1.0, 2.0, 3.0))) is None
    assert stage.on_uwb(UwbRange(stamp_ns=at(0.0), range_m=17.0, sigma_m=None)) is None


ANTENNA_M = (2.0, 0.5, 1.0)


def antenna_m(xyz_map_m, yaw_rad: float):
    return np.asarray(xyz_map_m) + rotation_z(yaw_rad) @ np.array(ANTENNA_M)


def test_the_antenna_of_a_turned_vehicle_and_its_motion_count_in_each_kind_of_cue():
    drone_m, yaw_rad = (12.0, -5.0, 9.0), 2.0
    for heading in (yaw_rad, None):
        stage = RelativeCues(gnss={"antenna_vehicle_m": ANTENNA_M})
        for t_s in (0.0, 0.4):
            stage.on_motion(motion(t_s, (10.0 * t_s, 0.0, 5.0 * t_s), yaw_rad))
        stage.on_vehicle_gnss(vehicle(0.0, antenna_m((0.0, 0.0, 0.0), yaw_rad), heading))
        cue = stage.on_gnss(drone(0.4, drone_m))
        assert cue is not None
        if heading is not None:
            assert cue.value_m == pytest.approx([8.0, -5.0, 7.0], abs=0.01)
            continue
        start_m = antenna_m((0.0, 0.0, 0.0), yaw_rad)
        level_m, moved_m = np.linalg.norm(drone_m[:2] - start_m[:2]), start_m[:2] - (4.0, 0.0)
        assert cue.value_m == pytest.approx([level_m, 7.0], abs=0.01)
        assert cue.covariance_m2[0, 0] == pytest.approx(2 * 0.1**2 + moved_m @ moved_m)  # its direction is unknown


def test_the_course_is_that_of_the_antenna_on_a_curve():
    stage = RelativeCues(gnss={"antenna_vehicle_m": ANTENNA_M})
    for step in range(11):
        t_s, yaw_rad = 0.2 * step, 0.15 * step
        here_m = (10.0 * math.sin(yaw_rad), 10.0 - 10.0 * math.cos(yaw_rad), 0.0)
        stage.on_motion(motion(t_s, here_m, yaw_rad))
        stage.on_vehicle_gnss(vehicle(t_s, antenna_m(here_m, yaw_rad), None))
    cue = stage.on_gnss(drone(2.0, np.array([12.0, -5.0, 9.0]) + here_m))
    assert cue is not None
    assert cue.kind is CueKind.POSITION
    assert cue.value_m == pytest.approx([12.0, -5.0, 9.0], abs=0.05)


def test_a_new_frame_map_has_another_north():
    stage = RelativeCues()
    stage.on_motion(motion(0.0, (0.0, 0.0, 0.0)))
    stage.on_vehicle_gnss(vehicle(0.0))
    stage.on_motion(motion(3.0, (0.0, 0.0, 0.0)))  # an odometry may have restarted during the gap
    stage.on_vehicle_gnss(vehicle(3.0, yaw_map_rad=None))
    cue = stage.on_gnss(drone(3.0, (12.0, -5.0, 9.0)))
    assert cue is not None
    assert cue.kind is CueKind.LEVEL_AND_HEIGHT


def test_a_receiver_that_reports_a_larger_error_is_used_with_it():
    stage = RelativeCues()
    stage.on_vehicle_gnss(replace(vehicle(0.0, yaw_map_rad=None), sigma_m=4.0, sigma_up_m=7.0))
    cue = stage.on_gnss(replace(drone(0.0, (12.0, -5.0, 9.0)), sigma_m=3.0, sigma_up_m=5.0))
    assert cue is not None
    assert cue.bias_covariance_m2 == pytest.approx(np.diag([4.0**2 + 3.0**2, 7.0**2 + 5.0**2]))
