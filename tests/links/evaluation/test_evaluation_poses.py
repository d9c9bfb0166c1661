"""Metrics of made runs against numbers worked out by hand, and the cases in which an evaluation could flatter."""

from __future__ import annotations

import math
import shutil

import numpy as np
import pytest

from links.evaluation.association import EvaluationLimits
from links.evaluation.evaluation import Evaluation, MetricStatus
from links.evaluation.run_data import OutputKind
from tests.links.evaluation.made_runs import add_pose, evaluated, lines, make_run, truth_at, value, yaw_quaternion

EIGHT_HZ = np.arange(0.0, 10.0, 0.125)


def reason(e: Evaluation, key: str) -> str:
    assert e.values[key].value is None
    return e.values[key].note


def test_a_known_offset_is_the_error_per_axis_and_in_3d(tmp_path):
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + np.array([0.3, -0.4, 1.2])))
    assert [value(e, f"rmse_{axis}_m") for axis in "xyz"] == pytest.approx([0.3, 0.4, 1.2])
    for key in ("rmse_m", "median_m", "p95_m", "max_m", "evo_ape_rmse_m"):
        assert value(e, key) == pytest.approx(1.3)
    assert value(e, "evo_rpe_rmse_m") == pytest.approx(0.0, abs=1e-6)
    assert value(e, "rate_hz") == pytest.approx(8.0)
    assert value(e, "track_accuracy") == 0.0
    assert value(e, "false_share") == 100.0


def test_the_3d_rmse_is_evos(tmp_path):
    noise = np.random.default_rng(1).normal(0, 0.2, (80, 3))
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + noise))
    assert value(e, "rmse_m") == pytest.approx(value(e, "evo_ape_rmse_m"), rel=1e-6)
    assert value(e, "rmse_m") == pytest.approx(math.sqrt(np.mean(np.sum(noise**2, axis=1))), rel=1e-6)


def test_the_last_output_is_held_over_all_time(tmp_path):
    """One exact fix at 2 s while the drone flies on at 1 m/s: after t seconds the error is t, up to 8 m at the end."""
    e = evaluated(make_run(tmp_path / "a", [2.0], truth_at(np.array([2.0]))))
    assert value(e, "rmse_m") == pytest.approx(0.0, abs=1e-6)
    assert value(e, "held_max_m") == pytest.approx(8.0)
    assert value(e, "held_rmse_m") == pytest.approx(8.0 / math.sqrt(3), rel=0.01)
    assert value(e, "before_first_s") == pytest.approx(2.0)
    assert value(e, "first_accurate_s") == pytest.approx(2.0)
    assert value(e, "availability") == pytest.approx(3.0, abs=0.3)
    assert value(e, "longest_gap_s") == pytest.approx(8.0)


@pytest.mark.parametrize(("keep", "gap"), [((0, 4), 6.0), ((6, 10), 6.0), ((0, 10), 0.125)])
def test_the_ends_of_the_recording_count_as_gaps(tmp_path, keep, gap):
    t = EIGHT_HZ[(keep[0] <= EIGHT_HZ) & (keep[1] >= EIGHT_HZ)]
    e = evaluated(make_run(tmp_path / "a", t, truth_at(t)))
    assert value(e, "longest_gap_s") == pytest.approx(gap)


def test_leaving_out_bad_fixes_does_not_improve_the_headline(tmp_path):
    """Fixes go 3 m wrong for 4 s. Leaving them out makes the error of the outputs small, and the headline no better."""
    wrong = (EIGHT_HZ >= 4) & (EIGHT_HZ < 8)
    xyz = truth_at(EIGHT_HZ) + np.where(wrong[:, None], [0.0, 3.0, 0.0], 0.05)
    complete = evaluated(make_run(tmp_path / "all", EIGHT_HZ, xyz))
    partial = evaluated(make_run(tmp_path / "left_out", EIGHT_HZ[~wrong], xyz[~wrong]))
    assert value(partial, "rmse_m") < 0.1 * value(complete, "rmse_m")
    # an accurate time lasts at most max_age longer when the last accurate fix is not followed by another
    assert value(partial, "track_accuracy") <= value(complete, "track_accuracy") + 100 * 0.3 / 10
    assert value(partial, "availability") < value(complete, "availability") - 30
    assert value(partial, "held_max_m") > 3.0
    assert value(partial, "longest_inaccurate_s") > 3.6
    assert value(partial, "rate_hz") < value(complete, "rate_hz")


@pytest.mark.parametrize("kept_share", [0.8, 0.5, 0.2])
def test_dropping_outputs_at_random_never_adds_time(tmp_path, kept_share):
    rng = np.random.default_rng(3)
    keep = rng.random(len(EIGHT_HZ)) < kept_share
    xyz = truth_at(EIGHT_HZ) + rng.normal(0, 0.1, (80, 3))
    whole = evaluated(make_run(tmp_path / "a", EIGHT_HZ, xyz))
    part = evaluated(make_run(tmp_path / "b", EIGHT_HZ[keep], xyz[keep]))
    for key in ("track_accuracy", "availability", "rate_hz"):
        assert value(part, key) <= value(whole, key)
    assert value(part, "longest_gap_s") >= value(whole, "longest_gap_s")
    assert value(part, "held_rmse_m") > value(whole, "held_rmse_m")


def test_no_output_at_all_is_a_failure_everywhere(tmp_path):
    e = evaluated(make_run(tmp_path / "a", [], [], sweeps=[(0.0, 2.6, [])]))
    for key in ("rmse_m", "held_rmse_m", "first_accurate_s", "p95_m", "range_10_rmse_m", "nees_mean"):
        assert e.values[key].failed, key
    assert value(e, "track_accuracy") == value(e, "availability") == 0.0
    assert value(e, "longest_gap_s") == pytest.approx(10.0)
    assert value(e, "detection_rate") == 0.0
    assert e.findings == ["no output at all, though there was a drone"]


def test_turning_the_world_or_renaming_axes_leaves_3d_numbers_alone(tmp_path):
    noise = np.random.default_rng(2).normal(0, 0.2, (80, 3))
    whole = np.arange(0, 10.005, 0.01)
    plain = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + noise))
    order = [2, 0, 1]
    turned = evaluated(
        make_run(tmp_path / "b", EIGHT_HZ, (truth_at(EIGHT_HZ) + noise)[:, order], truth=truth_at(whole)[:, order])
    )
    for key in ("rmse_m", "p95_m", "nees_mean", "inside_95_share", "track_accuracy", "held_rmse_m", "false_outputs"):
        assert value(turned, key) == pytest.approx(value(plain, key), abs=1e-6)
    axes = [value(plain, f"rmse_{a}_m") for a in "xyz"]
    assert [value(turned, f"rmse_{a}_m") for a in "xyz"] == pytest.approx([axes[i] for i in order], abs=1e-6)


def test_errors_grow_with_scale_and_nees_does_not_when_sigma_grows_too(tmp_path):
    noise = np.random.default_rng(4).normal(0, 0.1, (80, 3))
    one = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + noise, sigma_m=0.1))
    two = evaluated(make_run(tmp_path / "b", EIGHT_HZ, truth_at(EIGHT_HZ) + 2 * noise, sigma_m=0.2))
    assert value(two, "rmse_m") == pytest.approx(2 * value(one, "rmse_m"), rel=1e-5)
    assert value(two, "nees_mean") == pytest.approx(value(one, "nees_mean"), rel=1e-5)


@pytest.mark.parametrize(("claimed_m", "nees"), [(0.1, 3.0), (0.05, 12.0), (0.2, 0.75)])
def test_a_wrong_covariance_shows_in_nees_and_coverage(tmp_path, claimed_m, nees):
    t = np.arange(0.0, 100.0, 0.125)
    noise = np.random.default_rng(5).normal(0, 0.1, (len(t), 3))
    e = evaluated(make_run(tmp_path / "a", t, truth_at(t) + noise, sigma_m=claimed_m, duration_s=100.0))
    assert value(e, "nees_mean") == pytest.approx(nees, rel=0.1)
    overconfident = any("overconfident" in text for text in e.findings)
    conservative = any("conservative" in text for text in e.remarks)
    assert (overconfident, conservative) == (claimed_m < 0.1, claimed_m > 0.1)
    inside = e.values["inside_95_share"]
    assert inside.low is not None
    assert inside.high is not None
    assert (inside.low <= 95.0 <= inside.high) == (claimed_m == 0.1)


def test_an_invalid_covariance_is_neither_averaged_nor_inside(tmp_path):
    sigma = np.full(80, 0.1)
    sigma[:40] = 0.0
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), sigma_m=sigma))
    assert reason(e, "nees_mean") == "40 covariances are not positive definite"
    assert value(e, "inside_95_share") == 50.0
    assert "40 of 80 covariances are not positive definite" in e.findings


def test_false_outputs_are_beyond_a_metre_and_overconfident_beyond_three_of_their_sigmas_too(tmp_path):
    xyz = truth_at(EIGHT_HZ)
    xyz[10:20, 1] += 1.01  # beyond 1 m with a small sigma: false
    xyz[50:60, 1] += 0.9  # nine sigma, but within 1 m: not false
    xyz[30:40, 1] += 1.01  # beyond 1 m with a sigma of 0.5 m: false, but not overconfident
    sigma = np.full(80, 0.1)
    sigma[30:40] = 0.5
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, xyz, sigma_m=sigma))
    assert (value(e, "false_outputs"), value(e, "overconfident_false_outputs")) == (20, 10)
    assert value(e, "false_per_min") == pytest.approx(120.0)
    assert value(e, "false_share") == 25.0
    finding = (
        "20 of 80 outputs are false: farther than 1 m from the drone, 10 of them by more than 3 of their own sigmas"
    )
    assert finding in e.findings
    none = evaluated(make_run(tmp_path / "b", EIGHT_HZ, xyz, sigma_m=None))
    assert value(none, "false_outputs") == 20
    assert reason(none, "overconfident_false_outputs") == "the run has no fix_covariance.csv"
    assert "20 of 80 outputs are false: farther than 1 m from the drone" in none.findings
    assert reason(none, "nees_mean") == "no covariance: the run has no fix_covariance.csv"
    huge = evaluated(make_run(tmp_path / "c", EIGHT_HZ, xyz + np.array([0, 30, 0]), sigma_m=100.0))
    assert (value(huge, "false_outputs"), value(huge, "overconfident_false_outputs")) == (80, 0)


def test_early_false_fixes_do_not_count_as_the_first_accurate_one(tmp_path):
    xyz = truth_at(EIGHT_HZ)
    xyz[:40] += [0.0, 20.0, 0.0]
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, xyz))
    assert value(e, "first_output_s") == 0.0
    assert value(e, "first_accurate_s") == pytest.approx(5.0, abs=0.021)


def test_errors_are_by_true_range(tmp_path):
    """z = 6 m, then 15 m, then 25 m, with errors 0.1, 0.2 and, at 25 m, no output."""
    whole = np.arange(0, 10.005, 0.01)
    height = np.select([whole < 4, whole < 8], [6.0, 15.0], 25.0)
    path = np.column_stack([0 * whole, 0 * whole, height])
    t = np.arange(0.0, 7.9, 0.1)
    z = np.where(t < 3.999, 6.1, 15.2)
    e = evaluated(make_run(tmp_path / "a", t, np.column_stack([0 * t, 0 * t, z]), truth=path))
    assert value(e, "range_0_rmse_m") == pytest.approx(0.1)
    assert value(e, "range_10_rmse_m") == pytest.approx(0.2)
    assert e.values["range_20_rmse_m"].failed
    assert value(e, "range_20_track_accuracy") == 0.0
    assert e.values["range_50_rmse_m"].status is MetricStatus.NOT_APPLICABLE


def test_gaps_of_truth_are_not_interpolated_over(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    times = np.arange(0, 10.005, 0.01)
    times = times[(times <= 3) | (times >= 6)]
    truth = tmp_path / "truth.tum"
    truth.write_text("# full pose\n" + lines(times, truth_at(times)))
    e = evaluated(folder, truth)
    assert e.values["rmse_m"].samples == 80 - 23  # between 3 and 6 s, ends excluded
    assert "23 of 80 outputs have no truth within 0.15 s on both sides; they are in no error" in e.remarks
    assert any("there is no truth; nothing is evaluated then" in text for text in e.remarks)
    assert evaluated(folder, truth, limits=EvaluationLimits(max_gap_s=4.0)).values["rmse_m"].samples == 80


def test_no_output_is_expected_of_a_drone_out_of_reach_but_a_false_one_still_counts(tmp_path):
    whole = np.arange(0, 10.005, 0.01)
    path = np.column_stack([np.where(whole < 5, 10.0, 150.0), 0 * whole, 0 * whole])
    t = EIGHT_HZ[EIGHT_HZ < 5]
    e = evaluated(make_run(tmp_path / "a", t, np.tile([10.0, 0, 0], (len(t), 1)), truth=path))
    assert value(e, "availability") == 100.0
    assert value(e, "longest_gap_s") < 0.3
    assert any("beyond 100 m" in text for text in e.remarks)
    t = EIGHT_HZ
    ghost = evaluated(make_run(tmp_path / "b", t, np.tile([10.0, 0, 0], (len(t), 1)), truth=path))
    assert value(ghost, "false_outputs") == 40


def test_without_a_drone_every_output_is_a_false_alarm(tmp_path):
    sweeps = [(0.0, 5.0, []), (5.0, 10.0, [[1.0, 2.0, 3.0]])]
    noisy = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), truth="no drone", sweeps=sweeps))
    assert value(noisy, "false_alarms_per_h") == pytest.approx(80 * 360)
    assert value(noisy, "false_detections_per_min") == pytest.approx(6.0)
    assert noisy.findings == ["80 outputs though there was no drone", "1 detections though there was no drone"]
    quiet = evaluated(make_run(tmp_path / "b", [], [], truth="no drone"))
    assert value(quiet, "false_alarms_per_h") == 0.0
    assert quiet.values["false_alarms_per_h"].note == "none in 10 s: below 1080 /h with 95 % confidence"
    assert "false alarms: none in 10 s: below 1080 /h with 95 % confidence" in quiet.remarks
    assert quiet.findings == []
    declared = evaluated(make_run(tmp_path / "c", [1.0], [[0, 0, 9]], truth="none"), no_drone=True)
    assert value(declared, "false_alarms_per_h") == pytest.approx(360.0)


def test_without_truth_only_metrics_that_need_none_have_values(tmp_path):
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), truth="none"))
    assert value(e, "rate_hz") == pytest.approx(8.0)
    assert value(e, "longest_gap_s") == pytest.approx(0.125)
    for key in ("rmse_m", "track_accuracy", "nees_mean", "false_outputs", "rmse_yaw_deg"):
        assert reason(e, key) == "the recording holds no truth (real flight?); give one with --truth FILE.tum"
        assert not e.values[key].failed


def test_searches_detect_miss_or_are_false(tmp_path):
    """The drone is at (t, 3, 12). Of four searches one detects it, one a wall, one misses 5 returns, one 3 returns."""
    sweeps = [
        (0.0, 2.5, [[1.0, 3.0, 12.0]]),  # where it was at 1 s
        (
            2.5,
            5.0,
            [[30.0, 3.0, 12.0], [4.0, 3.0, 12.0]],
        ),  # the best candidate is a wall; that the second is the drone does not count
        (5.0, 7.5, []),
        (7.5, 10.0, []),
    ]
    hits = [1.0] * 6 + [3.0] * 3 + [6.0, 6.1, 6.2, 6.3, 6.4] + [8.0, 8.1, 8.2]
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), sweeps=sweeps, hits_s=hits))
    assert value(e, "detection_rate") == 25.0
    assert value(e, "missed_searches") == 1
    assert value(e, "false_detections_per_min") == pytest.approx(6.0)
    without = evaluated(make_run(tmp_path / "b", EIGHT_HZ, truth_at(EIGHT_HZ), sweeps=sweeps))
    assert reason(without, "missed_searches") == "the recording does not hold which returns came from the drone"


def test_the_rotation_of_the_fused_pose_is_evaluated_and_a_wrong_branch_is_timed(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    times = np.arange(0, 10.005, 0.01)
    yaw = np.where(EIGHT_HZ < 2, math.pi / 2, math.radians(3.0))
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(times, truth_at(times)))
    good = EIGHT_HZ >= 1.0
    add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(yaw), np.eye(6) * 0.01, good)
    e = evaluated(folder)
    assert e.output.kind is OutputKind.POSE
    assert value(e, "rmse_roll_deg") == pytest.approx(0.0, abs=1e-6)
    assert value(e, "rmse_yaw_deg") == pytest.approx(math.sqrt((16 * 90**2 + 64 * 3**2) / 80), rel=1e-6)
    assert value(e, "rmse_angle_deg") == pytest.approx(value(e, "rmse_yaw_deg"), rel=1e-6)
    assert value(e, "wrong_yaw_branch_s") == pytest.approx(1.0)
    assert any("yaw off by more than 45 deg for 1.0 s in outputs marked as valid" in text for text in e.findings)
    add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(yaw), np.eye(6) * 0.01)
    unmarked = evaluated(folder)
    assert value(unmarked, "wrong_yaw_branch_s") == pytest.approx(2.0)
    assert unmarked.values["wrong_yaw_branch_s"].note == "the run does not mark valid outputs: all of them count"
    assert evaluated(folder, which=1).output.kind is OutputKind.FIX


def test_poses_that_the_autopilot_gate_accepts_are_evaluated_separately(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    times = np.arange(0, 10.005, 0.01)
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(times, truth_at(times)))
    good = (EIGHT_HZ >= 1.0) & (EIGHT_HZ < 6.0)
    off_m = np.where(good, 0.2, 7.0)
    off_m[good.nonzero()[0][3]] = 1.5
    yaw = np.where(good, math.radians(3.0), math.pi)
    xyz = truth_at(EIGHT_HZ) + off_m[:, None] * np.array([0.0, 0.0, 1.0])
    add_pose(folder, EIGHT_HZ, xyz, yaw_quaternion(yaw), np.eye(6) * 0.01, good)
    e = evaluated(folder)
    assert value(e, "sendable_share") == pytest.approx(50.0, abs=0.5)
    assert value(e, "sendable_max_m") == pytest.approx(1.5)
    assert value(e, "sendable_rmse_m") == pytest.approx(math.sqrt((39 * 0.2**2 + 1.5**2) / 40))
    assert value(e, "sendable_max_deg") == pytest.approx(3.0)
    assert value(e, "sendable_false") == 1
    assert "1 of 40 poses that the autopilot gate accepts are farther than 1 m from the drone" in e.findings
    add_pose(folder, EIGHT_HZ, xyz, yaw_quaternion(yaw), np.eye(6) * 0.01, good & False)
    none = evaluated(folder)
    assert (value(none, "sendable_share"), value(none, "sendable_false")) == (0, 0)
    assert none.values["sendable_max_m"].failed
    fix = evaluated(folder, which=1)
    assert fix.values["sendable_share"].status is MetricStatus.NOT_APPLICABLE
    (folder / "pose_vehicle_drone.tum").write_text("# never found\n")
    (folder / "pose_covariance.csv").write_text((folder / "pose_covariance.csv").read_text().splitlines()[0] + "\n")
    silent = evaluated(folder)
    assert value(silent, "sendable_share") == 0
    assert silent.values["sendable_max_m"].failed


def test_an_accepted_position_has_no_error_of_rotation(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    yaw = np.where(EIGHT_HZ < 5.0, math.pi, math.radians(2.0))
    e = []
    for known in (EIGHT_HZ >= 5.0, EIGHT_HZ >= 99.0):
        add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(yaw), np.eye(6) * 0.01, EIGHT_HZ >= 1.0)
        mark_rotations(folder, known)
        e.append(evaluated(folder))
    assert value(e[0], "sendable_max_deg") == pytest.approx(2.0)
    assert value(e[1], "sendable_max_m") == pytest.approx(0.0, abs=1e-6)
    assert reason(e[1], "sendable_max_deg") == "no pose that the autopilot gate accepts has a rotation"


def test_a_drone_out_of_reach_has_errors_but_no_share_of_time(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    times = np.arange(0, 10.005, 0.01)
    far = np.array([500.0, 0.0, 0.0])
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(times, truth_at(times) + far))
    xyz = truth_at(EIGHT_HZ) + far + [0.0, 0.0, 0.2]
    level = yaw_quaternion(np.zeros(len(EIGHT_HZ)))
    add_pose(folder, EIGHT_HZ, xyz, level, np.eye(6) * 0.01, np.ones(len(EIGHT_HZ), dtype=bool))
    e = evaluated(folder)
    assert reason(e, "sendable_share") == "truth has no time with a drone in reach"
    assert value(e, "sendable_max_m") == pytest.approx(0.2)


def test_a_pose_that_the_gate_accepts_without_a_drone_is_a_finding(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(0 * EIGHT_HZ), np.eye(6) * 0.01, EIGHT_HZ >= 9.0)
    e = evaluated(folder, no_drone=True)
    assert value(e, "sendable_false") == 8
    assert "the autopilot gate accepts 8 of 80 poses though there was no drone" in e.findings


def test_a_wrong_yaw_counts_in_every_output_with_a_rotation_though_the_gate_rejects_it(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    yaw = np.where(EIGHT_HZ < 2, math.pi / 2, 0.0)
    add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(yaw), np.eye(6) * 0.01, EIGHT_HZ >= 9.0)
    mark_rotations(folder, EIGHT_HZ >= 1.0)
    e = evaluated(folder)
    assert value(e, "wrong_yaw_branch_s") == pytest.approx(1.0)
    assert value(e, "sendable_max_deg") == pytest.approx(0.0, abs=1e-4)


def mark_rotations(folder, known):
    """Add the column that marks whether the rotation of each pose is known."""
    file = folder / "pose_covariance.csv"
    head, *rows = file.read_text().splitlines()
    rows = [f"{row},{int(flag)}" for row, flag in zip(rows, known, strict=True)]
    file.write_text("\n".join([f"{head},rotation", *rows]) + "\n")


def test_a_run_that_never_knew_the_rotation_has_failed_there_and_is_not_left_out_of_medians(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(0 * EIGHT_HZ), np.eye(6) * 0.01)
    mark_rotations(folder, 0 * EIGHT_HZ)
    e = evaluated(folder)
    assert e.values["rmse_angle_deg"].failed
    assert e.values["rmse_angle_deg"].note == "the run never knew the rotation"
    assert not e.values["wrong_yaw_branch_s"].failed


def test_identity_everywhere_is_not_a_rotation(tmp_path):
    """A TUM file with 0 0 0 1 in every line has not measured rotation; its error is not 0 deg."""
    truth, file = tmp_path / "truth.tum", tmp_path / "estimate.tum"
    truth.write_text("# full pose\n" + lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    file.write_text(lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    e = evaluated(file, truth)
    assert reason(e, "rmse_yaw_deg").startswith("the run gives no rotation: every quaternion is 0 0 0 1")
    file.write_text(lines(EIGHT_HZ, truth_at(EIGHT_HZ), yaw_quaternion(0.1 + 0 * EIGHT_HZ)))
    truth.write_text(lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    assert reason(evaluated(file, truth), "rmse_yaw_deg").startswith("truth gives no rotation")


def test_a_tum_file_is_evaluated_over_all_of_truth_not_over_itself(tmp_path):
    truth, file = tmp_path / "truth.tum", tmp_path / "estimate.tum"
    truth.write_text(lines(EIGHT_HZ, truth_at(EIGHT_HZ)))
    part = EIGHT_HZ[EIGHT_HZ < 2]
    file.write_text(lines(part, truth_at(part)))
    e = evaluated(file, truth)
    assert value(e, "availability") == pytest.approx(22, abs=2)
    assert "the span of the truth" in e.remarks[0]
    alone = evaluated(file)
    assert reason(alone, "rmse_m") == "no truth was given (--truth FILE.tum)"


def test_few_outputs_in_a_long_recording_are_the_runs_failure(tmp_path):
    few = EIGHT_HZ[:5]
    long = evaluated(make_run(tmp_path / "a", few, truth_at(few)))
    assert long.values["p95_m"].failed
    assert long.values["p95_m"].note == "too few outputs with truth: 5, a 95 % point needs 20"
    short = evaluated(make_run(tmp_path / "b", few, truth_at(few), duration_s=0.6))
    assert not short.values["p95_m"].failed


def test_the_6d_nees_of_honest_poses_is_six(tmp_path):
    """Poses T exp(noise) with the covariance of the noise, in the order rotation, translation, at the drone."""
    gtsam = pytest.importorskip("gtsam")
    t = np.arange(0.0, 60.0, 0.1)
    rng = np.random.default_rng(6)
    covariance = np.diag([0.02, 0.03, 0.05, 0.1, 0.2, 0.3]) ** 2
    times = np.arange(0, 60.005, 0.01)
    xyz, q = [], []
    for at, noise in zip(t, rng.multivariate_normal(np.zeros(6), covariance, len(t)), strict=True):
        pose = gtsam.Pose3(gtsam.Rot3.Yaw(0.02 * at), truth_at(np.array([at]))[0]).compose(gtsam.Pose3.Expmap(-noise))
        xyz.append(pose.translation())
        quaternion = pose.rotation().toQuaternion()
        q.append([quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()])
    folder = make_run(tmp_path / "a", [], [], duration_s=60.0)
    (folder / "truth_vehicle_drone.tum").write_text(lines(times, truth_at(times), yaw_quaternion(0.02 * times)))
    add_pose(folder, t, np.array(xyz), np.array(q), covariance)
    e = evaluated(folder)
    assert value(e, "pose_nees_mean") == pytest.approx(6.0, rel=0.1)
    assert value(e, "nees_mean") == pytest.approx(3.0, rel=0.12)
    assert not any("overconfident" in text for text in e.findings)


def test_compute_time_and_states_come_from_the_summary(tmp_path):
    compute = {"track": {"calls": 100, "p50": 0.5, "p99": 2.0, "max": 3.0, "total": 1000.0}, "viewer": {"calls": 0}}
    e = evaluated(
        make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), compute_ms=compute, states=[(0.1, "SEARCHING")])
    )
    assert value(e, "compute_track_p99") == 2.0
    assert value(e, "compute_track_load") == pytest.approx(10.0)
    assert "compute_viewer_p99" not in e.values
    assert e.run.states[0][1] == "SEARCHING"


def test_a_moved_folder_keeps_its_numbers(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + 0.1)
    before = evaluated(folder).values
    shutil.move(folder, tmp_path / "moved")
    assert evaluated(tmp_path / "moved").values == before
