"""From a recording's truth to the files that an evaluation reads: nothing is lost or turned on the way."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flow.link import LinkError, Record, Run
from links.evaluation.errors import euler_rpy
from links.evaluation.tum import read_tum
from links.results import Results
from links.truth import TruthLog
from stages.geometry import rotations_from_xyzw
from stages.messages import DepthImage, Detections
from tests.links.evaluation.made_runs import yaw_quaternion


def pose(topic: str, stamp_ns: int, xyz, yaw_deg: float) -> Record:
    q = yaw_quaternion([np.radians(yaw_deg)])[0].tolist()
    return Record(topic, stamp_ns, stamp_ns, json.dumps({"xyz_m": xyz, "quaternion_xyzw": q}).encode())


def test_truth_is_written_as_the_drone_in_the_vehicle_with_its_rotation(tmp_path):
    """The vehicle at (10, 0, 0) looks left (yaw 90 deg); the drone 5 m to its left-hand world side looks back (180)."""
    log = TruthLog()
    records = [
        pose("/truth/vehicle", 1_000_000_000, [10.0, 0, 0], 90),
        pose("/truth/drone", 1_000_000_000, [10.0, 5, 7], 180),
        Record("/truth/hits", 0, 0, b'{"pulse_stamp_ns": []}'),
        Record("/truth/hits", 0, 0, b'{"pulse_stamp_ns": [3000000001, 2]}'),
        Record("/lidar/packets", 0, 0, b""),
    ]
    assert [r.topic for r in log.aside(records)] == ["/lidar/packets"]
    log.write(tmp_path)
    truth = read_tum(tmp_path / "truth_vehicle_drone.tum")
    assert truth.stamps_ns.tolist() == [1_000_000_000]
    assert truth.xyz_m[0] == pytest.approx([5, 0, 7])
    assert truth.quaternion_xyzw is not None
    assert np.degrees(euler_rpy(rotations_from_xyzw(truth.quaternion_xyzw)))[0] == pytest.approx([0, 0, 90], abs=1e-3)
    assert (tmp_path / "truth_hits.csv").read_text() == "stamp_s\n0.000000002\n3.000000001\n"


def test_a_recording_without_a_drone_says_so_and_one_without_truth_says_nothing(tmp_path):
    log = TruthLog()
    list(log.aside([pose("/truth/vehicle", 5, [0, 0, 0], 0)]))
    log.write(tmp_path)
    assert (tmp_path / "truth_vehicle_drone.tum").read_text() == "# no drone in this recording\n"
    assert not (tmp_path / "truth_hits.csv").exists()
    (tmp_path / "b").mkdir()
    TruthLog().write(tmp_path / "b")
    assert list((tmp_path / "b").iterdir()) == []


def test_hits_that_are_none_are_refused():
    with pytest.raises(LinkError, match="holds no pulses"):
        list(TruthLog().aside([Record("/truth/hits", 0, 0, b"{}")]))


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
            score=np.array([1.0, 2.0, 3.0]),
            e_inner=np.zeros(3),
            e_outer=np.zeros(3),
            accepted=np.array(accepted),
            reasons=("", "", ""),
            verdict="",
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
