"""Preflight checks of the vehicle's own odometry on poses made by hand."""

from __future__ import annotations

import json

import numpy as np

from flow.link import Record
from links.preflight.check_result import Level
from links.preflight.observations import Observations
from links.vehicle_odometry import VehicleOdometry
from links.vehicle_odometry.checks import VehicleOdometryChecks, odometry_check
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import VehicleMotion
from tests.links.preflight.observed import BEGIN_NS, observe


def test_odometry_may_be_missing_without_a_port():
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()
    poses = [Record("/vehicle/odometry", BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000, pose) for k in range(40)]
    old = [Record(r.topic, r.arrival_ns + 300_000_000, r.stamp_ns, r.data) for r in poses]
    link, unset = VehicleOdometry(port=14600), VehicleOdometry()
    assert odometry_check(observe(unset, []), unset).level is Level.WARNING
    assert odometry_check(observe(link, []), link).level is Level.FAIL
    assert odometry_check(observe(link, poses), link).level is Level.OK
    assert odometry_check(observe(link, old), link).level is Level.WARNING
    noise = [Record("/vehicle/odometry", r.arrival_ns, r.stamp_ns, b"{}") for r in poses]
    assert odometry_check(observe(VehicleOdometry(port=14600), noise), link).level is Level.FAIL


def test_an_odometry_that_stopped_sending_fails():
    later_ns = BEGIN_NS + 5_000_000_000
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()
    poses = [Record("/vehicle/odometry", BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000, pose) for k in range(40)]
    link = VehicleOdometry(port=14600)
    stopped = odometry_check(observe(link, poses, end_ns=later_ns), link)
    assert stopped.level is Level.FAIL
    assert "is its sender still running?" in stopped.sentence


def test_an_odometry_without_roll_and_pitch_is_reported():
    def motion(R):
        return VehicleMotion(stamp_ns=0, xyz_map_m=np.zeros(3), R_map_vehicle=R, covariance=None)

    turned, tilted = motion(rotation_z(0.3)), motion(exp_rotation(np.array([1e-4, 0.0, 0.0])))
    link = VehicleOdometry(port=14600)
    source = observe(link, [])
    for motions, level in (([turned, motion(np.eye(3))], True), ([turned, tilted], False), ([], False)):
        seen = Observations(sources=(source,), messages={VehicleMotion: motions}, live=True)
        sentences = [result.sentence for result in VehicleOdometryChecks().check_source(source, seen)]
        assert any("fuse.errors.vehicle_tilt_deg_per_mps2" in sentence for sentence in sentences) == level
