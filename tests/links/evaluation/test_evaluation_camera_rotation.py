"""The rotation by both cameras: written as published, evaluated against angles known by hand, absent without cameras."""

from __future__ import annotations

import csv
import json
import math
import re

import numpy as np
import pytest

from flow.link import LinkError, Record, Run
from links.evaluation.evaluation import Evaluation
from links.evaluation.groups import ROTATION_COLUMNS, group_numbers, grouped
from links.evaluation.metrics import CAMERAS, CATALOGUE
from links.evaluation.run_data import read_rotations
from links.evaluation.tables import runs_table
from links.evaluation.text_files import read_tum
from links.runs.results import Results
from links.runs.truth import TruthLog
from stages.geometry.frames import quaternions_xyzw, rotation_from_rpy_deg, rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import BranchState, RelativeRotation
from tests.command import grd
from tests.links.evaluation.made_runs import (
    add_rotations,
    add_true_rotations,
    all_evaluated,
    evaluated,
    lines,
    make_run,
    truth_at,
    yaw_quaternion,
)

EIGHT_HZ = np.arange(0.0, 10.0, 0.125)  # 80 images
KEYS = [key for key, metric in CATALOGUE.items() if metric.group == CAMERAS]
LEVEL = (0.0, 0.0, 0.0, 1.0)
MEASURED = [
    f"rotation_{which}_{name}_deg" for which in ("published", "modulo_90") for name in ("rmse", "median", "p95")
]


def quaternion(R: np.ndarray) -> np.ndarray:
    return quaternions_xyzw(R[None])[0]


def fly(folder, **settings):
    return make_run(folder, EIGHT_HZ, truth_at(EIGHT_HZ), **settings)


def numbers(e: Evaluation, *keys: str) -> list[float | None]:
    return [e.values[f"rotation_{key}"].value for key in keys]


def rotation(stamp_ns: int, R: np.ndarray | None, state: BranchState, switches: int = 0) -> RelativeRotation:
    if R is None:
        return RelativeRotation.none(stamp_ns, "9 lines, of both")
    covariance = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]) * 1e-4
    branches = np.array([0.7, 0.1, 0.15, 0.05])
    return RelativeRotation.one(stamp_ns, R, covariance, branches, state, switches, "9 lines, of both")


def test_every_rotation_is_a_line_of_the_run_and_is_read_back(tmp_path):
    results = Results()
    results.open(Run(tmp_path, "", "", ""))
    R = rotation_from_rpy_deg((3.0, -5.0, 130.0))
    for second, message in enumerate(
        [
            rotation(1_000_000_000, R, BranchState.AMBIGUOUS),
            rotation(2_000_000_000, None, BranchState.NONE),
            rotation(2_500_000_000, None, BranchState.NONE),
            rotation(3_000_000_000, R @ R, BranchState.RESOLVED, 1),
        ]
    ):
        results.see("align.relative_rotation", message, second)
    results.close()
    rows = list(csv.DictReader((tmp_path / "rotation_vehicle_drone.csv").open()))
    assert [row["stamp_s"] for row in rows] == ["1.000000000", "2.000000000", "2.500000000", "3.000000000"]
    assert [row[f"p_{turn}"] for row in rows[:1] for turn in (0, 90, 180, 270)] == ["0.7", "0.1", "0.15", "0.05"]
    assert (rows[1]["qw"], rows[1]["czz_rad2"], rows[1]["reason"]) == ("", "", "9 lines, of both")
    read = read_rotations(tmp_path / "rotation_vehicle_drone.csv")
    assert read.accepted.tolist() == [True, False, False, True]
    assert read.resolved.tolist() == [False, False, False, True]
    assert read.switches.tolist() == [0, 0, 0, 1]
    assert read.R_vehicle_drone[[0, 3]] == pytest.approx(np.array([R, R @ R]), abs=1e-8)
    assert read.covariance_rad2[0] * 1e4 == pytest.approx(np.array([[1, 0.1, 0.2], [0.1, 2, 0.3], [0.2, 0.3, 3]]))
    assert [line.split(":")[0] for line in (tmp_path / "run.log").read_text().splitlines()] == [
        "1.000000000 align.relative_rotation", "2.000000000 align.relative_rotation", "3.000000000 align.relative_rotation"
    ]  # fmt: skip


def test_a_run_without_a_rotation_stage_has_no_file_of_rotations(tmp_path):
    (tmp_path / "rotation_vehicle_drone.csv").write_text("of an older run")
    results = Results()
    results.open(Run(tmp_path, "", "", ""))
    results.close()
    assert not (tmp_path / "rotation_vehicle_drone.csv").exists()


def test_truth_has_the_pose_of_the_vehicle(tmp_path):
    log = TruthLog()
    for what, xyz, yaw_deg in (("vehicle", [10.0, 1, 2], 90), ("drone", [10.0, 5, 7], 180)):
        pose = {"xyz_m": xyz, "quaternion_xyzw": yaw_quaternion([math.radians(yaw_deg)])[0].tolist()}
        log.add_all([Record(f"/truth/{what}", 7, 7, json.dumps(pose).encode())])
    log.write(tmp_path)
    vehicle = read_tum(tmp_path / "truth_world_vehicle.tum")
    assert (vehicle.stamps_ns.tolist(), vehicle.xyz_m.tolist()) == ([7], [[10, 1, 2]])
    assert vehicle.quaternion_xyzw is not None
    assert vehicle.quaternion_xyzw[0] == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)], abs=1e-6)


def test_the_error_is_the_angle_between_the_rotation_and_truth(tmp_path):
    """True yaw 170 deg, published 173 deg with a roll of 4 deg: of 80 images 60 have a rotation."""
    folder = add_true_rotations(fly(tmp_path / "a"), quaternion(rotation_z(math.radians(170.0))), LEVEL)
    q = quaternion(rotation_from_rpy_deg((4.0, 0.0, 173.0)))
    e = evaluated(add_rotations(folder, EIGHT_HZ, np.tile(q, (80, 1)), accepted=np.arange(80) % 4 > 0))
    assert numbers(e, "images", "accepted_share", "resolved", "wrong_resolved", "switches") == [80, 75, 0, 0, 0]
    assert e.counts["rotation_accepted_share"] == (60, 80)
    whole = math.degrees(2 * math.acos(math.cos(math.radians(1.5)) * math.cos(math.radians(2.0))))
    for which in ("published", "modulo_90"):
        sizes = numbers(e, *(f"{which}_{name}_deg" for name in ("rmse", "median", "p95")))
        assert sizes == pytest.approx([whole] * 3, abs=1e-5)
        axes = numbers(e, *(f"{which}_rmse_{axis}_deg" for axis in ("roll", "pitch", "yaw")))
        assert axes == pytest.approx([4.0, 0.0, 3.0], abs=1e-5)
    assert e.values["rotation_published_rmse_deg"].samples == 60


def test_a_wrong_branch_is_an_error_of_the_published_branch_and_none_modulo_90_degrees(tmp_path):
    """16 of 80 are 92 deg off, the others 2: modulo 90 deg, all are 2."""
    yaw_deg = np.where(np.arange(80) < 16, 92.0, 2.0)
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL)
    e = evaluated(add_rotations(folder, EIGHT_HZ, yaw_quaternion(np.radians(yaw_deg)), switches=np.arange(80) // 16))
    published, modulo = (numbers(e, f"{which}_rmse_deg", f"{which}_median_deg", f"{which}_rmse_yaw_deg", f"{which}_p95_deg")
                     for which in ("published", "modulo_90"))  # fmt: skip
    rmse = math.sqrt((16 * 92**2 + 64 * 2**2) / 80)
    assert published == pytest.approx([rmse, 2.0, rmse, 92.0])
    assert modulo == pytest.approx([2.0] * 4)
    assert numbers(e, "switches", "wrong_resolved", "resolved") == [4, 0, 0]
    assert e.values["rotation_resolved_s"].note == "never RESOLVED"
    assert e.values["rotation_resolved_s"].failed


def test_a_stage_that_leaves_the_branch_open_has_errors_modulo_90_degrees_alone(tmp_path):
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL)
    e = evaluated(add_rotations(folder, EIGHT_HZ, yaw_quaternion(np.full(80, math.radians(92.0))), undecided="OPEN"))
    assert numbers(e, "modulo_90_rmse_deg") == pytest.approx([2.0])
    for key in ("published_rmse_deg", "published_p95_deg", "resolved_s", "resolved_m", "wrong_resolved"):
        value = e.values[f"rotation_{key}"]
        assert value.value is None
        assert not value.failed


def test_yaw_branches_are_about_the_vertical_of_the_world(tmp_path):
    """The vehicle rolls by 10 deg: a rotation about its own z axis would leave most of that tilt."""
    R_world_vehicle, R_true = rotation_from_rpy_deg((10.0, 0.0, 30.0)), rotation_from_rpy_deg((1.0, 2.0, 40.0))
    q = quaternion(R_world_vehicle.T @ rotation_z(-math.pi / 2) @ R_world_vehicle @ R_true)
    folder = add_true_rotations(fly(tmp_path / "a"), quaternion(R_true), quaternion(R_world_vehicle))
    e = evaluated(add_rotations(folder, EIGHT_HZ, np.tile(q, (80, 1))))
    assert numbers(e, "modulo_90_rmse_deg", "published_rmse_deg") == pytest.approx([0.0, 90.0], abs=1e-4)
    (folder / "truth_world_vehicle.tum").unlink()
    e = evaluated(folder)
    assert 10 < (numbers(e, "modulo_90_rmse_deg")[0] or 0) < 15
    assert "modulo 90 deg are about the vehicle's own z axis" in " ".join(e.remarks)


def test_the_covariance_is_of_a_rotation_about_the_drones_axes(tmp_path):
    """Off by (1, 2, 3) sigma along the drone's x, y, z: NEES is 1 + 4 + 9, for any attitude of the drone and on any branch."""
    sigma = np.array([0.001, 0.004, 0.002])
    R_true = rotation_from_rpy_deg((20.0, -10.0, 100.0))
    published = quaternion(rotation_z(math.pi) @ R_true @ exp_rotation(-sigma * [1, 2, 3]))
    folder = add_true_rotations(fly(tmp_path / "a"), quaternion(R_true), LEVEL)
    e = evaluated(add_rotations(folder, EIGHT_HZ, np.tile(published, (80, 1)), variance_rad2=sigma**2))
    assert numbers(e, "nees_per_dof", "inside_95_share") == pytest.approx([14 / 3, 0.0], rel=1e-4)
    assert any("rotation covariance is overconfident" in text for text in e.findings)
    e = evaluated(add_rotations(folder, EIGHT_HZ, np.tile(published, (80, 1)), variance_rad2=4 * sigma**2))
    assert numbers(e, "nees_per_dof", "inside_95_share") == pytest.approx([14 / 12, 100.0], rel=1e-4)
    e = evaluated(add_rotations(folder, EIGHT_HZ, np.tile(published, (80, 1)), variance_rad2=(1e-6, 0.0, 1e-6)))
    assert numbers(e, "nees_per_dof", "inside_95_share") == [None, 0.0]
    assert "80 of 80 covariances of the rotation are missing or not positive definite" in e.findings


def test_the_first_resolved_rotation_has_the_drones_path_to_it(tmp_path):
    """The drone flies 1 m/s in the vehicle's axes, the vehicle 2 m/s across: in 4 s 4 m, and over ground 4 sqrt(5)."""
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL, lambda t: np.outer(t, [0, 2, 0]))
    e = evaluated(add_rotations(folder, EIGHT_HZ, yaw_quaternion(0 * EIGHT_HZ), resolved=EIGHT_HZ >= 4))
    assert numbers(e, "resolved", "wrong_resolved") == [48, 0]
    assert numbers(e, "resolved_s", "resolved_m", "resolved_ground_m") == pytest.approx([4, 4, 4 * math.sqrt(5)])
    turned = add_true_rotations(
        fly(tmp_path / "b"), LEVEL, yaw_quaternion([math.pi / 2])[0], lambda t: np.outer(t, [0, -1, 0])
    )
    e = evaluated(add_rotations(turned, EIGHT_HZ, yaw_quaternion(0 * EIGHT_HZ), resolved=EIGHT_HZ >= 4))
    assert numbers(e, "resolved_m", "resolved_ground_m") == pytest.approx([4, 0], abs=1e-6)


def test_a_vehicle_that_turns_on_the_spot_adds_no_path(tmp_path):
    times = np.arange(0, 10.005, 0.01)
    yaw = yaw_quaternion(0.2 * times)
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, yaw)
    x, y = 5 * np.cos(0.2 * times), -5 * np.sin(0.2 * times)  # 5 m off along x of the world, in the vehicle frame
    path = lines(times, np.column_stack([x, y, 0 * x]), yaw_quaternion(-0.2 * times))
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + path)
    e = evaluated(add_rotations(folder, EIGHT_HZ, yaw_quaternion(-0.2 * EIGHT_HZ), resolved=EIGHT_HZ >= 4))
    assert numbers(e, "resolved_m", "resolved_ground_m", "published_rmse_deg") == pytest.approx([0, 0, 0], abs=1e-4)


def test_a_resolved_branch_that_is_wrong_is_a_finding(tmp_path):
    """From 4 s on RESOLVED, 50 deg off in the first 0.25 s; 40 deg is not another branch."""
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL)
    yaw_deg = np.select([EIGHT_HZ < 4, EIGHT_HZ < 4.25], [0.0, -50.0], 40.0)
    e = evaluated(add_rotations(folder, EIGHT_HZ, yaw_quaternion(np.radians(yaw_deg)), resolved=EIGHT_HZ >= 4))
    assert numbers(e, "resolved", "wrong_resolved") == [48, 2]
    assert e.values["rotation_resolved_m"].failed
    assert e.values["rotation_resolved_s"].note == "the first RESOLVED rotation was wrong"
    assert "2 RESOLVED rotations are more than 45 deg off" in e.findings


def test_a_run_that_accepts_nothing_fails_and_one_with_few_images_is_not_evaluated(tmp_path):
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL)
    e = evaluated(add_rotations(folder, EIGHT_HZ, np.tile(LEVEL, (80, 1)), accepted=False))
    assert numbers(e, "images", "accepted_share", "resolved") == [80, 0, 0]
    assert all(e.values[key].failed for key in (*MEASURED, "rotation_inside_95_share", "rotation_nees_per_dof"))
    e = evaluated(add_rotations(folder, EIGHT_HZ[:9], np.tile(LEVEL, (9, 1))))
    assert numbers(e, "modulo_90_rmse_deg", "modulo_90_p95_deg", "nees_per_dof") == [0.0, None, None]
    assert e.values["rotation_nees_per_dof"].note == "9 rotations with truth, 10 needed"
    assert not e.values["rotation_modulo_90_p95_deg"].failed


def test_without_truth_only_metrics_that_need_none_have_values(tmp_path):
    folder = add_rotations(fly(tmp_path / "a", truth="none"), EIGHT_HZ, np.tile(LEVEL, (80, 1)), resolved=EIGHT_HZ >= 2)
    e = evaluated(folder)
    assert numbers(e, "images", "accepted_share", "resolved", "resolved_s") == [80, 100, 64, 2]
    for key in (*MEASURED, "rotation_nees_per_dof", "rotation_wrong_resolved", "rotation_resolved_m"):
        assert e.values[key].note.startswith("the recording holds no truth"), key


def test_rotations_without_truth_are_in_no_error(tmp_path):
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL, duration_s=5.0)
    yaw_deg = np.where(EIGHT_HZ <= 5, 1.0, 30.0)
    e = evaluated(add_rotations(folder, EIGHT_HZ, yaw_quaternion(np.radians(yaw_deg))))
    assert numbers(e, "published_rmse_deg") == pytest.approx([1.0])
    assert "39 of 80 rotations have no truth; they are in no error" in e.remarks


def test_the_second_drone_is_not_evaluated_by_the_camera_of_the_first(tmp_path):
    folder = add_true_rotations(fly(tmp_path / "a"), LEVEL, LEVEL)
    times = np.arange(0, 10.005, 0.01)
    (folder / "truth_vehicle_drone_2.tum").write_text("# full pose\n" + lines(times, truth_at(times) + 20.0))
    add_rotations(folder, EIGHT_HZ, np.tile(LEVEL, (80, 1)))
    one, two = all_evaluated(folder)
    assert numbers(one, "images") == [80]
    assert {two.values[key].note for key in KEYS} == {"the camera is on drone 1"}


def test_the_output_of_a_run_without_a_rotation_stage_does_not_mention_it(tmp_path):
    folder = fly(tmp_path / "flight")
    text = grd(
        "evaluate",
        folder,
        folder,
        "--by",
        "config",
        "--csv",
        tmp_path / "x.csv",
        "--report",
        tmp_path / "r.html",
        code=0,
    )
    text += grd("evaluate", folder) + (tmp_path / "r.html").read_text()
    assert "both cameras" not in text
    assert "RESOLVED" not in text
    row = next(csv.DictReader((tmp_path / "x.csv").open()))
    assert {row[key] for key in (*KEYS, "rotation_accepted_share_of")} == {""}
    metrics = json.loads((tmp_path / "evaluation.json").read_text())["runs"][0]["metrics"]
    assert (metrics["rotation_images"]["value"], metrics["rotation_images"]["status"]) == (None, "not applicable")


@pytest.fixture
def three_flights(tmp_path):
    """Two with `estimate`: 80 rotations 1 deg off, RESOLVED at 2 s; 20 of 80, 3 deg off, never. One with `paper`."""
    folders = []
    for name, config, yaw_deg, kept, resolved in (
        ("a-s1", "estimate", 1.0, 80, EIGHT_HZ >= 2),
        ("b-s1", "estimate", 3.0, 20, False),
        ("a-s1", "paper", 91.0, 80, EIGHT_HZ >= 1),
    ):
        folder = fly(tmp_path / f"{name}-{config}", recording=name, config=config)
        add_true_rotations(folder, LEVEL, LEVEL)
        q = yaw_quaternion(np.full(80, math.radians(yaw_deg)))
        folders.append(add_rotations(folder, EIGHT_HZ, q, accepted=np.arange(80) < kept, resolved=resolved))
    return folders


def test_rotations_of_a_group_are_one_series(three_flights):
    evaluations = [evaluated(folder) for folder in three_flights]
    table = group_numbers(grouped(runs_table(evaluations), ()), ROTATION_COLUMNS)
    table.columns = [head.replace("\n", " ") for head in table.columns]
    estimate, paper = table.to_dict("records")
    assert (estimate["runs"], estimate["images"], paper["images"]) == (2, 160, 80)
    assert (estimate["accepted [%]"], paper["accepted [%]"]) == (100 * 100 / 160, 100)
    rmse = math.sqrt((80 * 1 + 20 * 9) / 100)
    sizes = ("mod 90 RMSE [deg]", "published RMSE [deg]", "mod 90 median", "mod 90 95 %")
    assert [estimate[name] for name in sizes] == pytest.approx([rmse, rmse, 1.0, 3.0])
    assert [estimate[f"{axis} RMSE"] for axis in ("roll", "pitch", "yaw")] == pytest.approx([0.0, 0.0, rmse], abs=1e-6)
    nees = (80 * math.radians(1) ** 2 + 20 * math.radians(3) ** 2) / 100 / 1e-4
    assert estimate["NEES / 3"] == pytest.approx(nees / 3)
    assert estimate["in 95 % [%]"] == 80  # NEES 3.05 and 27.4 of 7.81
    assert (estimate["RESOLVED"], estimate["wrong"], paper["wrong"]) == (64, 0, 72)
    assert (estimate["runs RESOLVED"], paper["runs RESOLVED"]) == (1, 0)
    assert sorted(runs_table(evaluations[:2]).rotation_resolved_s) == [pytest.approx(2.0), math.inf]
    assert paper["first [s]"] == math.inf
    assert paper["published RMSE [deg]"] == pytest.approx(91.0)
    assert paper["mod 90 RMSE [deg]"] == pytest.approx(1.0)


def test_configurations_are_side_by_side_in_terminal_table_and_report(three_flights, tmp_path):
    text = grd(
        "evaluate", *three_flights, "--by", "1", "--csv", tmp_path / "x.csv", "--report", tmp_path / "r.html", code=1
    )
    assert re.search(r"│ a +│ estimate +│ +1 │ +80 │ +100.0 │ +1.00 │ +1.00 │", text)
    assert re.search(r"│ a +│ paper +│ +1 │ +80 │ +100.0 │ +91.00 │ +1.00 │", text)
    assert re.search(r"│ all +│ estimate +│ +2 │ +160 │ +62.5 │ +1.61 │", text)
    assert "rotation by both cameras, by field 1 of the recording's name" in text
    rows = list(csv.DictReader((tmp_path / "x.csv").open()))
    assert [row["rotation_wrong_resolved"] for row in rows] == ["0", "0", "72"]
    assert (rows[1]["rotation_accepted_share_count"], rows[1]["rotation_accepted_share_of"]) == ("20", "80")
    assert rows[1]["rotation_resolved_s"] == "inf"
    report = (tmp_path / "r.html").read_text()
    for text in ("modulo 90 deg: RMSE roll [deg]", "branch wrong, RESOLVED", "no rotation", "NEES\n/ 3"):
        assert text in report
    alone = grd("evaluate", three_flights[0], code=0)
    assert re.search(r"published branch: RMSE \[deg\] +│ +1.00 │", alone)
    assert re.search(r"path to it, relative to the vehicle \[m\] +│ +2.000 │", alone)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("AMBIGUOUS", "CERTAIN", "state is 'CERTAIN', not one of NONE, AMBIGUOUS, RESOLVED"),
        (",1,0,0,0,1,", ",yes,0,0,0,1,", "accepted is 'yes', not one of 0, 1"),
        (",1,0,0,0,1,", ",1,0,0,0,nan,", "nan is not finite"),
        (",1,0,0,0,1,", ",1,0,0,0,0,", "a quaternion is 0 0 0 0"),
        ("switches", "jumps", "no column switches"),
    ],
)
def test_a_wrong_table_of_rotations_is_rejected(tmp_path, old, new, complaint):
    file = add_rotations(tmp_path, [1.0], [LEVEL]) / "rotation_vehicle_drone.csv"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(LinkError, match=complaint):
        read_rotations(file)
