"""Recorded vehicle odometry, and a configuration with it on a recording without it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from flow.graph import load_graph
from flow.link import Record
from flow.replay import replay
from flow.stage import output_ports
from links.simulated.sensors.vehicle_odometry import VehicleOdometry as Simulated
from links.simulated.sensors.vehicle_odometry import VehicleOdometrySettings
from links.simulated.world.path import Path as SimulatedPath
from links.simulated.world.path import Waypoint
from links.vehicle_odometry import VehicleOdometry
from stages.geometry.frames import Pose, rotation_z
from stages.geometry.rig import RigOdometry
from stages.messages import VehicleMotion

COVARIANCE = np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.01, 0.04])
GOOD = {
    "xyz_m": [1.0, -2.0, 0.5],
    "quaternion_xyzw": [0.0, 0.0, math.sin(0.2), math.cos(0.2)],
    "covariance": COVARIANCE.ravel().tolist(),
}
PAPER = Path(__file__).parents[3] / "configs" / "paper.yaml"


def record(data: bytes, stamp_ns: int = 10) -> Record:
    return Record("/vehicle/odometry", arrival_ns=stamp_ns + 5, stamp_ns=stamp_ns, data=data)


def decoded(**changes: object) -> VehicleMotion | None:
    return VehicleOdometry().decode(record(json.dumps(GOOD | changes).encode()))


def test_a_pose_keeps_its_own_time_and_every_field() -> None:
    motion = decoded()
    assert motion is not None
    assert motion.stamp_ns == 10
    assert motion.xyz_map_m.tolist() == [1.0, -2.0, 0.5]
    assert motion.R_map_vehicle == pytest.approx(rotation_z(0.4))
    assert motion.covariance is not None
    assert np.array_equal(motion.covariance, COVARIANCE)
    assert output_ports(VehicleOdometry) == {"vehicle_motion": VehicleMotion}


def test_a_pose_of_another_reference_point_becomes_one_of_the_vehicle() -> None:
    """`base_link` is 1.4 m behind and 1.5 m below the camera. In a U-turn on the spot about it the camera moves."""
    behind = RigOdometry(T_vehicle_reference=Pose(xyz_m=(-1.4, 0.0, -1.5)))
    link = VehicleOdometry(reference=behind)
    start, turned = (
        link.decode(record(json.dumps(GOOD | {"xyz_m": [0, 0, 0], "quaternion_xyzw": q}).encode()))
        for q in ([0, 0, 0, 1], [0, 0, 1, 0])
    )
    assert start is not None
    assert turned is not None
    np.testing.assert_allclose(start.xyz_map_m, [1.4, 0.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(turned.xyz_map_m, [-1.4, 0.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(turned.R_map_vehicle, np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    # the error of its yaw, about z, moves the camera to the side; translation errors are in the vehicle's axes
    assert turned.covariance is not None
    assert turned.covariance[4, 4] == pytest.approx(
        COVARIANCE[4, 4] + 1.4**2 * COVARIANCE[2, 2] + 1.5**2 * COVARIANCE[0, 0]
    )


def test_poses_with_axes_forward_right_down_become_those_of_the_vehicle() -> None:
    """An INS that is 0.5 m to the right of the camera; it drives 4 m ahead and turns to the left by 90 deg."""
    ins = RigOdometry(axes="frd", T_vehicle_reference=Pose(xyz_m=(0.0, -0.5, 0.0)))
    quarter = [0.0, 0.0, -math.sin(math.pi / 4), math.cos(math.pi / 4)]
    pose = GOOD | {"xyz_m": [4.0, 0.0, 0.0], "quaternion_xyzw": quarter}
    motion = VehicleOdometry(reference=ins).decode(record(json.dumps(pose).encode()))
    assert motion is not None
    np.testing.assert_allclose(motion.R_map_vehicle, rotation_z(math.pi / 2), atol=1e-12)
    np.testing.assert_allclose(motion.xyz_map_m, [4.0 - 0.5, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("quaternion", [[0.9659, 0.0, 0.0, 0.2588], [1.0, 0.0, 0.0, 0.0], [0.4, 0.0, 0.0, 0.9165]])
def test_a_vehicle_on_its_side_or_roof_is_rejected(quaternion: list[float]) -> None:
    """As with a quaternion w, x, y, z, or axes with z down in a frame with z up."""
    link = VehicleOdometry()
    assert link.decode(record(json.dumps(GOOD | {"quaternion_xyzw": quaternion}).encode())) is None
    assert link.counters.rejected["the vehicle is tilted by more than 45 deg"] == 1
    assert link.rejected == 1


def test_a_source_that_does_not_state_its_covariance_has_none() -> None:
    motion = decoded(covariance=None)
    assert motion is not None
    assert motion.covariance is None
    without = {name: value for name, value in GOOD.items() if name != "covariance"}
    assert VehicleOdometry().decode(record(json.dumps(without).encode())) is not None


def changed(row: int, column: int, value: float) -> list[float]:
    covariance = COVARIANCE.copy()
    covariance[row, column] = value
    return covariance.ravel().tolist()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xfe",
        b"[]",
        b"null",
        b"[" * 900,
        b'{"xyz_m": [1, 2, 3]}',
        *(
            json.dumps(GOOD | change).encode()
            for change in (
                {"xyz_m": [1.0, 2.0]},
                {"xyz_m": "123"},
                {"xyz_m": [1.0, 2.0, None]},
                {"xyz_m": [1.0, 2.0, float("nan")]},
                {"xyz_m": [1.0, 2.0, 1e300]},
                {"quaternion_xyzw": [0.0, 0.0, 0.0, 0.0]},
                {"quaternion_xyzw": [0.0, 0.0, 0.0, 1.1]},
                {"quaternion_xyzw": [0.0, 0.0, float("inf"), 1.0]},
                {"quaternion_xyzw": [0.0, 0.0, 1.0]},
                {"covariance": [1.0] * 35},
                {"covariance": "none"},
                {"covariance": changed(3, 3, float("nan"))},
                {"covariance": changed(3, 3, -0.01)},
                {"covariance": changed(0, 1, 5e-5)},  # not symmetric
                {"more": "x" * 5000},
            )
        ),
    ],
)
def test_a_record_without_a_valid_pose_is_counted_and_skipped(data: bytes) -> None:
    odometry = VehicleOdometry()
    assert odometry.decode(record(data)) is None
    assert odometry.rejected == 1


def test_the_simulated_odometry_is_decoded_with_its_covariance() -> None:
    bend = SimulatedPath(
        waypoints=(
            Waypoint(t_s=0, xyz_m=(0, 0, 0), yaw_deg=30),
            Waypoint(t_s=4, xyz_m=(15, 9, 0), yaw_deg=70),
        )
    )
    link, before_ns = VehicleOdometry(), -1
    for row in Simulated(VehicleOdometrySettings(), bend, 0, 4.0, seed=3).records(4_000_000_000):
        motion = link.decode(row)
        assert motion is not None
        assert motion.covariance is not None
        assert motion.stamp_ns == row.stamp_ns > before_ns
        before_ns = motion.stamp_ns
    assert link.rejected == 0
    expected_m = np.array([15 * math.cos(math.pi / 6) + 9 / 2, -15 / 2 + 9 * math.cos(math.pi / 6), 0.0])
    assert motion.xyz_map_m == pytest.approx(expected_m, abs=0.5)
    assert motion.R_map_vehicle == pytest.approx(rotation_z(math.radians(40)), abs=0.03)


def test_a_recording_without_odometry_gives_no_messages(tmp_path: Path) -> None:
    overlay = tmp_path / "with_odometry.yaml"
    source = "odometry: {use: links.vehicle_odometry.VehicleOdometry}"
    overlay.write_text(f"links: {{viewer: null, {source}}}\n", encoding="utf-8")
    graph = load_graph(PAPER, [overlay])
    other = Record("/servo/state", 1, 1, b"{}")
    assert replay(graph, [other]).messages["odometry.vehicle_motion"] == 0
    assert replay(graph, [other, record(json.dumps(GOOD).encode())]).messages["odometry.vehicle_motion"] == 1
