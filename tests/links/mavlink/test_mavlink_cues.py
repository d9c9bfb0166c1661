"""GPS_RAW_INT, GLOBAL_POSITION_INT and DISTANCE_SENSOR as cues: units, what is refused, and what echoes our pose."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.mavlink import Autopilot
from stages.messages import DroneGlobalPosition, DroneGnss, UwbRange
from tests.links.mavlink.test_mavlink_autopilot import HOST0, MS, Sender, record

mavlink: Any = ardupilotmega
LAT, LON, ALT = 356_600_000, 1_397_000_000, 52_500


def gps(boot_ms: int = 1000, fix: int = 3, h_acc: int = 0) -> Any:
    unknown = 65_535
    return mavlink.MAVLink_gps_raw_int_message(
        1000 * boot_ms, fix, LAT, LON, ALT, unknown, unknown, unknown, unknown, 12, 0, h_acc, 0
    )


def position(boot_ms: int = 1000) -> Any:
    return mavlink.MAVLink_global_position_int_message(boot_ms, LAT, LON, ALT, 12_250, 0, 0, 0, 65_535)


def distance(boot_ms: int = 1000, kind: int = 4, orientation: int = 100, cm: int = 1725, covariance: int = 100) -> Any:
    return mavlink.MAVLink_distance_sensor_message(boot_ms, 20, 10_000, cm, kind, 3, orientation, covariance)


def test_a_receivers_position_has_its_units_and_the_reported_accuracy():
    sender, autopilot = Sender(), Autopilot()
    gnss = autopilot.decode(record(sender.frame(gps(h_acc=1500))))
    assert isinstance(gnss, DroneGnss)
    assert math.degrees(gnss.latitude_rad) == pytest.approx(35.66)
    assert math.degrees(gnss.longitude_rad) == pytest.approx(139.7)
    assert (gnss.altitude_m, gnss.sigma_m, gnss.sigma_up_m) == (52.5, 1.5, None)


def test_a_receiver_without_a_3d_fix_or_at_the_null_island_is_rejected():
    sender, autopilot = Sender(), Autopilot()
    assert autopilot.decode(record(sender.frame(gps(fix=2)))) is None
    null = gps(boot_ms=1200)
    null.lat = null.lon = 0
    assert autopilot.decode(record(sender.frame(null), 200.0)) is None
    assert sum(autopilot.counters.rejected.values()) == 2


def test_the_autopilots_position_is_marked_once_a_pose_was_sent_and_the_receivers_never_is():
    sender, autopilot = Sender(), Autopilot()
    before = autopilot.decode(record(sender.frame(position())))
    assert isinstance(before, DroneGlobalPosition)
    assert (before.independent, before.altitude_above_home_m) == (True, 12.25)
    pose = mavlink.MAVLink_odometry_message(
        0, 20, 12, 1.0, 2.0, 3.0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0.0] * 21, [0.0] * 21, 0, 0, 0
    )
    at_ns = HOST0 + 100 * MS
    autopilot.decode(Record("/autopilot/tx", at_ns, at_ns, Sender(component=197).frame(pose)))
    after = autopilot.decode(record(sender.frame(position(1200)), 200.0))
    assert isinstance(after, DroneGlobalPosition)
    assert not after.independent
    assert isinstance(autopilot.decode(record(sender.frame(gps(1300)), 300.0)), DroneGnss)


def test_only_a_distance_of_a_ranging_radio_is_a_range():
    sender, autopilot = Sender(), Autopilot()
    uwb = autopilot.decode(record(sender.frame(distance())))
    assert isinstance(uwb, UwbRange)
    assert (uwb.range_m, uwb.sigma_m) == (17.25, pytest.approx(0.1))
    downward = distance(1200, kind=0, orientation=25)
    assert autopilot.decode(record(sender.frame(downward), 200.0)) is None
    assert not autopilot.counters.rejected
    for k, bad in enumerate((distance(1400, cm=5), distance(1500, cm=20_000))):
        assert autopilot.decode(record(sender.frame(bad), 400.0 + 100 * k)) is None
    assert autopilot.counters.rejected == {"distance out of the sensor's range": 2}


def test_the_time_of_a_receiver_without_a_fix_since_long_does_not_set_the_autopilots_clock():
    sender, autopilot = Sender(), Autopilot()
    for k in range(8):
        autopilot.decode(record(sender.attitude(100_000 + 100 * k), 100.0 * k))
    offset_ns = autopilot._decoder.clock.offset_ns
    for k in range(8):
        gnss = autopilot.decode(record(sender.frame(gps(0)), 900.0 + 100 * k))
        assert isinstance(gnss, DroneGnss)
        assert gnss.stamp_ns == HOST0 + round((900.0 + 100 * k) * MS)
    assert autopilot._decoder.clock.offset_ns == offset_ns
    assert autopilot.counters["clock restarts"] == 0
