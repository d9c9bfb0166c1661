"""Several tracks and several drones: each output is evaluated against the drone that its track follows."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from flow.link import LinkError
from links.cli.app import app
from links.evaluation.association import EvaluationInput, follow
from links.evaluation.comparison import pair_up
from links.evaluation.evaluation import MetricStatus
from links.evaluation.run_data import read_run
from links.evaluation.tables import label
from tests.links.evaluation.made_runs import START_NS, all_evaluated, lines, make_run, stamp, truth_at

T_S = np.arange(0.0, 10.0, 0.1)
OFFSET_M = np.array([0.0, 10.0, 0.0])  # of the second drone from the first


def two_drones(folder, t_s, xyz, tracks, **settings):
    """Drone 2 flies 10 m to the left of drone 1; 3 pulses returned from it."""
    make_run(folder, t_s, xyz, tracks=tracks, **settings)
    times = np.arange(0, 10.005, 0.01)
    (folder / "truth_vehicle_drone_2.tum").write_text("# full pose\n" + lines(times, truth_at(times) + OFFSET_M))
    (folder / "truth_returns_2.csv").write_text("stamp_s\n" + "".join(f"{stamp(t)}\n" for t in (1.0, 2.0, 9.5)))
    return folder


def interleaved():
    """Both tracks have a fix at each time, with the same stamp; that of drone 2 comes first and is 0.3 m off."""
    t = np.repeat(T_S, 2)
    tracks = np.tile([7, 3], len(T_S))
    xyz = truth_at(t) + np.where((tracks == 7)[:, None], OFFSET_M + np.array([0, 0, 0.3]), 0.0)
    return t, xyz, tracks


def test_a_track_follows_the_drone_it_is_nearest_to_most_of_the_time():
    stamps = np.arange(10, dtype=np.int64)
    a, b = np.zeros((10, 3)), np.tile([10.0, 0, 0], (10, 1))
    xyz = np.zeros((10, 3))
    xyz[:4] += [9.5, 0, 0]  # the first four of track 1 are at drone 2
    found = follow(stamps, xyz, np.ones(10, dtype=np.int64), [(stamps, a), (stamps, b)], 5)
    assert found.drone.tolist() == [0] * 10
    assert found.switches == {1: 1}


def test_between_two_drones_or_far_from_both_no_track_switches():
    stamps = np.arange(6, dtype=np.int64)
    a, b = np.zeros((6, 3)), np.tile([1.2, 0, 0], (6, 1))
    xyz = np.zeros((6, 3))
    xyz[:, 0] = [0.0, 0.7, 0.1, 5.0, 0.5, 0.0]  # 0.7 and 0.5 are within 1 m of both
    tracks = np.ones(6, dtype=np.int64)
    assert follow(stamps, xyz, tracks, [(stamps, a), (stamps, b)], 5).switches == {1: 0}
    xyz[4, 0] = 2.0
    assert follow(stamps, xyz, tracks, [(stamps, a), (stamps, b)], 5).switches == {1: 2}


def test_a_track_outside_truth_follows_the_first_drone():
    stamps = np.arange(3, dtype=np.int64)
    late = stamps + 100
    found = follow(late, np.ones((3, 3)), np.array([4, 4, 4]), [(stamps, np.zeros((3, 3)))] * 2, 5)
    assert (found.drone.tolist(), found.switches) == ([0, 0, 0], {4: 0})


def test_each_drone_is_evaluated_with_its_own_tracks(tmp_path):
    t, xyz, tracks = interleaved()
    one, two = all_evaluated(two_drones(tmp_path / "a", t, xyz, tracks, hits_s=[1.0], visible=[(0, 1)]))
    assert (one.run.drone, two.run.drone) == (1, 2)
    assert (label(one), label(two)) == ("a drone 1", "a drone 2")
    assert one.values["rmse_m"].value == pytest.approx(0.0, abs=1e-6)
    assert two.values["rmse_m"].value == pytest.approx(0.3)
    for e in (one, two):
        assert e.values["track_accuracy"].value == pytest.approx(100.0)
        assert e.values["identity_switches"].value == 0
        assert len(e.output.poses) == len(T_S)
    assert one.run.target.returns_ns is not None
    assert two.run.target.returns_ns is not None
    assert (len(one.run.target.returns_ns), len(two.run.target.returns_ns)) == (1, 3)
    assert one.run.target.occluded_ns is not None
    assert two.run.target.occluded_ns is None
    assert two.values["reacquisition_s"].note == two.run.why_missing(EvaluationInput.VISIBILITY)
    assert two.values["reacquisition_s"].note == "the recording does not hold when the drone was occluded"
    pairs, warnings = pair_up([one, two], [one, two])
    assert [(p.own.run.drone, p.other.run.drone) for p in pairs] == [(1, 1), (2, 2)]
    assert warnings == []


def test_a_drone_that_nothing_follows_was_never_found(tmp_path):
    one, two = all_evaluated(two_drones(tmp_path / "a", T_S, truth_at(T_S), np.ones(len(T_S), dtype=int)))
    assert one.values["track_accuracy"].value == 100.0
    assert two.values["track_accuracy"].value == 0.0
    assert two.values["rmse_m"].failed
    assert two.values["identity_switches"].note == "no track follows the drone"


def test_a_track_that_changes_to_another_drone_is_false_there_and_counted(tmp_path):
    """Track 1 follows drone 1 for 7 s, then drone 2."""
    xyz = truth_at(T_S) + np.where((T_S > 6.95)[:, None], OFFSET_M, 0.0)
    one, two = all_evaluated(two_drones(tmp_path / "a", T_S, xyz, np.ones(len(T_S), dtype=int)))
    assert one.values["identity_switches"].value == 1
    assert "tracks changed to another drone 1 times" in one.findings
    assert one.values["false_outputs"].value == 30
    assert one.values["track_accuracy"].value == pytest.approx(70, abs=1)
    assert two.values["track_accuracy"].value == 0.0


def test_a_candidate_at_another_drone_is_not_false(tmp_path):
    searches = [(0.0, 2.0, [[1.0, 13.0, 12.0], [1.0, 3.0, 12.0]]), (2.0, 4.0, [[50.0, 3.0, 12.0]])]
    t, xyz, tracks = interleaved()
    one, two = all_evaluated(two_drones(tmp_path / "a", t, xyz, tracks, sweeps=searches, hits_s=[1.0] * 4))
    for e in (one, two):
        assert e.values["false_detections_per_min"].samples == 1
    assert one.values["detection_rate"].value == 50.0  # the best one but the other drone
    assert one.values["observable_detection_rate"].value == 100.0
    assert two.values["detection_rate"].value == 50.0


def test_one_drone_is_evaluated_with_all_tracks_in_the_order_of_time(tmp_path):
    """Track 2 is late: its fixes come after those of track 1 in the file, and share stamps with them."""
    t = np.concatenate([T_S, T_S[::10]])
    xyz = truth_at(t)
    xyz[len(T_S) :] += [0.0, 0.0, 30.0]
    tracks = np.concatenate([np.ones(len(T_S), dtype=int), np.full(10, 2)])
    (e,) = all_evaluated(make_run(tmp_path / "a", t, xyz, tracks=tracks, sigma_m=np.where(tracks == 1, 0.1, 0.2)))
    assert (np.diff(e.output.poses.stamps_ns) >= 0).all()
    assert e.output.track is not None
    assert e.output.covariance is not None
    second = e.output.track == 2
    assert e.output.poses.stamps_ns[second].tolist() == [START_NS + i * 1_000_000_000 for i in range(10)]
    assert e.output.covariance[second, 0, 0] == pytest.approx(0.04)
    assert e.output.poses.xyz_m[second, 2] == pytest.approx(42.0)
    assert e.values["false_outputs"].value == 10
    assert e.values["identity_switches"].status is MetricStatus.NOT_APPLICABLE


def test_one_track_must_still_rise(tmp_path):
    with pytest.raises(LinkError, match="earlier than the line before it"):
        read_run(make_run(tmp_path / "a", [1.0, 0.5], np.zeros((2, 3)), tracks=[1, 1]))
    with pytest.raises(LinkError, match=r"fix_covariance\.csv:2: track_id 'x' is not a whole number"):
        read_run(make_run(tmp_path / "b", [1.0], np.zeros((1, 3)), tracks=["x"]))


def test_the_report_has_each_drone(tmp_path):
    t, xyz, tracks = interleaved()
    folder = two_drones(tmp_path / "a", t, xyz, tracks, states=[(0.0, "TRACKING", 3), (0.1, "CANDIDATE", 7)])
    result = CliRunner().invoke(
        app, ["evaluate", str(folder), "--against", str(folder), "--report", str(tmp_path / "r.html")]
    )
    assert result.exit_code == 0, result.output
    text = (tmp_path / "r.html").read_text()
    for name in ("a drone 1", "a drone 2", "a drone 1 (compared with)"):
        assert f"<h2>{name}</h2>" in text
