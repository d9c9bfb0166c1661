"""From the truth of a recording to the files that an evaluation reads: nothing is lost or rotated."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.link import Record, Run
from links.evaluation.association import NEVER_NS, read_true_drones
from links.evaluation.run_data import read_run
from links.evaluation.text_files import read_tum
from links.runs.results import Results
from links.runs.truth import TruthLog
from stages.messages import CandidateEvidence, DepthImage, Detections, DroneFix, KernelScores, TrackingState, TrackState
from tests.links.evaluation.made_runs import yaw_quaternion


def pose(topic: str, stamp_ns: int, xyz, yaw_deg: float) -> Record:
    q = yaw_quaternion([np.radians(yaw_deg)])[0].tolist()
    return Record(topic, stamp_ns, stamp_ns, json.dumps({"xyz_m": xyz, "quaternion_xyzw": q}).encode())


def test_truth_is_written_as_the_drone_in_the_vehicle_with_its_rotation(tmp_path):
    """The vehicle is at (10, 0, 0) with yaw 90 deg, the drone at (10, 5, 7) of the world with yaw 180 deg."""
    log = TruthLog()
    records = [
        pose("/truth/vehicle", 1_000_000_000, [10.0, 0, 0], 90),
        pose("/truth/drone", 1_000_000_000, [10.0, 5, 7], 180),
        Record("/truth/hits", 0, 0, b'{"pulse_stamp_ns": []}'),
        Record("/truth/hits", 0, 0, b'{"pulse_stamp_ns": [3000000001, 2]}'),
        Record("/lidar/packets", 0, 0, b""),
    ]
    assert [r.topic for r in log.without_truth(records)] == ["/lidar/packets"]
    log.write(tmp_path)
    truth = read_tum(tmp_path / "truth_vehicle_drone.tum")
    assert truth.stamps_ns.tolist() == [1_000_000_000]
    assert truth.xyz_m[0] == pytest.approx([5, 0, 7])
    assert truth.quaternion_xyzw is not None
    yaw_pitch_roll = Rotation.from_quat(truth.quaternion_xyzw).as_euler("ZYX", degrees=True)
    assert yaw_pitch_roll[0] == pytest.approx([90, 0, 0], abs=1e-3)
    assert (tmp_path / "truth_returns.csv").read_text() == "stamp_s\n0.000000002\n3.000000001\n"


def test_a_recording_without_a_drone_is_marked_and_one_without_truth_has_no_file(tmp_path):
    log = TruthLog()
    list(log.without_truth([pose("/truth/vehicle", 5, [0, 0, 0], 0)]))
    log.write(tmp_path)
    assert (tmp_path / "truth_vehicle_drone.tum").read_text() == "# no drone in this recording\n"
    assert not (tmp_path / "truth_returns.csv").exists()
    (tmp_path / "b").mkdir()
    TruthLog().write(tmp_path / "b")
    assert list((tmp_path / "b").iterdir()) == []


def test_each_drone_has_its_own_files_of_truth(tmp_path):
    """Drone 2 is 3 m above drone 1; drone 1 is never occluded, drone 2 is after 1 s."""
    log = TruthLog()
    records = [pose("/truth/vehicle", 7, [1.0, 0, 0], 0), pose("/truth/drone", 7, [1.0, 0, 5], 0)]
    records += [pose("/truth/drone_2", 7, [1.0, 0, 8], 0), Record("/truth/hits_2", 0, 0, b'{"pulse_stamp_ns": [7]}')]
    records += [
        Record("/truth/visible", 0, 0, b'{"visible": true}'),
        Record("/truth/visible_2", 0, 0, b'{"visible": true}'),
    ]
    records += [Record("/truth/visible_2", 1_000_000_000, 1_000_000_000, b'{"visible": false}')]
    assert list(log.without_truth(records)) == []
    log.write(tmp_path)
    drones, empty_sky = read_true_drones(tmp_path, None)
    assert not empty_sky
    one, two = drones
    assert one.path is not None
    assert two.path is not None
    assert (one.path.xyz_m.tolist(), two.path.xyz_m.tolist()) == ([[0, 0, 5]], [[0, 0, 8]])
    assert one.returns_ns is None
    assert two.returns_ns is not None
    assert two.returns_ns.tolist() == [7]
    assert one.occluded_ns is not None
    assert two.occluded_ns is not None
    assert (one.occluded_ns.tolist(), two.occluded_ns.tolist()) == ([], [[1_000_000_000, NEVER_NS]])


def test_fixes_are_compared_with_the_drone_their_track_follows():
    log = TruthLog()
    for stamp in (0, 10_000_000):
        log.vehicle[stamp] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        for number in (1, 2):
            list(log.without_truth([pose(f"/truth/drone_{number}", stamp, [0, 0, 10 * number], 0)]))
    fixes = [fix(5_000_000, 19.5, track_id=4), fix(6_000_000, 10.25, track_id=9), fix(20_000_000, 10, track_id=9)]
    errors = log.fix_errors_of(fixes)
    assert errors is not None
    assert errors.error_m[:, 2] == pytest.approx([-0.5, 0.25])
    assert errors.stamps_ns.tolist() == [5_000_000, 6_000_000]
    assert errors.without_truth == 1
    assert TruthLog().fix_errors_of(fixes) is None


@pytest.mark.parametrize(
    ("topic", "data"),
    [
        *(("visible", data) for data in (b"{}", b'{"visible": 1}', b"no")),
        *(("hits", data) for data in (b"{}", b'{"pulse_stamp_ns": [-1]}', b'{"pulse_stamp_ns": [9e99]}')),
        *(
            (topic, data)
            for topic in ("drone", "vehicle")
            for data in (
                b"no",
                b"\xff",
                b"[]",
                b'{"xyz_m": [0, NaN, 0], "quaternion_xyzw": [0, 0, 0, 1]}',
                b'{"xyz_m": [0, 1e300, 0], "quaternion_xyzw": [0, 0, 0, 1]}',
                b'{"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 0]}',
                b'{"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, NaN]}',
            )
        ),
    ],
)
def test_invalid_truth_is_counted_and_left_out(topic, data):
    log = TruthLog()
    assert list(log.without_truth([Record(f"/truth/{topic}", 3, 3, data)])) == []
    assert log.warnings() == [f"1 records on /truth/{topic} are invalid: left out"]
    assert not log.vehicle
    assert not log.drones or (log.drones[1].pose, log.drones[1].return_ns, log.drones[1].visible) == ({}, None, None)


@pytest.mark.parametrize(("drone", "stated"), [(None, True), (b"no", False)])
def test_a_drone_whose_truth_is_invalid_is_not_stated_to_be_absent(drone, stated, tmp_path):
    log = TruthLog()
    pose = b'{"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}'
    log.add_all([Record("/truth/vehicle", 3, 3, pose)] + ([Record("/truth/drone", 3, 3, drone)] if drone else []))
    log.write(tmp_path)
    assert (tmp_path / "truth_vehicle_drone.tum").exists() is stated


def fix(stamp_ns: int, z_m: float, track_id: int) -> DroneFix:
    where = np.array([0.0, 0.0, z_m])
    return DroneFix(
        stamp_ns=stamp_ns,
        xyz_vehicle_m=where,
        covariance_m2=np.eye(3),
        hits=5,
        track_id=track_id,
    )


def test_fixes_of_all_tracks_are_written_with_their_number(tmp_path):
    results = Results()
    results.open(Run(tmp_path, "", "", ""))
    for stamp, track in ((2_000_000_000, 1), (2_000_000_000, 2), (1_000_000_000, 2)):
        results.see("track.drone_fix", fix(stamp, float(track), track), 0)
    results.close()
    rows = (tmp_path / "fix_covariance.csv").read_text().splitlines()
    assert rows[0].endswith(",returns,iterations,track_id")
    assert [row.split(",")[-1] for row in rows[1:]] == ["1", "2", "2"]
    (tmp_path / "summary.json").write_text("{}")
    output = read_run(tmp_path).outputs[0]
    assert output.track is not None
    assert (output.track.tolist(), output.poses.xyz_m[:, 2].tolist()) == ([2, 1, 2], [2.0, 1.0, 2.0])


def test_each_track_logs_its_own_changes_of_state(tmp_path):
    results = Results()
    results.open(Run(tmp_path, "", "", ""))
    states = [
        (1, "SEARCHING"),
        (1, "TRACKING"),
        (2, "CANDIDATE"),
        (1, "TRACKING"),
        (2, "CANDIDATE"),
        (2, "TRACKING"),
        (1, "COASTING"),
    ]
    for second, (track, state) in enumerate(states):
        message = TrackState(
            stamp_ns=second * 1_000_000_000,
            state=TrackingState[state],
            reason="why",
            hits=0,
            frame_s=0.1,
            track_id=track,
        )
        results.see("track.track_state", message, 0)
    results.close()
    assert [(t.track_id, t.state) for t in results.transitions] == [states[i] for i in (0, 1, 2, 5, 6)]
    assert (tmp_path / "run.log").read_text().splitlines() == [
        "0.000000000 track.track_state: SEARCHING: why",
        "1.000000000 track.track_state: TRACKING: why",
        "2.000000000 track.track_state: track 2 CANDIDATE: why",
        "5.000000000 track.track_state: track 2 TRACKING: why",
        "6.000000000 track.track_state: COASTING: why",
    ]


def test_a_search_with_a_start_time_keeps_it(tmp_path):
    results = Results()
    results.open(Run(tmp_path, "", "", ""))
    empty, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    for start, end in ((1_000_000_000, 2_000_000_000), (2_000_000_000, 2_500_000_000), (None, 3_000_000_000)):
        evidence = KernelScores(e_inner=empty, e_outer=empty)
        if start is not None:
            evidence = CandidateEvidence(
                start_ns=start, candidate_id=none, seen_ns=none, velocity_vehicle_mps=np.zeros((0, 3)),
                log_odds=empty, probability=empty,
            )  # fmt: skip
        found = Detections(
            stamp_ns=end, xyz_vehicle_m=np.zeros((0, 3)), accepted=np.zeros(0, dtype=bool), reasons=(),
            summary="no drone", evidence=evidence,
        )  # fmt: skip
        results.see("detect.detections", found, 0)
    results.close()
    lines = (tmp_path / "detections.csv").read_text().splitlines()[1:]
    assert [line.split(",")[:2] for line in lines] == [
        ["1.000000000", "2.000000000"], ["2.000000000", "2.500000000"], ["2.500000000", "3.000000000"]
    ]  # fmt: skip


def test_every_sweep_has_a_line_with_its_accepted_candidates(tmp_path):
    results = Results()
    results.open(Run(tmp_path, "", "", ""))
    pixels = np.zeros((2, 2), dtype=np.float32)
    image = DepthImage(
        stamp_ns=2_000_000_000,
        start_ns=500_000_000,
        depth_m=pixels,
        focal_px=1.0,
        origin_vehicle_m=np.zeros(3),
        points=0,
        returns=0,
        turned_rad=3.1,
    )
    for accepted in ([False, True, True], [False, False, False]):
        found = Detections(
            stamp_ns=image.stamp_ns if any(accepted) else 4_000_000_000,
            xyz_vehicle_m=np.arange(9.0).reshape(3, 3),
            evidence=KernelScores(e_inner=np.zeros(3), e_outer=np.array([1.0, 2.0, 3.0])),
            accepted=np.array(accepted),
            reasons=("", "", ""),
            summary="",
        )
        results.see("sweep.depth_image", image, 0)
        results.see("detect.detections", found, 0)
    results.close()
    assert (tmp_path / "detections.csv").read_text().splitlines() == [
        "start_s,end_s,x_m,y_m,z_m,score",
        "0.500000000,2.000000000,3.0000,4.0000,5.0000,2",
        "0.500000000,2.000000000,6.0000,7.0000,8.0000,3",
        "2.000000000,4.000000000,,,,",
    ]
