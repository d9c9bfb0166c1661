"""The stage over time: rotations right and honest, branches decided by motion, refused where nothing is known, jumps told."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.align.joint_align import JointAlign
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import (
    BranchState,
    CameraMount,
    DroneAttitude,
    RelativeRotation,
    VanishingDirections,
    VehicleMotion,
)
from tests.stages.align.made_joint_flight import START_NS, Flight, S, wrong_and_resolved
from tests.stages.align.made_lines import ATLANTA, CAMPUS, MS, nothing, seen, turned


def only(told) -> RelativeRotation:
    (message,) = told
    return message


def pair(vehicle: VanishingDirections, drone: VanishingDirections, **settings) -> RelativeRotation:
    stage = JointAlign(**settings)
    return only([*stage.on_vehicle(vehicle), *stage.on_drone(drone)])


def rotation_about(axis, angles_rad):
    return [exp_rotation(axis * angle) for angle in angles_rad]


def angle_deg(A, B) -> float:
    return math.degrees(float(np.linalg.norm(log_rotation(A.T @ B))))


def test_its_ports():
    assert set(input_ports(JointAlign)) == {
        "motion", "attitude", "position", "odometry", "visual_motion", "fix", "vehicle", "drone",
    }  # fmt: skip
    assert set(input_ports(JointAlign)) - JointAlign.optional_inputs == {"vehicle", "drone"}
    assert output_ports(JointAlign) == {"relative_rotation": RelativeRotation}


@pytest.mark.parametrize("streets", [(0.0, 90.0), ATLANTA, CAMPUS])
def test_one_pair_gives_the_rotation_up_to_a_quarter_turn(streets):
    R_v, R_d = turned(1, -2, 30), turned(-6, 4, 251)
    told = pair(seen(CameraMount.VEHICLE, R_v, streets), seen(CameraMount.DRONE, R_d, streets))
    check_arrays(told)
    assert told.state is BranchState.AMBIGUOUS
    np.testing.assert_allclose(told.branch_probability, 0.2375)
    up = R_v.T[:, 2]
    assert up @ told.R_vehicle_drone @ R_d.T[:, 2] > math.cos(math.radians(0.5))
    level = rotation_about(up, np.arange(4) * math.pi / 2)
    assert min(angle_deg(R.T @ R_v.T @ R_d, told.R_vehicle_drone) for R in level) < 0.6
    assert np.all(np.linalg.eigvalsh(told.covariance_rad2) > 0)


def test_the_stated_tilts_allow_for_cameras_that_do_not_sit_and_look_quite_as_their_file_says():
    """NEES of both tilts over 150 rigs: mounts 0.05 deg off, and lens centres 0.15 px at 720 px, 175 px a radian."""
    rng = np.random.default_rng(11)
    off_rad = np.array([math.hypot(math.radians(0.05), 0.15 / 175.0)] * 2 + [math.radians(0.05)])
    R_vehicle, R_drone = turned(0, 0, 0), turned(0, 0, 25)
    squares = []
    for seed in range(150):
        off_v, off_d = exp_rotation(rng.normal(0, off_rad)), exp_rotation(rng.normal(0, off_rad))
        answer = pair(
            seen(CameraMount.VEHICLE, R_vehicle @ off_v, ATLANTA, seed=seed),
            seen(CameraMount.DRONE, R_drone @ off_d, ATLANTA, seed=seed),
        )
        branches = (turned(0, 0, 25 + quarter).T @ answer.R_vehicle_drone for quarter in (0, 90, 180, 270))
        phi = min((log_rotation(np.ascontiguousarray(off)) for off in branches), key=np.linalg.norm)
        squares.append(phi[:2] @ np.linalg.solve(answer.covariance_rad2[:2, :2], phi[:2]))
    assert 0.7 < np.mean(squares) / 2 < 1.3
    assert np.mean(np.array(squares) < 5.99) > 0.9


def test_pictures_without_structure_give_no_rotation_and_the_reason():
    some, none = seen(CameraMount.VEHICLE, np.eye(3)), nothing(CameraMount.DRONE, reason="6 lines only")
    told = pair(some, none)
    assert told.R_vehicle_drone is None
    assert told.covariance_rad2 is None
    assert told.state is BranchState.NONE
    assert told.reason == "drone: 6 lines only"
    check_arrays(told)


def test_trees_in_all_directions_are_refused():
    rng = np.random.default_rng(0)
    angles = tuple(rng.uniform(0, 180, 25).tolist())
    others = tuple(rng.uniform(0, 180, 25).tolist())
    told = pair(
        seen(CameraMount.VEHICLE, np.eye(3), angles, per_direction=2),
        seen(CameraMount.DRONE, np.eye(3), others, per_direction=2),
    )
    assert told.state is BranchState.NONE


def test_one_street_of_the_vehicles_that_could_be_any_of_the_drones_is_refused():
    """Nothing tells whether the vehicle's only street is the drone's first or its second."""
    told = pair(seen(CameraMount.VEHICLE, np.eye(3), (34.0, 124.0)), seen(CameraMount.DRONE, np.eye(3), ATLANTA))
    assert told.R_vehicle_drone is None
    assert "could be any street's" in told.reason or "fit" in told.reason


def test_what_one_picture_leaves_open_the_pictures_before_it_have_settled():
    """Both streets are seen first; later the vehicle sees one only, which alone would be refused."""
    stage, flight = JointAlign(), Flight(streets=CAMPUS)
    told = flight.run(stage, 4.0)
    assert all(m.R_vehicle_drone is not None for m in told)
    t = 4.1
    late = seen(CameraMount.VEHICLE, flight.R_world_vehicle(t), (61.0,), stamp_ns=START_NS + round(t * S))
    drone = seen(CameraMount.DRONE, flight.R_world_drone(t), CAMPUS, stamp_ns=START_NS + round(t * S))
    message = only([*stage.on_vehicle(late), *stage.on_drone(drone)])
    assert message.R_vehicle_drone is not None
    assert flight.quarters_off(message) < 1.0


@pytest.mark.parametrize("yaw_deg", [10.0, 100.0, 190.0, 280.0])
@pytest.mark.parametrize("autopilot", ["odometry", "split"])
def test_motion_decides_the_branch_and_the_rotation_is_then_right(yaw_deg, autopilot):
    flight = Flight(yaw0_deg=yaw_deg, turn_dps=8.0, autopilot=autopilot)
    told = flight.run(JointAlign(), 4.0)
    assert told[-1].state is BranchState.RESOLVED
    assert told[-1].branch_probability[0] > 0.999
    assert flight.error_deg(told[-1]) < 1.0
    assert wrong_and_resolved(flight, told) == 0
    assert all(m.branch_probability.sum() <= 1 + 1e-9 for m in told)
    first = next(m for m in told if m.state is BranchState.RESOLVED)
    assert (first.stamp_ns - START_NS) / S < 3.0


@pytest.mark.parametrize("yaw_deg", [10.0, 190.0])
def test_directions_from_pictures_decide_it_without_an_autopilot(yaw_deg):
    flight = Flight(yaw0_deg=yaw_deg, turn_dps=5.0, autopilot="none", images=True)
    told = flight.run(JointAlign(), 8.0)
    assert told[-1].state is BranchState.RESOLVED
    assert flight.error_deg(told[-1]) < 1.0
    assert wrong_and_resolved(flight, told) == 0


def test_turning_the_world_changes_nothing():
    """The autopilot's north and the streets' are not ours."""
    here = Flight(local_yaw_deg=0.0).run(JointAlign(), 3.0)
    there = Flight(local_yaw_deg=211.0).run(JointAlign(), 3.0)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a.R_vehicle_drone, b.R_vehicle_drone, atol=1e-6)
        np.testing.assert_allclose(a.branch_probability, b.branch_probability, atol=1e-6)


def test_a_turning_vehicle_is_taken_into_account():
    flight = Flight(vehicle_dps=20.0, yaw0_deg=40.0)
    told = flight.run(JointAlign(), 4.0)
    assert told[-1].state is BranchState.RESOLVED
    assert max(flight.quarters_off(m) for m in told) < 1.0
    assert wrong_and_resolved(flight, told) == 0


@pytest.mark.parametrize("afresh_deg", [0.0, 60.0, 90.0, 180.0])
def test_a_vehicle_odometry_started_afresh_in_a_silence_is_never_a_quarter_turn_of_the_drone(afresh_deg):
    """Its heading restarts; where that is a quarter turn off, the streets look alike."""
    flight = Flight(vehicle_silent=(4.0, 6.5), vehicle_afresh_deg=afresh_deg)
    told = flight.run(JointAlign(), 12.0)
    assert next(m for m in reversed(told) if m.stamp_ns < START_NS + 4 * S).state is BranchState.RESOLVED
    assert wrong_and_resolved(flight, told) == 0
    assert told[-1].state is BranchState.RESOLVED


@pytest.mark.parametrize("vehicle_dps", [-60.0, 40.0, 50.0])
def test_what_the_vehicle_turned_while_silent_is_no_quarter_turn_of_the_drone(vehicle_dps):
    flight = Flight(vehicle_dps=vehicle_dps, vehicle_silent=(4.0, 5.6))
    told = flight.run(JointAlign(), 10.0)
    assert wrong_and_resolved(flight, told) == 0
    assert told[-1].state is BranchState.RESOLVED


def test_without_the_vehicles_motion_nothing_is_concluded_unless_it_is_parked():
    silent = Flight(tells_vehicle=False)
    assert silent.run(JointAlign(), 4.0)[-1].state is BranchState.AMBIGUOUS
    assert silent.run(JointAlign(parked=True), 4.0)[-1].state is BranchState.RESOLVED


@pytest.mark.parametrize(
    "left_out", [{"fixes": False}, {"autopilot": "none"}, {"autopilot": "attitude"}, {"speed_mps": 0.0}]
)
def test_without_motion_evidence_it_stays_ambiguous(left_out):
    told = Flight(**left_out).run(JointAlign(), 6.0)
    assert {m.state for m in told} == {BranchState.AMBIGUOUS}
    assert all(Flight(**left_out).quarters_off(m) < 1.0 for m in told)


@pytest.mark.parametrize("autopilot", ["odometry", "attitude", "none"])
def test_fast_turns_are_followed(autopilot):
    """120 deg/s, a image each 0.2 s: 24 deg a step. Resolved and turning, the branch stays."""
    flight = Flight(turn_dps=120.0, autopilot=autopilot, images=autopilot == "none")
    told = flight.run(JointAlign(), 8.0)
    assert all(m.R_vehicle_drone is not None for m in told)
    assert max(flight.quarters_off(m) for m in told) < 1.0
    settled = [m for m in told if m.stamp_ns > START_NS + 6 * S]
    assert len({m.switches for m in settled}) == 1
    assert wrong_and_resolved(flight, told) == 0


def test_a_heading_reset_of_the_autopilot_changes_nothing():
    flight = Flight(reset_at_s=4.0)
    told = flight.run(JointAlign(), 8.0)
    assert told[-1].state is BranchState.RESOLVED
    assert flight.error_deg(told[-1]) < 1.0
    assert told[-1].switches == told[len(told) // 2 - 1].switches
    assert wrong_and_resolved(flight, told) == 0


def test_a_flip_is_found_and_told():
    """All evidence from 6 s on is for another branch, as if the followed yaw had slipped by a quarter."""
    flight = Flight(false_yaw_deg=90.0, false_from_s=6.0)
    told = flight.run(JointAlign(), 12.0)
    before = [m for m in told if START_NS + 4 * S < m.stamp_ns < START_NS + 6 * S]
    assert {m.state for m in before} == {BranchState.RESOLVED}
    jumps = [m for m in told if "JUMP" in m.reason and m.stamp_ns > START_NS + 6 * S]
    assert len(jumps) == 1
    assert "by motion" in jumps[0].reason
    assert jumps[0].switches == before[-1].switches + 1
    assert (jumps[0].stamp_ns - START_NS) / S < 9.5
    assert any(m.state is BranchState.AMBIGUOUS for m in told if m.stamp_ns > START_NS + 6 * S)


def test_fixes_that_fit_no_branch_are_never_resolved():
    """45 deg between the streets and the way: the LiDAR follows something else."""
    told = Flight(false_yaw_deg=45.0, turn_dps=10.0).run(JointAlign(), 10.0)
    assert all(m.state is not BranchState.RESOLVED for m in told)
    assert any("fits no branch" in m.reason for m in told)


def test_through_a_short_blindness_the_branch_is_kept():
    flight = Flight(turn_dps=40.0, blind=(5.0, 9.0))
    told = flight.run(JointAlign(), 11.0)
    assert {m.state for m in told if START_NS + 5.1 * S < m.stamp_ns < START_NS + 9 * S} == {BranchState.NONE}
    assert told[-1].state is BranchState.RESOLVED
    assert flight.error_deg(told[-1]) < 1.0


def test_when_lines_and_turns_are_both_lost_the_branch_is_lost():
    flight = Flight(turn_dps=40.0, blind=(8.0, 12.0), silent=(8.0, 12.0), autopilot="none", images=True)
    told = flight.run(JointAlign(), 12.8)
    assert next(m for m in reversed(told) if m.stamp_ns < START_NS + 8 * S).state is BranchState.RESOLVED
    back = next(m for m in told if m.stamp_ns > START_NS + 12 * S)
    assert back.state is BranchState.AMBIGUOUS
    assert back.branch_probability[0] < 0.5
    assert wrong_and_resolved(flight, told) == 0


def test_a_prior_yaw_orders_the_branches_and_does_not_resolve():
    flight = Flight(fixes=False, yaw0_deg=193.0)
    told = flight.run(JointAlign(initial_yaw_deg=180.0), 2.0)
    assert {m.state for m in told} == {BranchState.AMBIGUOUS}
    assert max(flight.error_deg(m) for m in told) < 1.0
    assert told[0].branch_probability[0] > 0.8


def test_a_compass_orders_the_branches():
    """The vehicle's x is 77 deg to the left of the autopilot's north, so its compass says -77."""
    flight = Flight(fixes=False, local_yaw_deg=77.0)
    told = flight.run(JointAlign(compass_deg=-77.0), 2.0)
    assert max(flight.error_deg(m) for m in told) < 1.0
    wrong = flight.run(JointAlign(compass_deg=13.0), 2.0)
    assert min(flight.error_deg(m) for m in wrong) > 80


@pytest.mark.parametrize(("vehicle_dps", "tells"), [(20.0, True), (0.0, False)])
def test_pictures_apart_in_time_are_told_at_one_moment(vehicle_dps, tells):
    """At the drone's if the vehicle's turn is known, else at the vehicle's if the drone's is."""
    flight = Flight(turn_dps=100.0, vehicle_dps=vehicle_dps, tells_vehicle=tells, apart_s=0.04)
    told = flight.run(JointAlign(), 3.0)
    offset = (told[-1].stamp_ns - START_NS) % (200 * MS)
    assert offset == (50 * MS if tells else 10 * MS)
    assert max(flight.quarters_off(m) for m in told) < 0.5  # the vehicle turns by 0.8 deg between them, the drone by 4


def test_pictures_too_far_apart_are_no_pair():
    late = seen(CameraMount.DRONE, np.eye(3), stamp_ns=300 * MS)
    stage = JointAlign()
    told = [*stage.on_vehicle(seen(CameraMount.VEHICLE, np.eye(3))), *stage.on_drone(late), *stage.finish()]
    assert only(told).reason == "no picture of the vehicle's within 0.1 s"


def test_the_same_inputs_give_the_same_outputs():
    a, b = (Flight(turn_dps=20.0).run(JointAlign(), 3.0) for _ in range(2))
    for m, n in zip(a, b, strict=True):
        np.testing.assert_array_equal(m.R_vehicle_drone, n.R_vehicle_drone)
        assert m.reason == n.reason


def test_the_wrong_camera_on_a_port_is_an_error():
    with pytest.raises(ValueError, match="wire the other camera"):
        list(JointAlign().on_vehicle(nothing(CameraMount.DRONE)))


@pytest.mark.parametrize("wrong", [{"initial_yaw_deg": 0, "compass_deg": 0}, {"straight_deg": 0}, {"resolve": 0.9}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError):
        JointAlign(**wrong)


def test_no_wrong_branch_is_resolved_over_many_flights():
    """Slow and fast, with false fixes and drift beyond what is expected: a small Monte Carlo, the large one is in the report."""
    decided = 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        flight = Flight(
            speed_mps=float(rng.choice([0.15, 0.4, 1.0, 2.5])),
            yaw0_deg=float(rng.uniform(0, 360)),
            turn_dps=float(rng.uniform(-60, 60)),
            vehicle_dps=float(rng.uniform(-15, 15)),
            fix_sigma_m=0.08,
            autopilot=str(rng.choice(["odometry", "split"])),
            per_direction=6,
            seed=seed,
        )
        told = flight.run(JointAlign(), 5.0, picture_hz=2.5)
        assert wrong_and_resolved(flight, told) == 0
        decided += told[-1].state is BranchState.RESOLVED
    assert decided >= 12


def test_a_picture_that_contradicts_the_turns_felt_is_wrong_by_as_much_and_leads_nobody_astray():
    """Leaves have verticals of their own: one image of twelve tells a roll and a yaw that nobody felt."""
    stage, R_d, told = JointAlign(), turned(3, -2, 40), []
    for i in range(12):
        now_ns = S + i * 200 * MS
        for ns in range(now_ns - 150 * MS, now_ns + 1, 50 * MS):
            stage.on_attitude(DroneAttitude(stamp_ns=ns, R_odom_drone=R_d, angular_velocity_drone_radps=np.zeros(3)))
            stage.on_motion(VehicleMotion(stamp_ns=ns, xyz_map_m=np.zeros(3), R_map_vehicle=np.eye(3), covariance=None))
        R_seen = turned(5, -2, 42) if i == 8 else R_d
        told += stage.on_vehicle(seen(CameraMount.VEHICLE, np.eye(3), stamp_ns=now_ns))
        told += stage.on_drone(seen(CameraMount.DRONE, R_seen, stamp_ns=now_ns))
    wrong = log_rotation(told[8].R_vehicle_drone.T @ told[7].R_vehicle_drone)
    assert math.degrees(np.linalg.norm(wrong)) > 2.0
    assert wrong @ np.linalg.solve(told[8].covariance_rad2, wrong) < 7.8
    sigma_deg = [math.degrees(math.sqrt(np.trace(m.covariance_rad2))) for m in told]
    assert sigma_deg[8] > 2.0
    assert sigma_deg[9] < 2.0 * sigma_deg[7] < 0.7  # images have been seen to scatter
    assert angle_deg(told[9].R_vehicle_drone, told[7].R_vehicle_drone) < 0.3
