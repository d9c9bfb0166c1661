"""The stage: every rotation that a pair of images allows, with consistent covariances, or the reason for none."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.align.joint_align import JointAlign
from stages.align.refine import Tolerances, refine
from stages.align.spectra import level_lines
from stages.heading.bank_measurements import add_vertical
from stages.heading.inertial_bank import start
from stages.heading.rotation_matches import RotationMatches, add_matches
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import (
    BranchState,
    CameraMount,
    RelativeRotation,
    VanishingDirections,
    VehicleMotion,
    WeightedAnswers,
)
from tests.stages.align.made_lines import ATLANTA, CAMPUS, MS, nothing, seen, turned

VEHICLE_AND_DRONE = (CameraMount.VEHICLE, (70.0,)), (CameraMount.DRONE, (0.0,))


def only(output) -> RelativeRotation:
    (message,) = output
    return message


def pair(vehicle: VanishingDirections, drone: VanishingDirections, **settings) -> RelativeRotation:
    stage = JointAlign(**settings)
    return only([*stage.on_vehicle(vehicle), *stage.on_drone(drone)])


def off_deg(R_true, R) -> float:
    """Degrees to the nearest branch, the vehicle level."""
    return min(
        math.degrees(float(np.linalg.norm(log_rotation(np.ascontiguousarray(R_true.T @ turned(0, 0, yaw) @ R)))))
        for yaw in (0, 90, 180, 270)
    )


def test_its_ports():
    assert set(input_ports(JointAlign)) == {"motion", "vehicle", "drone"}
    assert set(input_ports(JointAlign)) - JointAlign.optional_inputs == {"vehicle", "drone"}
    assert output_ports(JointAlign) == {"relative_rotation": RelativeRotation}


@pytest.mark.parametrize("streets", [(0.0, 90.0), ATLANTA, CAMPUS])
def test_one_pair_gives_the_rotation_modulo_90_deg(streets):
    R_v, R_d = turned(1, -2, 30), turned(-6, 4, 251)
    output = pair(seen(CameraMount.VEHICLE, R_v, streets), seen(CameraMount.DRONE, R_d, streets))
    check_arrays(output)
    assert output.state is BranchState.OPEN
    assert output.probabilities[0] > 0.75
    np.testing.assert_allclose(output.branch_probability, output.probabilities[0] / 4)
    up = R_v.T[:, 2]
    assert up @ output.R_vehicle_drone @ R_d.T[:, 2] > math.cos(math.radians(0.5))
    branches = [exp_rotation(up * k * math.pi / 2) @ R_v.T @ R_d for k in range(4)]
    off = [math.degrees(np.linalg.norm(log_rotation(R.T @ output.R_vehicle_drone))) for R in branches]
    assert min(off) < 0.6
    assert np.all(np.linalg.eigvalsh(output.covariance_rad2) > 0)


def test_a_street_that_may_be_either_of_two_gives_both_matches():
    """The vehicle's only street may be either of the drone's: 0 and 34 deg."""
    drone = seen(CameraMount.DRONE, turned(0, 0, 10), ATLANTA)
    output = pair(seen(CameraMount.VEHICLE, np.eye(3), (34.0, 124.0)), drone)
    check_arrays(output)
    right = [k for k, R in enumerate(output.rotations) if off_deg(turned(0, 0, 10), R) < 0.6]
    wrong = [k for k, R in enumerate(output.rotations) if off_deg(turned(0, 0, 10 + 34), R) < 0.6]
    assert len(right) == len(wrong) == 1
    assert output.probabilities[right + wrong].min() > 0.3
    assert output.probabilities.sum() < 1.0
    assert np.all(np.diff(output.probabilities) <= 0)


def with_two_answers(image: VanishingDirections, other_up, probabilities=(0.4, 0.6)) -> VanishingDirections:
    """The image without a single answer: the true vertical, or another one with the lines of the same streets."""
    owner = np.where(image.line_direction > 2, -1, image.line_direction)
    answers = WeightedAnswers(
        up=np.array([image.direction[0], other_up]),
        sigma_rad=np.full(2, 0.004),
        probability=np.array(probabilities),
        line_direction=np.array([owner, owner]),
    )
    return dataclasses.replace(
        nothing(image.camera_mount),
        line_normal=image.line_normal,
        line_end=image.line_end,
        line_sigma_rad=image.line_sigma_rad,
        line_direction=np.full(len(owner), -1),
        answers=answers,
    )


def test_an_image_with_two_answers_gives_the_matches_of_both_and_the_level_of_the_drone_selects_one():
    R_v, R_d = turned(0, 0, 30), turned(0, 0, 251)
    other_up = turned(9, -7, 0)[:, 2]
    drone = with_two_answers(seen(CameraMount.DRONE, R_d), other_up)
    check_arrays(drone)
    output = pair(seen(CameraMount.VEHICLE, R_v), drone)
    check_arrays(output)
    off = np.array([off_deg(R_v.T @ R_d, R) for R in output.rotations])
    right = off < 1.0
    assert right.any()
    assert (off > 5.0).any()
    assert output.probabilities[right].sum() == pytest.approx(0.4, abs=0.1)
    assert output.probabilities.sum() < 1.0
    up = np.array([0.0, 0.0, 1.0])
    bank = start(np.zeros(3), 0.01 * np.eye(3), None, up)
    for _ in range(3):
        add_vertical(bank, up, math.radians(2.0))  # gravity, as the heading knows it from its IMU
    add_matches(bank, RotationMatches(output.rotations, output.covariances_rad2, output.probabilities, np.eye(3)), 1.0)
    assert bank.tied.any()
    for R in bank.state.R[bank.tied]:
        assert off_deg(R_v.T @ R_d, R) < 3.0


def test_the_tilt_covariance_includes_errors_of_mount_and_lens():
    """NEES of both tilts over 150 rigs: mount errors of 0.05 deg and lens centre errors of 0.15 px at 720 px, 175 px per radian."""
    rng = np.random.default_rng(11)
    off_rad = np.array([math.hypot(math.radians(0.05), 0.15 / 175.0)] * 2 + [math.radians(0.05)])
    R_vehicle, R_drone = turned(0, 0, 0), turned(0, 0, 25)
    squares = []
    for seed in range(150):
        off_v, off_d = exp_rotation(rng.normal(0, off_rad)), exp_rotation(rng.normal(0, off_rad))
        match = pair(
            seen(CameraMount.VEHICLE, R_vehicle @ off_v, ATLANTA, up_error_rad=0.004, seed=seed),
            seen(CameraMount.DRONE, R_drone @ off_d, ATLANTA, up_error_rad=0.004, seed=seed),
            tilt_sigma_deg=0.07,
        )
        branches = (turned(0, 0, 25 + quarter).T @ match.R_vehicle_drone for quarter in (0, 90, 180, 270))
        phi = min((log_rotation(np.ascontiguousarray(off)) for off in branches), key=np.linalg.norm)
        squares.append(phi[:2] @ np.linalg.solve(match.covariance_rad2[:2, :2], phi[:2]))
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


def test_lines_in_all_directions_have_no_probable_match():
    rng = np.random.default_rng(0)
    angles, others = (tuple(rng.uniform(0, 180, 25).tolist()) for _ in range(2))
    output = pair(
        seen(CameraMount.VEHICLE, np.eye(3), angles, per_direction=2),
        seen(CameraMount.DRONE, np.eye(3), others, per_direction=2),
    )
    assert len(output.rotations) > 5
    assert output.probabilities[0] < 0.2
    assert 1.0 - output.probabilities.sum() > 0.05  # that no match is right


def test_streets_that_neither_camera_shares_with_the_other_give_no_rotation():
    """At no yaw of the overlap does a street of one camera run along one of the other's: the yaw is not determined."""
    vehicle, drone = (level_lines(seen(mount, np.eye(3), streets), 0.004) for mount, streets in VEHICLE_AND_DRONE)
    assert vehicle is not None
    assert drone is not None
    tolerances = Tolerances(straight_rad=0.004, direction_rad=0.002, square_rad=0.009, tilt_rad=0.003)
    assert refine(vehicle, drone, np.radians([0.0, 70.0]), 0.0, tolerances) is None


def test_the_rotation_is_that_at_the_time_of_the_drone_s_image():
    """The vehicle turns at 20 deg/s; its image is 80 ms older."""
    stage, R_drone = JointAlign(), turned(0, 0, 40)
    output = []
    for ms in range(0, 401, 20):
        R = turned(0, 0, 0.02 * ms)
        stage.on_motion(VehicleMotion(stamp_ns=ms * MS, xyz_map_m=np.zeros(3), R_map_vehicle=R, covariance=None))
        if ms == 200:
            output += stage.on_vehicle(seen(CameraMount.VEHICLE, R, stamp_ns=ms * MS))
        if ms == 280:
            output += stage.on_drone(seen(CameraMount.DRONE, R_drone, stamp_ns=ms * MS))
    output += stage.finish()
    assert off_deg(turned(0, 0, 0.02 * 280).T @ R_drone, only(output).R_vehicle_drone) < 0.5
    still = JointAlign()
    late = [
        *still.on_vehicle(seen(CameraMount.VEHICLE, turned(0, 0, 4), stamp_ns=200 * MS)),
        *still.on_drone(seen(CameraMount.DRONE, R_drone, stamp_ns=280 * MS)),
        *still.finish(),
    ]
    sigma_deg = np.degrees(np.sqrt(np.diag(only(late).covariance_rad2)))
    assert sigma_deg[2] > 1.5  # its turn is not known


def test_images_with_a_larger_time_difference_are_no_pair():
    late = seen(CameraMount.DRONE, np.eye(3), stamp_ns=300 * MS)
    stage = JointAlign()
    output = [*stage.on_vehicle(seen(CameraMount.VEHICLE, np.eye(3))), *stage.on_drone(late), *stage.finish()]
    assert only(output).reason == "no image of the vehicle camera within 0.1 s"


def test_the_wrong_camera_on_a_port_is_an_error():
    with pytest.raises(ValueError, match="wire the other camera"):
        list(JointAlign().on_vehicle(nothing(CameraMount.DRONE)))


@pytest.mark.parametrize("wrong", [{"straight_deg": 0}, {"resolve": 0.9}])
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValueError):
        JointAlign(**wrong)
