"""Fused poses read back from a run's folder, and their errors against the truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flow.link import Record, Run
from links.runs.fused_poses import read_fused_poses
from links.runs.results import POSE_COVARIANCE_FILE, POSE_FILE, Results
from links.runs.truth import TruthLog
from stages.fuse.map_frame import MapFrame
from stages.fuse.pose_message import MapEstimate, Status, lost, pose
from stages.geometry.frames import rotation_z
from stages.messages import PoseState

S = 1_000_000_000


def status(state, track_id=1):
    return Status(state, f"why {state.name}", 2 * S, track_id, 0, 1.5, rotation_ns=2 * S)


def made(t_s, R=None, state=PoseState.FULL, xyz=(1.0, 2.0, 3.0), variances=(0.001, 0.002, 0.003, 0.01, 0.02, 0.03)):
    known = MapEstimate(round(t_s * S), R, np.array(xyz), np.diag(variances), np.zeros(3), np.eye(3))
    return pose(known, status(state), MapFrame(parked=True))


def true_pose(topic, t_s, xyz, yaw_rad):
    q = [0.0, 0.0, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)]
    stamp_ns = round(t_s * S)
    return Record(topic, stamp_ns, stamp_ns, json.dumps({"xyz_m": list(xyz), "quaternion_xyzw": q}).encode())


@pytest.fixture
def read(tmp_path):
    def write(messages, truth=()):
        results, log = Results(yaw="measured"), TruthLog()
        results.open(Run(tmp_path, "made", "", ""))
        for message in messages:
            results.see("fuse.relative_pose", message, message.stamp_ns)
        results.close()
        log.add_all(truth)
        return read_fused_poses(tmp_path, log)

    return write


def test_position_and_rotation_are_compared_with_the_truth_between_its_samples(read):
    """The vehicle is turned by 90 deg and moved; truth at 1.00 and 1.04 s, the pose in their middle."""
    truth = [
        record
        for t_s, yaw_rad, x_m in ((1.0, 0.4, 0.8), (1.04, 0.6, 1.0))
        for record in (
            true_pose("/truth/vehicle", t_s, (5, 5, 0), np.pi / 2),
            true_pose("/truth/drone", t_s, (5 - 2.0, 5 + x_m, 3.0), np.pi / 2 + yaw_rad),
        )
    ]
    poses = read([made(1.02, rotation_z(0.53))], truth)
    assert np.allclose(poses.error_m, [[0.1, 0.0, 0.0]], atol=1e-5)
    assert poses.angle_rad == pytest.approx([0.03], abs=1e-4)
    assert poses.yaw_rad == pytest.approx([0.53], abs=1e-5)
    assert poses.sigma_m == pytest.approx([0.06**0.5])
    assert poses.sigma_rad == pytest.approx([0.006**0.5])
    assert poses.nees == pytest.approx([0.1**2 * (np.cos(0.53) ** 2 / 0.01 + np.sin(0.53) ** 2 / 0.02)], rel=1e-3)
    assert poses.has_truth
    assert poses.inside_95 == 1.0


def test_what_is_not_known_is_nan(read):
    truth = [true_pose("/truth/vehicle", 1.0, (0, 0, 0), 0), true_pose("/truth/drone", 1.0, (1, 2, 3), 0)]
    poses = read([made(1.0, state=PoseState.POSITION_ONLY), made(9.0, rotation_z(0.1))], truth)
    assert poses.state.tolist() == ["POSITION_ONLY", "FULL"]
    assert poses.full.tolist() == [False, True]
    assert np.isnan(poses.yaw_rad).tolist() == [True, False]
    assert np.isnan(poses.sigma_rad).tolist() == [True, False]
    assert np.isnan(poses.distance_m).tolist() == [False, True]
    assert np.isnan(poses.angle_rad).all()


def test_each_track_is_compared_with_the_drone_that_it_follows(read):
    truth = [true_pose("/truth/vehicle", 1.0, (0, 0, 0), 0)]
    truth += [true_pose("/truth/drone", 1.0, (1, 2, 3), 0), true_pose("/truth/drone_2", 1.0, (9, 2, 3.5), 0.2)]
    poses = read([made(1.0, rotation_z(0.1), xyz=(9.0, 2.0, 3.0))], truth)
    assert np.allclose(poses.error_m, [[0, 0, -0.5]])
    assert poses.angle_rad == pytest.approx([0.1], abs=1e-5)


def test_without_a_position_without_truth_and_with_files_that_are_cut_off(read, tmp_path):
    assert read([]) is None
    assert read([lost(S, status(PoseState.LOST))]) is None
    poses = read([made(1.0, rotation_z(0.5))])
    assert not poses.has_truth
    (tmp_path / POSE_FILE).write_text("# head\n1.0 2 3\n")
    assert read_fused_poses(tmp_path, TruthLog()) is None


def test_columns_are_found_by_their_names(read, tmp_path):
    before = read([made(1.0, rotation_z(0.5)), made(1.1, state=PoseState.POSITION_ONLY)])
    table = tmp_path / POSE_COVARIANCE_FILE
    lines = [line.split(",")[::-1] for line in table.read_text().splitlines()]
    table.write_text(
        "".join(",".join(["new", *line] if k == 0 else ["7", *line]) + "\n" for k, line in enumerate(lines))
    )
    after = read_fused_poses(tmp_path, TruthLog())
    assert after is not None
    assert after.state.tolist() == before.state.tolist()
    for name in ("stamps_ns", "sigma_m", "sigma_rad", "yaw_rad"):
        assert np.array_equal(getattr(after, name), getattr(before, name), equal_nan=True)
