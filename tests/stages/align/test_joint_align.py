"""The stage over time: rotations with consistent covariance, branches decided by motion, absences with a reason, jumps."""

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


def only(output) -> RelativeRotation:
    (message,) = output
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
def test_one_pair_gives_the_rotation_modulo_90_deg(streets):
    R_v, R_d = turned(1, -2, 30), turned(-6, 4, 251)
    output = pair(seen(CameraMount.VEHICLE, R_v, streets), seen(CameraMount.DRONE, R_d, streets))
    check_arrays(output)
    assert output.state is BranchState.AMBIGUOUS
    np.testing.assert_allclose(output.branch_probability, 0.2375)
    up = R_v.T[:, 2]
    assert up @ output.R_vehicle_drone @ R_d.T[:, 2] > math.cos(math.radians(0.5))
    level = rotation_about(up, np.arange(4) * math.pi / 2)
    assert min(angle_deg(R.T @ R_v.T @ R_d, output.R_vehicle_drone) for R in level) < 0.6
    assert np.all(np.linalg.eigvalsh(output.covariance_rad2) > 0)


def test_the_tilt_covariance_includes_errors_of_mount_and_lens():
    """NEES of both tilts over 150 rigs: mount errors of 0.05 deg and lens centre errors of 0.15 px at 720 px, 175 px per radian."""
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


def test_images_without_structure_give_no_rotation_and_the_reason():
    some, none = seen(CameraMount.VEHICLE, np.eye(3)), nothing(CameraMount.DRONE, reason="6 lines only")
    output = pair(some, none)
    assert output.R_vehicle_drone is None
    assert output.covariance_rad2 is None
    assert output.state is BranchState.NONE
    assert output.reason == "drone: 6 lines only"
    check_arrays(output)


def test_lines_in_all_directions_are_rejected():
    rng = np.random.default_rng(0)
    angles = tuple(rng.uniform(0, 180, 25).tolist())
    others = tuple(rng.uniform(0, 180, 25).tolist())
    output = pair(
        seen(CameraMount.VEHICLE, np.eye(3), angles, per_direction=2),
        seen(CameraMount.DRONE, np.eye(3), others, per_direction=2),
    )
    assert output.state is BranchState.NONE


def test_one_street_that_matches_several_is_rejected():
    """The vehicle's only street may be either of the drone's streets."""
    output = pair(seen(CameraMount.VEHICLE, np.eye(3), (34.0, 124.0)), seen(CameraMount.DRONE, np.eye(3), ATLANTA))
    assert output.R_vehicle_drone is None
    assert "which fits any street" in output.reason or "fit" in output.reason


def test_earlier_images_resolve_an_ambiguous_one():
    """Both streets are seen first; later the vehicle sees one only, which alone would be rejected."""
    stage, flight = JointAlign(), Flight(streets=CAMPUS)
    output = flight.run(stage, 4.0)
    assert all(m.R_vehicle_drone is not None for m in output)
    t = 4.1
    late = seen(CameraMount.VEHICLE, flight.R_world_vehicle(t), (61.0,), stamp_ns=START_NS + round(t * S))
    drone = seen(CameraMount.DRONE, flight.R_world_drone(t), CAMPUS, stamp_ns=START_NS + round(t * S))
    message = only([*stage.on_vehicle(late), *stage.on_drone(drone)])
    assert message.R_vehicle_drone is not None
    assert flight.quarters_off(message) < 1.0


@pytest.mark.parametrize("yaw_deg", [10.0, 100.0, 190.0, 280.0])
@pytest.mark.parametrize("autopilot", ["odometry", "split"])
def test_motion_resolves_the_correct_branch(yaw_deg, autopilot):
    flight = Flight(yaw0_deg=yaw_deg, turn_dps=8.0, autopilot=autopilot)
    output = flight.run(JointAlign(), 4.0)
    assert output[-1].state is BranchState.RESOLVED
    assert output[-1].branch_probability[0] > 0.999
    assert flight.error_deg(output[-1]) < 1.0
    assert wrong_and_resolved(flight, output) == 0
    assert all(m.branch_probability.sum() <= 1 + 1e-9 for m in output)
    first = next(m for m in output if m.state is BranchState.RESOLVED)
    assert (first.stamp_ns - START_NS) / S < 3.0


@pytest.mark.parametrize("yaw_deg", [10.0, 190.0])
def test_directions_of_images_resolve_the_branch_without_an_autopilot(yaw_deg):
    flight = Flight(yaw0_deg=yaw_deg, turn_dps=5.0, autopilot="none", images=True)
    output = flight.run(JointAlign(), 8.0)
    assert output[-1].state is BranchState.RESOLVED
    assert flight.error_deg(output[-1]) < 1.0
    assert wrong_and_resolved(flight, output) == 0


def test_turning_the_world_changes_nothing():
    """The result does not depend on the headings of the autopilot and the streets."""
    here = Flight(local_yaw_deg=0.0).run(JointAlign(), 3.0)
    there = Flight(local_yaw_deg=211.0).run(JointAlign(), 3.0)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a.R_vehicle_drone, b.R_vehicle_drone, atol=1e-6)
        np.testing.assert_allclose(a.branch_probability, b.branch_probability, atol=1e-6)


def test_the_turn_of_the_vehicle_is_compensated():
    flight = Flight(vehicle_dps=20.0, yaw0_deg=40.0)
    output = flight.run(JointAlign(), 4.0)
    assert output[-1].state is BranchState.RESOLVED
    assert max(flight.quarters_off(m) for m in output) < 1.0
    assert wrong_and_resolved(flight, output) == 0


@pytest.mark.parametrize("restart_deg", [0.0, 60.0, 90.0, 180.0])
def test_a_restart_of_the_vehicle_odometry_never_resolves_a_wrong_branch(restart_deg):
    """Its heading restarts; after a change of 90 deg the streets have the same directions."""
    flight = Flight(vehicle_silent=(4.0, 6.5), vehicle_restart_deg=restart_deg)
    output = flight.run(JointAlign(), 12.0)
    assert next(m for m in reversed(output) if m.stamp_ns < START_NS + 4 * S).state is BranchState.RESOLVED
    assert wrong_and_resolved(flight, output) == 0
    assert output[-1].state is BranchState.RESOLVED


@pytest.mark.parametrize("vehicle_dps", [-60.0, 40.0, 50.0])
def test_an_unmeasured_turn_of_the_vehicle_never_resolves_a_wrong_branch(vehicle_dps):
    flight = Flight(vehicle_dps=vehicle_dps, vehicle_silent=(4.0, 5.6))
    output = flight.run(JointAlign(), 10.0)
    assert wrong_and_resolved(flight, output) == 0
    assert output[-1].state is BranchState.RESOLVED


def test_without_vehicle_motion_only_a_parked_vehicle_resolves():
    silent = Flight(vehicle_odometry=False)
    assert silent.run(JointAlign(), 4.0)[-1].state is BranchState.AMBIGUOUS
    assert silent.run(JointAlign(parked=True), 4.0)[-1].state is BranchState.RESOLVED


@pytest.mark.parametrize(
    "left_out", [{"fixes": False}, {"autopilot": "none"}, {"autopilot": "attitude"}, {"speed_mps": 0.0}]
)
def test_without_motion_evidence_it_stays_ambiguous(left_out):
    output = Flight(**left_out).run(JointAlign(), 6.0)
    assert {m.state for m in output} == {BranchState.AMBIGUOUS}
    assert all(Flight(**left_out).quarters_off(m) < 1.0 for m in output)


@pytest.mark.parametrize("autopilot", ["odometry", "attitude", "none"])
def test_fast_turns_are_followed(autopilot):
    """120 deg/s, an image each 0.2 s: 24 deg per step. The resolved branch stays."""
    flight = Flight(turn_dps=120.0, autopilot=autopilot, images=autopilot == "none")
    output = flight.run(JointAlign(), 8.0)
    assert all(m.R_vehicle_drone is not None for m in output)
    assert max(flight.quarters_off(m) for m in output) < 1.0
    settled = [m for m in output if m.stamp_ns > START_NS + 6 * S]
    assert len({m.switches for m in settled}) == 1
    assert wrong_and_resolved(flight, output) == 0


def test_a_heading_reset_of_the_autopilot_changes_nothing():
    flight = Flight(reset_at_s=4.0)
    output = flight.run(JointAlign(), 8.0)
    assert output[-1].state is BranchState.RESOLVED
    assert flight.error_deg(output[-1]) < 1.0
    assert output[-1].switches == output[len(output) // 2 - 1].switches
    assert wrong_and_resolved(flight, output) == 0


def test_a_branch_flip_is_detected_and_reported():
    """All evidence from 6 s on is for another branch, as if the tracked yaw had slipped by 90 deg."""
    flight = Flight(false_yaw_deg=90.0, false_from_s=6.0)
    output = flight.run(JointAlign(), 12.0)
    before = [m for m in output if START_NS + 4 * S < m.stamp_ns < START_NS + 6 * S]
    assert {m.state for m in before} == {BranchState.RESOLVED}
    jumps = [m for m in output if "JUMP" in m.reason and m.stamp_ns > START_NS + 6 * S]
    assert len(jumps) == 1
    assert "by motion" in jumps[0].reason
    assert jumps[0].switches == before[-1].switches + 1
    assert (jumps[0].stamp_ns - START_NS) / S < 9.5
    assert any(m.state is BranchState.AMBIGUOUS for m in output if m.stamp_ns > START_NS + 6 * S)


def test_fixes_that_fit_no_branch_are_never_resolved():
    """45 deg between streets and displacement: the LiDAR follows another object."""
    output = Flight(false_yaw_deg=45.0, turn_dps=10.0).run(JointAlign(), 10.0)
    assert all(m.state is not BranchState.RESOLVED for m in output)
    assert any("fits no branch" in m.reason for m in output)


def test_the_branch_is_kept_through_a_short_gap_of_images():
    flight = Flight(turn_dps=40.0, blind=(5.0, 9.0))
    output = flight.run(JointAlign(), 11.0)
    assert {m.state for m in output if START_NS + 5.1 * S < m.stamp_ns < START_NS + 9 * S} == {BranchState.NONE}
    assert output[-1].state is BranchState.RESOLVED
    assert flight.error_deg(output[-1]) < 1.0


def test_the_branch_is_lost_without_lines_and_turns():
    flight = Flight(turn_dps=40.0, blind=(8.0, 12.0), silent=(8.0, 12.0), autopilot="none", images=True)
    output = flight.run(JointAlign(), 12.8)
    assert next(m for m in reversed(output) if m.stamp_ns < START_NS + 8 * S).state is BranchState.RESOLVED
    back = next(m for m in output if m.stamp_ns > START_NS + 12 * S)
    assert back.state is BranchState.AMBIGUOUS
    assert back.branch_probability[0] < 0.5
    assert wrong_and_resolved(flight, output) == 0


def test_a_prior_yaw_orders_the_branches_and_does_not_resolve():
    flight = Flight(fixes=False, yaw0_deg=193.0)
    output = flight.run(JointAlign(initial_yaw_deg=180.0), 2.0)
    assert {m.state for m in output} == {BranchState.AMBIGUOUS}
    assert max(flight.error_deg(m) for m in output) < 1.0
    assert output[0].branch_probability[0] > 0.8


def test_a_compass_orders_the_branches():
    """The vehicle's x is 77 deg to the left of the autopilot's north, so its compass reads -77."""
    flight = Flight(fixes=False, local_yaw_deg=77.0)
    output = flight.run(JointAlign(compass_deg=-77.0), 2.0)
    assert max(flight.error_deg(m) for m in output) < 1.0
    wrong = flight.run(JointAlign(compass_deg=13.0), 2.0)
    assert min(flight.error_deg(m) for m in wrong) > 80


@pytest.mark.parametrize(("vehicle_dps", "vehicle_odometry"), [(20.0, True), (0.0, False)])
def test_images_of_different_times_give_a_rotation_at_one_time(vehicle_dps, vehicle_odometry):
    """The time of the drone's image if the vehicle's turn is known, else that of the vehicle's image."""
    flight = Flight(turn_dps=100.0, vehicle_dps=vehicle_dps, vehicle_odometry=vehicle_odometry, image_lead_s=0.04)
    output = flight.run(JointAlign(), 3.0)
    offset = (output[-1].stamp_ns - START_NS) % (200 * MS)
    assert offset == (50 * MS if vehicle_odometry else 10 * MS)
    assert (
        max(flight.quarters_off(m) for m in output) < 0.5
    )  # the vehicle turns by 0.8 deg between them, the drone by 4


def test_images_with_a_larger_time_difference_are_no_pair():
    late = seen(CameraMount.DRONE, np.eye(3), stamp_ns=300 * MS)
    stage = JointAlign()
    output = [*stage.on_vehicle(seen(CameraMount.VEHICLE, np.eye(3))), *stage.on_drone(late), *stage.finish()]
    assert only(output).reason == "no image of the vehicle camera within 0.1 s"


def test_the_same_inputs_give_the_same_outputs():
    a, b = (Flight(turn_dps=20.0).run(JointAlign(), 3.0) for _ in range(2))
    for m, n in zip(a, b, strict=True):
        np.testing.assert_array_equal(m.R_vehicle_drone, n.R_vehicle_drone)
        assert m.reason == n.reason


def test_the_wrong_camera_on_a_port_is_an_error():
    with pytest.raises(ValueError, match="wire the other camera"):
        list(JointAlign().on_vehicle(nothing(CameraMount.DRONE)))


@pytest.mark.parametrize("wrong", [{"initial_yaw_deg": 0, "compass_deg": 0}, {"straight_deg": 0}, {"resolve": 0.9}])
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValueError):
        JointAlign(**wrong)


def test_no_wrong_branch_is_resolved_over_many_flights():
    """Slow and fast, with false fixes and drift beyond the assumed errors: a small Monte Carlo test."""
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
        output = flight.run(JointAlign(), 5.0, image_hz=2.5)
        assert wrong_and_resolved(flight, output) == 0
        decided += output[-1].state is BranchState.RESOLVED
    assert decided >= 12


def test_an_outlier_against_dead_reckoning_has_a_covariance_that_covers_it_and_no_lasting_effect():
    """Leaves have verticals of their own: one image of twelve has a roll and a yaw that contradict dead reckoning."""
    stage, R_d, output = JointAlign(), turned(3, -2, 40), []
    for i in range(12):
        now_ns = S + i * 200 * MS
        for ns in range(now_ns - 150 * MS, now_ns + 1, 50 * MS):
            stage.on_attitude(DroneAttitude(stamp_ns=ns, R_odom_drone=R_d, angular_velocity_drone_radps=np.zeros(3)))
            stage.on_motion(VehicleMotion(stamp_ns=ns, xyz_map_m=np.zeros(3), R_map_vehicle=np.eye(3), covariance=None))
        R_seen = turned(5, -2, 42) if i == 8 else R_d
        output += stage.on_vehicle(seen(CameraMount.VEHICLE, np.eye(3), stamp_ns=now_ns))
        output += stage.on_drone(seen(CameraMount.DRONE, R_seen, stamp_ns=now_ns))
    wrong = log_rotation(output[8].R_vehicle_drone.T @ output[7].R_vehicle_drone)
    assert math.degrees(np.linalg.norm(wrong)) > 2.0
    assert wrong @ np.linalg.solve(output[8].covariance_rad2, wrong) < 7.8
    sigma_deg = [math.degrees(math.sqrt(np.trace(m.covariance_rad2))) for m in output]
    assert sigma_deg[8] > 2.0
    assert sigma_deg[9] < 2.0 * sigma_deg[7] < 0.7  # the images have scattered
    assert angle_deg(output[9].R_vehicle_drone, output[7].R_vehicle_drone) < 0.3
