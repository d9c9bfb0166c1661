"""Fused poses in the folder of a run: a line per pose, unknown rotations marked, states in the log."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest

from flow.link import Run
from links.evaluation.run_data import OutputKind, read_output
from links.mavlink.poses.gate import PoseLimits
from links.runs.results import POSE_COVARIANCE_FILE, POSE_FILE, UNKNOWN_RAD2, Results
from stages.fuse.map_frame import MapFrame
from stages.fuse.pose_message import MapEstimate, Status, lost, pose
from stages.geometry.frames import quaternions_xyzw, rotation_z
from stages.messages import DroneFix, PoseState, RelativePose, SweptPulses

S = 1_000_000_000
FULL, POSITION_ONLY = PoseState.FULL, PoseState.POSITION_ONLY


def status(state, resets=0, track_id=1):
    return Status(state, f"why {state.name}", 2 * S, track_id, resets, 1.5, rotation_ns=2 * S)


def made(t_s, R=None, state=FULL, xyz=(1.0, 2.0, 3.0), variances=(0.001, 0.002, 0.003, 0.01, 0.02, 0.03)):
    known = MapEstimate(round(t_s * S), R, np.array(xyz), np.diag(variances), np.zeros(3), np.eye(3))
    return pose(known, status(state), MapFrame(parked=True))


@pytest.fixture
def run(tmp_path):
    def write(messages):
        results = Results(yaw="measured")
        results.open(Run(tmp_path, "made", "", ""))
        for message in messages:
            results.see("fuse.relative_pose", message, message.stamp_ns)
        results.close()
        return tmp_path

    return write


def test_a_pose_is_a_line_of_both_files_and_reads_back(run):
    R = rotation_z(0.5)
    folder = run([made(1.0, R), made(1.02, R, xyz=(1.1, 2.0, 3.0))])
    back = read_output(OutputKind.POSE, folder)
    assert back.poses.stamps_ns.tolist() == [S, 1_020_000_000]
    assert np.allclose(back.poses.xyz_m, [[1, 2, 3], [1.1, 2, 3]])
    assert np.allclose(back.poses.quaternion_xyzw, quaternions_xyzw(np.array([R, R])), atol=1e-5)
    assert np.allclose(back.covariance[0], np.diag([0.001, 0.002, 0.003, 0.01, 0.02, 0.03]))
    assert back.sendable.tolist() == [True, True]


def test_each_pose_has_the_number_of_its_drone(run):
    known = [
        MapEstimate(t * S, None, np.array([x, 2.0, 3.0]), np.eye(6), np.zeros(3), np.eye(3))
        for t, x in ((1, 1), (2, 30))
    ]
    parked = MapFrame(parked=True)
    folder = run([pose(one, status(POSITION_ONLY, track_id=k), parked) for k, one in enumerate(known, start=1)])
    back = read_output(OutputKind.POSE, folder)
    assert back.track.tolist() == [1, 2]


def test_a_pose_without_rotation_is_marked_and_its_variance_is_no_infinity(run):
    folder = run([made(1.0, state=POSITION_ONLY), made(1.02, rotation_z(0.5))])
    back = read_output(OutputKind.POSE, folder)
    assert back.sendable.tolist() == [False, True]
    assert np.allclose(np.diag(back.covariance[0])[:3], UNKNOWN_RAD2)
    assert np.allclose(np.diag(back.covariance[0])[3:], [0.01, 0.02, 0.03])
    rows = list(csv.DictReader((folder / POSE_COVARIANCE_FILE).open()))
    assert [row["state"] for row in rows] == ["POSITION_ONLY", "FULL"]
    assert rows[0]["measured_s"] == "2.000000000"
    assert (folder / POSE_FILE).read_text().splitlines()[1].endswith(" 0 0 0 1")


def test_poses_that_the_gate_rejects_are_counted_by_reason(tmp_path):
    results = Results(yaw="measured")
    results.open(Run(tmp_path, "made", "", ""))
    messages = [
        lost(S, status(PoseState.LOST)),
        *[made(t, state=POSITION_ONLY) for t in (1.02, 1.04)],
        made(1.06, rotation_z(0.5)),
    ]
    for message in messages:
        results.see("fuse.relative_pose", message, message.stamp_ns)
    results.close()
    assert results.gate_rejections == {"rotation unknown": 2, "no position": 1}


def test_a_pose_is_good_when_the_autopilot_gate_accepts_it(tmp_path):
    R, wide, askew = rotation_z(0.5), (0.001,) * 3 + (0.01, 0.01, 0.16), (0.001, 0.001, 0.01, 0.01, 0.01, 0.01)
    for limits, expected in (
        (PoseLimits(), [True, False, False]),
        (PoseLimits(position_sigma_m=0.5), [True, True, False]),
    ):
        results = Results(limits=limits, yaw="measured")
        results.open(Run(tmp_path, "made", "", ""))
        for message in (made(1.0, R), made(1.02, R, variances=wide), made(1.04, R, variances=askew)):
            results.see("fuse.relative_pose", message, message.stamp_ns)
        results.close()
        rows = list(csv.DictReader((tmp_path / POSE_COVARIANCE_FILE).open()))
        assert [row["accepted"] == "1" for row in rows] == expected
        assert [row["rotation"] for row in rows] == ["1"] * 3


def test_a_lost_drone_has_no_line_and_the_log_has_each_change(run):
    R = np.eye(3)
    messages = [lost(S, status(PoseState.LOST)), made(1.02, R), made(1.04, R), lost(2 * S, status(PoseState.LOST))]
    folder = run(messages)
    assert len((folder / POSE_FILE).read_text().splitlines()) == 2 + 1
    lines = [line for line in (folder / "run.log").read_text().splitlines() if "fuse.relative_pose" in line]
    assert [line.split(": ", 1)[1] for line in lines] == ["LOST: why LOST", "FULL: why FULL", "LOST: why LOST"]


def test_a_run_without_fusion_has_no_poses_and_removes_old_ones(run):
    folder = run([made(1.0, np.eye(3))])
    assert (folder / POSE_FILE).exists()
    run([])
    assert not (folder / POSE_FILE).exists()
    assert not (folder / POSE_COVARIANCE_FILE).exists()


def test_a_number_that_is_not_known_is_empty(run):
    message = made(1.0, np.eye(3))
    object.__setattr__(message, "nis", math.nan)
    object.__setattr__(message, "measured_ns", None)
    folder = run([message])
    row = next(csv.DictReader((folder / POSE_COVARIANCE_FILE).open()))
    assert (row["nis"], row["measured_s"]) == ("", "")


def test_poses_are_counted_by_state_and_their_jumps_reported(tmp_path):
    results = Results(yaw="measured")
    results.open(Run(tmp_path, "made", "", ""))
    assert results.pose_states == {}
    unknown = pose(
        MapEstimate(S, None, np.ones(3), np.eye(6), np.zeros(3), np.eye(3)),
        status(POSITION_ONLY),
        MapFrame(parked=True),
    )
    turned = MapEstimate(2 * S, rotation_z(0.5), np.ones(3), np.eye(6), np.zeros(3), np.eye(3))
    for message in (unknown, *[pose(turned, status(FULL, resets=1), MapFrame(parked=True))] * 2):
        results.see("fuse.relative_pose", message, message.stamp_ns)
    results.close()
    assert results.pose_states == {"FULL": 2, "POSITION_ONLY": 1}
    assert results.resets == 1


@pytest.mark.parametrize(("kind", "wanted"), [(RelativePose, True), (DroneFix, True), (SweptPulses, False)])
def test_a_live_run_passes_on_only_the_contents_of_the_files(kind, wanted):
    assert Results(yaw="measured").wants(kind) is wanted
