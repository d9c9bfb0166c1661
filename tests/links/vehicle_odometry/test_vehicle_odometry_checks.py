"""Preflight checks of the vehicle's own odometry on poses made by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flow.link import Record
from links.preflight.check_result import Level
from links.preflight.observations import Observations
from links.udp import WRONG_AGE
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
    assert "is its sender still running" in stopped.sentence


def sent(text: dict[str, object], period_ns: int = 50_000_000, count: int = 40) -> list[Record]:
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]} | text).encode()
    return [Record("/vehicle/odometry", BEGIN_NS + k * period_ns, BEGIN_NS + k * period_ns, pose) for k in range(count)]


def test_gaps_wrong_ages_and_a_vehicle_on_its_roof_are_named():
    link = VehicleOdometry(port=14600)
    gaps = odometry_check(observe(link, sent({}, 800_000_000)), link)
    assert gaps.level is Level.FAIL
    assert "no pose for 0.8 s, and 0.7 s after a pose the vehicle's motion is unknown" in gaps.sentence
    aged = odometry_check(observe(link, sent({}), counters={WRONG_AGE: 20}), link)
    assert aged.level is Level.WARNING
    assert "20 poses with an age_s that is not from -0.02 to 1 s" in aged.sentence
    none = odometry_check(observe(link, [], counters={WRONG_AGE: 20}), link)
    assert none.level is Level.FAIL
    assert "check age_s and the sender's clock" in none.sentence
    assert "port: null" not in none.sentence, "the sender is running"
    on_its_roof = odometry_check(observe(link, sent({"quaternion_xyzw": [0.9659, 0.0, 0.0, 0.2588]})), link)
    assert on_its_roof.level is Level.FAIL
    assert "is the quaternion x, y, z, w, and z up" in on_its_roof.sentence


def test_of_some_poses_on_the_roof_the_order_of_the_quaternion_is_asked():
    link = VehicleOdometry(port=14600)
    mixed = odometry_check(observe(link, [*sent({}), *sent({"quaternion_xyzw": [1.0, 0, 0, 0]})]), link)
    assert mixed.level is Level.FAIL
    assert "is the quaternion x, y, z, w, and z up" in mixed.sentence


@pytest.mark.parametrize(
    ("settings", "text", "warned"), [({}, {}, True), ({}, {"age_s": 0.01}, False), ({"latency_s": 0.05}, {}, False)]
)
def test_poses_without_an_age_are_reported(settings, text, warned):
    source = observe(VehicleOdometry(port=14600, **settings), sent(text))
    seen = Observations(sources=(source,), messages={}, live=True)
    sentences = [result.sentence for result in VehicleOdometryChecks().check_source(source, seen)]
    assert any("its poses have no age_s" in sentence for sentence in sentences) == warned


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
