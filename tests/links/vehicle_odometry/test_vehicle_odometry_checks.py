"""Preflight checks of the vehicle's own odometry on poses made by hand."""

from __future__ import annotations

import json

from flow.link import Record
from links.preflight.check_result import Level
from links.vehicle_odometry import VehicleOdometry
from links.vehicle_odometry.checks import odometry_check
from tests.links.preflight.observed import BEGIN_NS, observe


def test_the_vehicles_odometry_may_be_missing_where_it_has_no_port():
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()
    poses = [Record("/vehicle/odometry", BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000, pose) for k in range(40)]
    old = [Record(r.topic, r.arrival_ns + 300_000_000, r.stamp_ns, r.data) for r in poses]
    there, none = VehicleOdometry(port=14600), VehicleOdometry()
    assert odometry_check(observe(none, []), none).level is Level.WARNING
    assert odometry_check(observe(there, []), there).level is Level.FAIL
    assert odometry_check(observe(there, poses), there).level is Level.OK
    assert odometry_check(observe(there, old), there).level is Level.WARNING
    noise = [Record("/vehicle/odometry", r.arrival_ns, r.stamp_ns, b"{}") for r in poses]
    assert odometry_check(observe(VehicleOdometry(port=14600), noise), there).level is Level.FAIL


def test_an_odometry_that_stopped_sending_is_no_go():
    later_ns = BEGIN_NS + 5_000_000_000
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()
    poses = [Record("/vehicle/odometry", BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000, pose) for k in range(40)]
    there = VehicleOdometry(port=14600)
    died = odometry_check(observe(there, poses, end_ns=later_ns), there)
    assert died.level is Level.FAIL
    assert "is its sender still running?" in died.sentence
