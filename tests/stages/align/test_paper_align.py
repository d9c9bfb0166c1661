"""PaperAlign: pairs in time, the initial branch, its correction by motion, the branch probabilities."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays, hash_into
from flow.stage import input_ports, output_ports
from stages.align import PaperAlign
from stages.align.paper_match import angle_between_rad
from stages.geometry.frames import rotation_z
from stages.messages import BranchState, CameraMount
from tests.stages.align.paper_flight import START_NS, Flight, image_ns, vanishing

VEHICLE, DRONE = CameraMount.VEHICLE, CameraMount.DRONE


def run(stage, flight, images, motions=True, seen=lambda flight, camera_mount, k: flight.seen(camera_mount, k)):
    out = []
    for k in range(images):
        if motions:
            stage.on_motion(flight.vehicle(k))
            stage.on_fix(flight.fix(k))
            if k >= 14:
                stage.on_visual_motion(flight.motion(k - 14, k))
        out += list(stage.on_vehicle(seen(flight, VEHICLE, k)))
        out += list(stage.on_drone(seen(flight, DRONE, k)))
    out += list(stage.finish())
    for message in out:
        check_arrays(message)
    return out


def errors_deg(out, flight):
    return [
        math.degrees(angle_between_rad(m.R_vehicle_drone, flight.R_vehicle_drone((m.stamp_ns - START_NS) // 10**8)))
        for m in out
        if m.R_vehicle_drone is not None
    ]


def test_ports_are_what_the_graph_wires():
    assert set(input_ports(PaperAlign)) == {"vehicle", "drone", "fix", "visual_motion", "motion"}
    assert set(output_ports(PaperAlign)) == {"relative_rotation"}
    assert PaperAlign.optional_inputs == {"fix", "visual_motion", "motion"}


def test_each_drone_image_gives_one_output_at_its_time():
    out = run(PaperAlign(), Flight(drone_yaw_deg=10), 20, motions=False)
    assert [m.stamp_ns for m in out] == [image_ns(k) for k in range(20)]
    assert all(m.state is BranchState.AMBIGUOUS for m in out)
    assert max(errors_deg(out, Flight(drone_yaw_deg=10))[3:]) < 0.5


def test_without_motion_the_branch_is_ambiguous():
    out = run(PaperAlign(), Flight(drone_yaw_deg=10), 30, motions=False)
    np.testing.assert_array_equal(out[-1].branch_probability, [0.25] * 4)
    assert out[-1].switches == 0


@pytest.mark.parametrize(("yaw_deg", "off_deg"), [(95, 90), (-80, 90), (185, 180)])
def test_a_wrong_initial_yaw_is_a_wrong_branch_until_the_drone_has_moved(yaw_deg, off_deg):
    flight = Flight(drone_yaw_deg=yaw_deg, vehicle_dps=0.0)
    out = run(PaperAlign(), flight, 40)
    errors = errors_deg(out, flight)
    assert errors[15] == pytest.approx(off_deg, abs=1.0)
    assert out[15].state is BranchState.AMBIGUOUS
    first = next(k for k, m in enumerate(out) if m.switches == 1)
    assert 14 + 6 <= first <= 14 + 8
    assert out[first].reason.startswith("branch corrected by motion:")
    assert max(errors[first:]) < 1.0
    assert all(m.state is BranchState.RESOLVED and m.switches == 1 for m in out[first:])


def test_the_correction_is_about_the_vertical_and_in_vehicle_axes():
    """The vehicle turns at 30 deg/s: by the time of the correction its heading has changed."""
    flight = Flight(drone_yaw_deg=95, vehicle_dps=30.0, drone_dps=30.0)
    out = run(PaperAlign(), flight, 40)
    assert out[-1].switches == 1
    assert errors_deg(out, flight)[-1] < 1.0


def test_a_correct_initial_yaw_is_confirmed_without_a_jump():
    flight = Flight(drone_yaw_deg=20, drone_dps=10.0)
    out = run(PaperAlign(), flight, 40)
    assert out[-1].state is BranchState.RESOLVED
    assert out[-1].switches == 0
    assert out[-1].reason.endswith("confirmed by motion")
    assert max(errors_deg(out, flight)[10:]) < 1.5


def test_a_correction_has_the_probability_of_its_error_rate():
    out = run(PaperAlign(wrong_share=0.06), Flight(drone_yaw_deg=95, vehicle_dps=0.0), 40)
    np.testing.assert_allclose(out[-1].branch_probability, [0.94, 0.02, 0.02, 0.02])


def test_the_error_of_the_direction_of_motion_does_not_reach_the_rotation():
    """R_f is 12 deg off; the streets decide within the branch."""
    flight = Flight(drone_yaw_deg=95, vehicle_dps=0.0)
    stage, skewed = PaperAlign(), Flight(drone_yaw_deg=95 + 12, vehicle_dps=0.0)
    for k in range(40):
        stage.on_fix(flight.fix(k))
        stage.on_motion(flight.vehicle(k))
        if k >= 14:
            stage.on_visual_motion(skewed.motion(k - 14, k))
        out = [*stage.on_vehicle(flight.seen(VEHICLE, k)), *stage.on_drone(flight.seen(DRONE, k))]
    assert out[-1].switches == 1
    assert errors_deg(out[-1:], flight)[0] < 0.5


def test_matching_starts_at_the_initial_yaw():
    flight = Flight(drone_yaw_deg=95, vehicle_dps=0.0)
    assert max(errors_deg(run(PaperAlign(initial_yaw_deg=80), flight, 10, motions=False), flight)) < 1.0


def test_the_nearest_vehicle_image_is_used():
    """The vehicle has turned by 0, 10 and 40 deg at its images; the drone's lies nearest to the second."""
    stage = PaperAlign(initial_sigma_deg=90)
    out = []
    for after_ms, turned in ((0, 0.0), (60, 10.0), (130, 40.0)):
        directions = np.eye(3) @ rotation_z(math.radians(turned))
        out += list(stage.on_vehicle(vanishing(VEHICLE, START_NS + after_ms * 10**6, directions)))
        if after_ms == 60:
            out += list(stage.on_drone(vanishing(DRONE, START_NS + 80 * 10**6, np.eye(3))))
    (answer,) = out
    assert angle_between_rad(answer.R_vehicle_drone, rotation_z(math.radians(-10))) < math.radians(0.1)


def test_images_with_a_large_time_difference_are_no_pair():
    stage = PaperAlign(max_apart_s=0.05)
    list(stage.on_drone(vanishing(DRONE, START_NS, np.eye(3))))
    (answer,) = stage.on_vehicle(vanishing(VEHICLE, START_NS + 60 * 10**6, np.eye(3)))
    assert answer.R_vehicle_drone is None
    assert answer.covariance_rad2 is None
    assert answer.state is BranchState.NONE
    assert answer.reason == "no image of the vehicle camera within 0.05 s of the drone image"


def test_drone_images_without_a_vehicle_camera_give_outputs_without_rotation():
    stage = PaperAlign()
    out = [m for k in range(10) for m in stage.on_drone(Flight().seen(DRONE, k))] + list(stage.finish())
    assert len(out) == 10
    assert all(m.R_vehicle_drone is None for m in out)


def test_images_without_directions_give_a_reason_and_later_ones_work():
    flight = Flight(drone_yaw_deg=10)

    def gap(flight, camera_mount, k):
        if camera_mount is DRONE and 10 <= k < 15:
            return vanishing(DRONE, image_ns(k), np.empty((0, 3)), "1 of 3 views have a vanishing point")
        return flight.seen(camera_mount, k)

    out = run(PaperAlign(), flight, 30, seen=gap)
    assert [m.R_vehicle_drone is None for m in out] == [10 <= k < 15 for k in range(30)]
    assert out[12].reason == "drone: 1 of 3 views have a vanishing point"
    assert max(errors_deg(out, flight)[5:]) < 1.0


def test_the_covariance_is_the_filters_and_grows_in_a_gap():
    flight = Flight(drone_yaw_deg=10)
    out = run(PaperAlign(), flight, 30, motions=False)
    sigma = [math.degrees(math.sqrt(m.covariance_rad2[2, 2])) for m in out]
    assert sigma[0] == pytest.approx(1.0, abs=0.01), "the first observation is all there is"
    assert sigma[-1] < sigma[0]
    for message in out:
        np.testing.assert_allclose(message.covariance_rad2, message.covariance_rad2.T, atol=1e-15)


def test_directions_of_the_other_camera_are_rejected():
    with pytest.raises(ValueError, match="input 'drone' got the directions of the vehicle: wire the other camera"):
        list(PaperAlign().on_drone(vanishing(VEHICLE, START_NS, np.eye(3))))


def test_the_same_inputs_give_the_same_bits():
    digests = []
    for _ in range(2):
        digest = hashlib.sha256()
        for message in run(PaperAlign(), Flight(drone_yaw_deg=95), 40):
            hash_into(digest, digest, message)
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    "settings",
    [
        {"images_apart": 0},
        {"shortest_m": 0},
        {"cone_deg": 90},
        {"wrong_share": 0.75},
        {"last": 0},
        {"yaw": 3},
        {"max_apart_s": 0},
    ],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises(ValidationError):
        PaperAlign(**settings)
