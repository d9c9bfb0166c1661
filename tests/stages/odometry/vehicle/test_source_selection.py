"""Odometry while it is available, otherwise the camera's ego-motion: one path without a jump."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.geometry.frames import rotation_z, transform
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import MotionStatus, VehicleMotion
from stages.odometry.vehicle import VehicleMotionSelector
from tests.stages.odometry.vehicle.test_static_scan import WALLS, SimulatedLidar, slices

S = 1_000_000_000


def at(time_s):
    """T_world_vehicle at a constant turn rate: 3 m/s forward, 0.2 rad/s to the left."""
    yaw, radius = 0.2 * time_s, 15.0
    return transform(rotation_z(yaw), np.array([radius * math.sin(yaw), radius * (1 - math.cos(yaw)), 0.0]))


def pose(time_s, T_source_world=None, sigma=0.0):
    """A pose of a source, in its own start frame. `sigma`: metres and rad, each axis."""
    T = (np.eye(4) if T_source_world is None else T_source_world) @ at(time_s)
    covariance = None if sigma is None else sigma**2 * np.eye(6)
    return VehicleMotion(stamp_ns=round(time_s * S), xyz_map_m=T[:3, 3], R_map_vehicle=T[:3, :3], covariance=covariance)


OTHER_START = transform(rotation_z(2.0), np.array([40.0, -7.0, 1.0]))
NEW_START = transform(rotation_z(-1.0), np.array([-3.0, 9.0, 0.0]))
FAR = transform(rotation_z(-1.0), np.array([-300.0, 90.0, 0.0]))


def published(selector, odometry=(), ego=()):
    """All poses published, of inputs in order of arrival; ego-motion arrives 0.1 s after its stamp."""
    arrivals = [(m.stamp_ns, selector.on_odometry, m) for m in odometry]
    arrivals += [(m.stamp_ns + S // 10, selector.on_ego, m) for m in ego]
    out = [on_port(m) for _, on_port, m in sorted(arrivals, key=lambda w: w[0])]
    return [m for m in out if m is not None]


def off(motion, T_start_world):
    """Metres and rad between a motion and the truth."""
    T = T_start_world @ at(motion.stamp_ns / S)
    turned = motion.R_map_vehicle.T @ T[:3, :3]
    return np.linalg.norm(motion.xyz_map_m - T[:3, 3]), math.acos(min(1.0, (np.trace(turned) - 1) / 2))


def seconds(first, last, step):
    return np.arange(round((last - first) / step)) * step + first


def test_odometry_alone_is_passed_on_unchanged():
    poses = [pose(t, OTHER_START) for t in seconds(0, 1, 0.02)]
    out = published(VehicleMotionSelector(), odometry=poses)
    assert [m.stamp_ns for m in out] == [m.stamp_ns for m in poses]
    for m, w in zip(out, poses, strict=True):
        np.testing.assert_allclose(m.xyz_map_m, w.xyz_map_m, atol=1e-12)
        np.testing.assert_allclose(m.R_map_vehicle, w.R_map_vehicle, atol=1e-12)
        np.testing.assert_allclose(m.covariance, w.covariance)
        check_arrays(m)


def test_the_camera_alone_is_passed_on():
    poses = [pose(t, OTHER_START) for t in seconds(0, 2, 0.2)]
    out = published(VehicleMotionSelector(), ego=poses)
    assert len(out) == len(poses)
    np.testing.assert_allclose(out[-1].xyz_map_m, poses[-1].xyz_map_m, atol=1e-12)


def test_ego_motion_is_ignored_while_the_odometry_is_available():
    selector = VehicleMotionSelector()
    out = published(
        selector, odometry=[pose(t) for t in seconds(0, 2, 0.02)], ego=[pose(t, NEW_START) for t in seconds(0, 2, 0.2)]
    )
    assert len(out) == 100
    assert max(off(m, np.eye(4))[0] for m in out) < 1e-9


def test_odometry_that_returns_with_a_new_start_frame_continues_in_its_first_frame():
    odometry = [pose(t, OTHER_START) for t in seconds(0, 3, 0.02)] + [pose(t, NEW_START) for t in seconds(6, 9, 0.02)]
    ego = [pose(t) for t in seconds(3.3, 6.0, 0.2)]
    out = published(VehicleMotionSelector(), odometry, ego)
    stamps = np.array([m.stamp_ns for m in out]) / S
    assert ((stamps > 3.2) & (stamps < 6.0)).sum() == len(ego) - 1  # the last one arrives when the odometry is back
    assert np.diff(stamps).max() < 0.5
    errors = np.array([off(m, OTHER_START) for m in out])
    assert errors[:, 0].max() < 1e-3  # two changes: constant motion is extrapolated over both gaps
    assert errors[:, 1].max() < 1e-3


def test_the_camera_first_then_odometry_keeps_the_cameras_frame():
    out = published(
        VehicleMotionSelector(),
        odometry=[pose(t, NEW_START) for t in seconds(2.05, 3, 0.02)],
        ego=[pose(t, OTHER_START) for t in seconds(0, 2, 0.2)],
    )
    errors = np.array([off(m, OTHER_START) for m in out])
    assert errors[:, 0].max() < 1e-3
    assert out[-1].stamp_ns > 2.9 * S


@pytest.mark.parametrize("gap_s", [0.0, 0.2, 2.0])
@pytest.mark.parametrize("port", ["odometry", "ego"])
def test_a_source_whose_own_frame_jumps_leaves_one_path(port, gap_s):
    step_s = 0.02 if port == "odometry" else 0.2
    poses = [pose(t, OTHER_START) for t in seconds(0, 3, step_s)]
    poses += [pose(t, FAR) for t in seconds(3 + gap_s, 8, step_s)]
    out = published(VehicleMotionSelector(), **{port: poses})
    errors = np.array([off(m, OTHER_START) for m in out])
    assert errors[:, 0].max() < (5.0 if gap_s == 2.0 else 1e-3)  # after a second its position is unknown
    assert errors[:, 1].max() < (0.5 if gap_s == 2.0 else 1e-3)
    assert len(poses) - len(out) == 2  # are left out
    assert max(np.linalg.norm(b.xyz_map_m - a.xyz_map_m) for a, b in pairwise(out)) < 4.5


def test_an_uncertain_source_change_increases_the_covariance():
    selector = VehicleMotionSelector()
    poses = [pose(t, sigma=0.01) for t in seconds(0, 1, 0.02)] + [
        pose(t, NEW_START, 0.01) for t in seconds(1.4, 2, 0.02)
    ]
    out = published(selector, odometry=poses)
    place_m = math.hypot(0.01, 0.5 * 3.0 * (1.4 - 0.98) ** 2)
    assert math.sqrt(out[50].covariance[5, 5]) == pytest.approx(place_m, rel=1e-3)


def test_an_outlier_is_rejected():
    poses = [pose(t, NEW_START if 40 <= k < 42 else None) for k, t in enumerate(seconds(0, 2, 0.02))]
    out = published(VehicleMotionSelector(), odometry=poses)
    assert len(out) == len(poses) - 2
    assert max(off(m, np.eye(4))[0] for m in out) < 1e-9


def outliers(times, seed=0, spread_m=30.0):
    """Poses of a failed odometry: random positions and rotations."""
    rng = np.random.default_rng(seed)
    return [
        pose(t, transform(rotation_z(rng.uniform(-3, 3)), np.append(rng.uniform(-spread_m, spread_m, 2), 0.0)))
        for t in times
    ]


def test_the_camera_continues_while_the_odometry_gives_outliers_which_are_counted():
    selector = VehicleMotionSelector()
    jumped, ego = outliers(seconds(2, 6, 0.02)), [pose(t, OTHER_START) for t in seconds(2.4, 6, 0.2)]
    out = published(selector, [pose(t) for t in seconds(0, 2, 0.02)] + jumped, ego)
    assert np.diff([m.stamp_ns for m in out]).max() < 0.5 * S
    assert [m.stamp_ns for m in out[100:]] == [m.stamp_ns for m in ego]
    assert max(off(m, np.eye(4))[0] for m in out) < 1e-3
    assert selector.rejected == {"odometry: not reachable from the poses before": len(jumped)}
    back = [selector.on_odometry(pose(t, NEW_START)) for t in (6.0, 6.02, 6.04, 6.06)]
    assert [m is None for m in back] == [True, True, False, False]  # three that agree
    assert off(back[-1], np.eye(4))[0] < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_outliers_are_never_accepted_without_a_camera(seed):
    selector = VehicleMotionSelector()
    out = published(selector, [pose(t) for t in seconds(0, 2, 0.02)] + outliers(seconds(2, 12, 0.02), seed))
    assert len(out) == 100
    sane = [selector.on_odometry(pose(t)) for t in seconds(12, 13, 0.02)]
    assert max(off(m, np.eye(4))[0] for m in sane if m is not None) < 1e-9  # in the frame of before
    assert sum(m is None for m in sane) == 2


def test_a_gap_in_the_odometry_of_a_fast_vehicle_is_no_jump():
    times = [*seconds(0, 1, 0.02), *seconds(3, 4, 0.02)]
    poses = [dataclasses.replace(pose(t), xyz_map_m=np.array([30 * t, 0, 0]), R_map_vehicle=np.eye(3)) for t in times]
    out = published(VehicleMotionSelector(), odometry=poses)
    assert [m.xyz_map_m[0] for m in out] == pytest.approx([30 * t for t in times])


def test_a_pose_not_newer_than_the_published_one_is_rejected():
    selector = VehicleMotionSelector()
    assert selector.on_odometry(pose(1.0)) is not None
    assert selector.on_odometry(pose(1.0)) is None
    assert selector.on_odometry(pose(0.9)) is None
    assert selector.on_ego(pose(0.95)) is None


def test_uncertainty_grows_over_a_gap_and_then_with_the_new_source():
    selector = VehicleMotionSelector()
    for t in seconds(0, 1, 0.02):
        selector.on_odometry(pose(t, sigma=0.01))
    first = selector.on_ego(pose(2.0, NEW_START, sigma=0.5))
    there = pose(2.0, NEW_START)
    standing = dataclasses.replace(there, stamp_ns=2_200_000_000, covariance=0.6**2 * np.eye(6))
    second = selector.on_ego(standing)
    gap_s = 2.0 - 0.98
    place = math.hypot(0.01, 0.5 * 3.0 * gap_s**2)
    np.testing.assert_allclose(np.sqrt(np.diag(first.covariance))[3:], place, rtol=1e-6)
    np.testing.assert_allclose(second.covariance, first.covariance + (0.6**2 - 0.5**2) * np.eye(6), atol=1e-9)


def test_a_source_without_covariance_gives_none():
    selector = VehicleMotionSelector()
    assert selector.on_odometry(pose(0.0, sigma=None)).covariance is None
    assert selector.on_ego(pose(1.0)).covariance is None
    assert selector.on_odometry(pose(1.1, sigma=0.1)).covariance is None


def test_its_ports_are_the_two_sources_and_one_motion():
    assert set(input_ports(VehicleMotionSelector)) == {"odometry", "ego", "pulses"}
    assert set(output_ports(VehicleMotionSelector)) == {"vehicle_motion"}
    with pytest.raises(ValidationError):
        VehicleMotionSelector(silent_s=0.0)


def frozen_at(time_s, frozen_s):
    """The pose of the bend at a time, repeated from `frozen_s` on."""
    return dataclasses.replace(pose(min(time_s, frozen_s)), stamp_ns=round(time_s * S))


def test_a_frozen_odometry_is_denied_and_its_repeated_poses_are_withdrawn():
    selector = VehicleMotionSelector()
    out = published(selector, odometry=[frozen_at(t, 2.0) for t in seconds(0, 6, 0.02)])
    assert [m.status for m in out].count(MotionStatus.DENIED) == 1
    denied = out[-1]
    assert denied.status is MotionStatus.DENIED
    assert denied.stamp_ns <= 2.04 * S, "the last credible pose"
    assert out[-2].stamp_ns <= 2.2 * S, "nothing after the detection"
    assert selector.counters["rejected: odometry: frozen"] > 180
    trajectory = VehicleTrajectory()
    for motion in out:
        trajectory.add(motion)
    assert np.linalg.norm(trajectory.at(round(2.3 * S))[1] - at(2.3)[:3, 3]) < 0.2, "extrapolated with its speed"
    assert not trajectory.known_at(round(2.8 * S))


def test_a_frozen_odometry_is_replaced_by_the_ego_motion_and_used_again_when_it_moves():
    odometry = [frozen_at(t, 2.0) if t < 4 else pose(t) for t in seconds(0, 8, 0.02)]
    out = published(VehicleMotionSelector(), odometry=odometry, ego=[pose(t, OTHER_START) for t in seconds(0, 8, 0.2)])
    accepted = [m for m in out if m.status is MotionStatus.ACCEPTED]
    assert sum(2.3 * S < m.stamp_ns < 4 * S for m in accepted) >= 7, "ego-motion"
    assert sum(m.stamp_ns > 5 * S for m in accepted) >= 140, "odometry"
    for motion in accepted:
        if not 2 * S < motion.stamp_ns < 2.2 * S:
            assert off(motion, np.eye(4))[0] < 0.3


def test_an_odometry_that_was_frozen_keeps_its_frame_if_it_moved_on_during_the_freeze():
    odometry = [frozen_at(t, 2.0) if t < 5 else pose(t) for t in seconds(0, 8, 0.02)]
    out = published(VehicleMotionSelector(), odometry=odometry)
    after = [m for m in out if m.stamp_ns > 5 * S]
    assert len(after) > 140
    assert max(off(m, np.eye(4))[0] for m in after) < 1e-9


def test_an_odometry_that_missed_the_path_during_the_freeze_gets_a_new_frame():
    missed = [dataclasses.replace(pose(t - 3.0), stamp_ns=round(t * S)) for t in seconds(5, 8, 0.02)]
    out = published(VehicleMotionSelector(), odometry=[frozen_at(t, 2.0) for t in seconds(0, 5, 0.02)] + missed)
    after = [m for m in out if m.stamp_ns > 5 * S]
    assert np.linalg.norm(after[0].xyz_map_m - at(2.0)[:3, 3]) > 2.0, "extrapolated over a second at 3 m/s"


def test_a_frozen_ego_motion_or_parked_vehicle_is_not_denied():
    still = [frozen_at(t, 0.0) for t in seconds(0, 20, 0.02)]
    assert all(m.status is MotionStatus.ACCEPTED for m in published(VehicleMotionSelector(), odometry=still))


@pytest.mark.parametrize("model", ["VLP-16", "OS1-32"])
@pytest.mark.parametrize(("reported", "denied"), [(1.0, 0), (0.0, 1), (1.2, 1)])
def test_an_odometry_that_contradicts_the_lidar_is_denied(reported, denied, model):
    unit = SimulatedLidar.model_validate({"model": model})
    selector, out = VehicleMotionSelector(unit=unit), []
    for pulses, (_, at_m) in slices(5.0, 2.0, WALLS, unit=unit):
        last_ns = int(pulses.point_stamp_ns[-1])
        motion = VehicleMotion(stamp_ns=last_ns, xyz_map_m=reported * at_m, R_map_vehicle=np.eye(3), covariance=None)
        out += [selector.on_odometry(motion), selector.on_pulses(pulses)]
    states = [m.status for m in out if m is not None]
    assert states.count(MotionStatus.DENIED) == denied
    assert (states[-1] is MotionStatus.DENIED) == bool(denied), "nothing is published afterwards"
