"""Candidates with reasons, detections with probabilities, several drones with states: entities computed by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import rerun as rr
import synthetic
from drawing import document, drawn, numbers, scene, values_of

from links.viewer import colours
from links.viewer.message_queue import Slicer
from stages.messages import (
    AutopilotMotion,
    Candidates,
    DroneMotion,
    GyroBias,
    ServoGoal,
    SweptPulses,
    TrackingState,
    TrackState,
    VehicleMotion,
)


def candidates(stamp_ns: int, **found: tuple[float, str]) -> Candidates:
    """`c7=(0.2, "why")`: candidate 7, 7 m above the vehicle, last return 0.5 s ago."""
    numbers_ = [int(name[1:]) for name in found]
    n = len(found)
    return Candidates(
        stamp_ns=stamp_ns,
        candidate_id=np.array(numbers_, dtype=np.int64),
        xyz_vehicle_m=np.array([[1.0, 2.0, number] for number in numbers_], dtype=np.float64).reshape(-1, 3),
        velocity_vehicle_mps=np.zeros((n, 3)),
        probability=np.array([p for p, _ in found.values()]),
        seen_ns=np.full(n, stamp_ns - 500_000_000),
        scan_passes=np.full(n, 3),
        reasons=tuple(why for _, why in found.values()),
        accept_probability=0.95,
    )


def state(which: TrackingState, number: int = 1, stamp_ns: int = 0, sigma_m: float = 0.1, **changes) -> TrackState:
    content = TrackState(
        stamp_ns=stamp_ns,
        state=which,
        reason="why",
        hits=4,
        frame_s=0.1,
        track_id=number,
        xyz_vehicle_m=np.array([3.0, 4.0, 10.0 + number]),
        velocity_vehicle_mps=np.array([1.0, -2.0, 0.5]),
        covariance_m2=np.eye(3) * sigma_m**2,
    )
    return dataclasses.replace(content, **changes)


def lost(number: int = 1, stamp_ns: int = 0) -> TrackState:
    nowhere = {"xyz_vehicle_m": None, "velocity_vehicle_mps": None, "covariance_m2": None}
    return state(TrackingState.LOST, number, stamp_ns, **nowhere)


def fix(number: int = 1, stamp_ns: int = 0, x_m: float = 3.0):
    content = next(content for output, content in synthetic.run_by_evidence(1.0) if output == "track.drone_fix")
    return dataclasses.replace(
        content, track_id=number, stamp_ns=stamp_ns, xyz_vehicle_m=np.array([x_m, 4.0, 10.0 + number])
    )


def test_a_candidate_is_a_coloured_point_with_number_and_reason():
    found = candidates(0, c7=(0.2, "it may be static"), c3=(0.999, "9 scan passes"))
    entities = drawn(found, "detect/candidates")
    dots = entities["vehicle/detect/candidates"]
    assert dots.frame == "vehicle"
    np.testing.assert_allclose(numbers(dots.archetypes[0].positions), [[1, 2, 7], [1, 2, 3]])
    assert values_of(dots.archetypes[0].labels) == [
        "candidate 7: 20.0 %, it may be static",
        "candidate 3: 99.9 %, 9 scan passes",
    ]
    assert values_of(entities["labels/detect/candidates"].archetypes[0].labels) == ["7: 20.0 %", "3: 99.9 %"]
    packed = numbers(dots.archetypes[0].colors).astype(int).ravel().tolist()
    assert packed == [int(colours.by_probability(found.probability)[0]), colours.ACCEPTED]
    percent = entities["plots/probability/detect/candidates"].values
    np.testing.assert_allclose(percent, [99.9, 20.0, 95.0])  # the last is where a candidate is accepted
    text = document(entities["candidates"])
    assert "- 7: 20.0 %, last return 0.5 s ago at 1.0 / 2.0 / 7.0 m: it may be static" in text


def test_of_many_candidates_the_followed_one_and_the_most_probable_ones_are_named():
    where = scene()
    position_m = np.array([1.0, 2.0, 5.0])  # that of candidate 5
    drawn(state(TrackingState.CANDIDATE, 0, xyz_vehicle_m=position_m), "track/track_state", where)
    many = {f"c{n}": (0.05 * n if n != 5 else 0.01, "x") for n in range(1, 11)}
    entities = drawn(candidates(1, **many), "detect/candidates", where)
    labels = values_of(entities["labels/detect/candidates"].archetypes[0].labels)
    assert labels == ["5: 1.0 %, followed", "8: 40.0 %", "9: 45.0 %", "10: 50.0 %"]
    dots = entities["vehicle/detect/candidates"].archetypes[0]
    packed, radii = numbers(dots.colors).astype(int).ravel(), numbers(dots.radii).ravel()
    assert np.flatnonzero(packed == colours.DRONE).tolist() == [4]
    assert np.argmax(np.abs(radii)) == 4


def test_colours_go_from_red_over_violet_to_green_linearly_in_the_log_odds():
    red, low, even, high, green = colours.by_probability(np.array([0.0, 0.1, 0.5, 0.9, 1.0])).tolist()
    assert (red, green) == (0xE07070FF, colours.ACCEPTED)
    assert [(even >> shift & 255) - (colours.CANDIDATE >> shift & 255) for shift in (24, 16, 8, 0)] == pytest.approx(
        [0] * 4, abs=2
    )
    assert len({red, low, even, high, green}) == 5


def test_an_empty_list_of_candidates_removes_the_points():
    where = scene()
    drawn(candidates(0, c1=(0.1, "x")), "detect/candidates", where)
    entities = drawn(candidates(1), "detect/candidates", where)
    assert len(numbers(entities["vehicle/detect/candidates"].archetypes[0].positions)) == 0
    assert len(numbers(entities["labels/detect/candidates"].archetypes[0].positions)) == 0
    np.testing.assert_allclose(entities["plots/probability/detect/candidates"].values, [0.0, 0.0, 95.0])
    assert "no candidate" in document(entities["candidates"])


def test_a_removed_candidate_is_logged():
    where = scene()
    first = drawn(candidates(0, c4=(0.001, "if not a drone, a bird"), c5=(0.7, "x")), "detect/candidates", where)
    assert "log/detect/candidates" not in first
    entities = drawn(candidates(10**9, c5=(0.7, "x")), "detect/candidates", where)
    entry = entities["log/detect/candidates"].archetypes[0]
    assert values_of(entry.text) == ["candidate 4 removed at 0.1 %, no return for 1.5 s: if not a drone, a bird"]
    assert values_of(entry.level) == ["INFO"]
    assert "log/detect/candidates" not in drawn(candidates(10**9, c5=(0.7, "x")), "detect/candidates", where)
    gone = drawn(candidates(2 * 10**9), "detect/candidates", where)
    assert values_of(gone["log/detect/candidates"].archetypes[0].level) == ["WARN"]  # its probability was above 0.5


def test_a_candidate_that_is_tracked_has_the_drones_label_only():
    where = scene()
    drawn(fix(), "track/drone_fix", where)
    found = candidates(0, c11=(0.99, "x"), c7=(0.1, "y"))
    found = dataclasses.replace(found, xyz_vehicle_m=np.array([[3.0, 4.5, 11.0], [1.0, 2.0, 7.0]]))
    entities = drawn(found, "detect/candidates", where)
    assert values_of(entities["labels/detect/candidates"].archetypes[0].labels) == ["7: 10.0 %"]
    assert len(numbers(entities["vehicle/detect/candidates"].archetypes[0].positions)) == 2


def test_detections_list_the_reason_for_each_rejected_candidate():
    answer = next(c for output, c in synthetic.run_by_evidence(2.0) if output == "detect.detections")
    entities = drawn(answer, "detect/detections")
    assert values_of(entities["vehicle/detect/detections/accepted"].archetypes[0].labels) == [
        "candidate 3, 99.2 %: 9 scan passes"
    ]
    assert values_of(entities["vehicle/detect/detections/rejected"].archetypes[0].labels) == [
        "candidate 5, 1.0 %: next to a large object; if not a drone, a lamp, wire or edge"
    ]
    np.testing.assert_allclose(entities["plots/probability/detect/detections"].values, [99.2, 1.0], atol=1e-9)
    assert (
        "labels/detect/detections" not in entities
    )  # a detection has the position of the search; Candidates has the current one
    text = document(entities["candidates"])
    assert "- 5: 1.0 %, rejected at -16.0 / -23.0 / 8.0 m: next to a large object" in text
    assert "- 3: 99.2 %, accepted" in text


def test_the_document_keeps_the_last_search_after_the_current_candidates():
    where = scene()
    answer = next(c for output, c in synthetic.run_by_evidence(2.0) if output == "detect.detections")
    drawn(answer, "detect/detections", where)
    text = document(drawn(candidates(0, c7=(0.2, "alone")), "detect/candidates", where)["candidates"])
    assert (
        text.index("detect, now") < text.index("7: 20.0 %") < text.index("detect, last search") < text.index("5: 1.0 %")
    )


def test_each_drone_has_its_own_position_and_trail():
    where = scene()
    for k in range(3):
        one = drawn(fix(1, k * 10**8, x_m=float(k)), "track/drone_fix", where)
        two = drawn(fix(2, k * 10**8, x_m=-float(k)), "track/drone_fix", where)
    for number, entities, x_m in ((1, one, [0.0, 1.0, 2.0]), (2, two, [0.0, -1.0, -2.0])):
        (strip,) = numbers(entities[f"vehicle/track/drone_fix/drone_{number}/trail"].archetypes[0].strips)
        assert [point[0] for point in strip] == x_m
        np.testing.assert_allclose(
            entities[f"plots/position/track/drone_fix/drone_{number}"].values, [x_m[-1], 4, 10 + number]
        )
        (text,) = values_of(entities[f"labels/track/drone_fix/drone_{number}"].archetypes[0].labels)
        assert text.startswith(f"drone {number}: ")
    assert "frames/drone_position" in one
    assert "frames/drone_position" not in two  # the close-up stays with the first


def test_the_close_up_follows_the_next_drone_when_the_first_is_lost():
    where = scene()
    drawn(fix(1), "track/drone_fix", where)
    drawn(fix(2), "track/drone_fix", where)
    drawn(lost(1), "track/track_state", where)
    assert "frames/drone_position" in drawn(fix(2), "track/drone_fix", where)


def test_a_coasting_drone_is_at_its_prediction_and_its_ellipsoid_grows():
    where, sizes = scene(), []
    for k, sigma_m in enumerate((0.1, 0.4, 1.6)):
        entities = drawn(state(TrackingState.COASTING, sigma_m=sigma_m, stamp_ns=k), "track/track_state", where)
        shape = entities["vehicle/track/track_state/drone_1/predicted"]
        assert shape.frame == "vehicle"
        np.testing.assert_allclose(numbers(shape.archetypes[0].centers), [[3.0, 4.0, 11.0]])
        sizes.append(float(numbers(shape.archetypes[0].half_sizes)[0, 0]))
        np.testing.assert_allclose(entities["plots/sigma/track/track_state/drone_1"].values, [sigma_m])
    np.testing.assert_allclose(sizes, 2.7955 * np.array([0.1, 0.4, 1.6]), atol=1e-3)
    arrow = entities["vehicle/track/track_state/drone_1/velocity"].archetypes[0]
    np.testing.assert_allclose(numbers(arrow.origins), [[3.0, 4.0, 11.0]])
    np.testing.assert_allclose(numbers(arrow.vectors), [[1.0, -2.0, 0.5]])
    assert int(numbers(arrow.colors).ravel()[0]) == colours.COASTING


def test_a_lost_drone_keeps_its_trail_and_nothing_else():
    where = scene()
    drawn(fix(2), "track/drone_fix", where)
    drawn(state(TrackingState.TRACKING, 2), "track/track_state", where)
    entities = drawn(lost(2), "track/track_state", where)
    cleared = {
        path for path, entity in entities.items() if entity.archetypes and isinstance(entity.archetypes[0], rr.Clear)
    }
    assert cleared == {
        "vehicle/track/track_state/drone_2",
        "vehicle/track/drone_fix/drone_2/ellipsoid_95",
        "vehicle/track/drone_fix/drone_2/height",
        "labels/track/drone_fix/drone_2",
    }
    assert values_of(entities["states/track/drone_2"].archetypes[0].state) == ["LOST"]
    assert document(entities["status"]) == "**track:** drone 2: LOST: why"
    assert not where.near_a_drone(np.array([[3.0, 4.0, 12.0]])).any()


def test_the_state_of_a_tracker_is_that_of_its_best_drone_and_each_drone_has_its_own():
    where, states, second = scene(), [], []
    steps = (
        state(TrackingState.SEARCHING, 0, 0),
        state(TrackingState.CANDIDATE, 0, 1),
        state(TrackingState.TRACKING, 1, 2),
        state(TrackingState.CANDIDATE, 0, 3),  # a hypothesis next to the tracked drone changes nothing
        state(TrackingState.TRACKING, 2, 4),
        state(TrackingState.COASTING, 1, 5),  # the second is still tracked
        state(TrackingState.TRACKING, 1, 6),
        state(TrackingState.COASTING, 1, 7),
        state(TrackingState.COASTING, 2, 8),
        lost(1, 9),
        lost(2, 2_000_000_000),
    )
    for step in steps:
        entities = drawn(step, "track/track_state", where)
        states += values_of(entities["states/track"].archetypes[0].state) if "states/track" in entities else []
        second += (
            values_of(entities["states/track/drone_2"].archetypes[0].state)
            if "states/track/drone_2" in entities
            else []
        )
    assert states == ["SEARCHING", "CANDIDATE", "TRACKING", "COASTING", "LOST"]
    assert second == ["TRACKING", "COASTING", "LOST"]


def test_each_change_of_a_drones_state_is_logged_once_with_its_reason():
    where, logged = scene(), []
    for step in (TrackingState.TRACKING, TrackingState.TRACKING, TrackingState.COASTING, TrackingState.TRACKING):
        entities = drawn(state(step, 2), "track/track_state", where)
        if "log/track/track_state" in entities:
            entry = entities["log/track/track_state"].archetypes[0]
            logged += [(values_of(entry.text)[0], values_of(entry.level)[0])]
    assert logged == [
        ("drone 2: TRACKING: why", "INFO"),
        ("drone 2: COASTING: why", "WARN"),
        ("drone 2: TRACKING: why", "INFO"),
    ]


def test_unnumbered_hypotheses_are_drawn_together_and_cleared():
    where, path = scene(), "vehicle/track/track_state/candidates"
    for k in range(3):
        entities = drawn(
            state(TrackingState.CANDIDATE, 0, k * 10_000_000, xyz_vehicle_m=np.array([float(k), 0.0, 9.0])),
            "track/track_state",
            where,
        )
    np.testing.assert_allclose(numbers(entities[f"{path}/predicted"].archetypes[0].centers)[:, 0], [0.0, 1.0, 2.0])
    assert len(numbers(entities[f"{path}/velocity"].archetypes[0].vectors)) == 3
    assert "plots/hits/track/track_state/drone_0" not in entities
    entities = drawn(state(TrackingState.CANDIDATE, 0, 165_000_000), "track/track_state", where)
    assert len(numbers(entities[f"{path}/predicted"].archetypes[0].centers)) == 2  # one of the three is recent enough
    assert path not in drawn(state(TrackingState.TRACKING, 1, 200_000_000), "track/track_state", where)
    entities = drawn(state(TrackingState.TRACKING, 1, 600_000_000), "track/track_state", where)
    assert isinstance(entities[path].archetypes[0], rr.Clear)
    assert document(entities["status"]) == "**track, drone 1:** TRACKING: why"
    assert path not in drawn(state(TrackingState.TRACKING, 1, 700_000_000), "track/track_state", where)


def test_a_tracker_without_prediction_has_no_ellipsoid_and_one_state():
    entities = drawn(
        dataclasses.replace(lost(), state=TrackingState.TRACKING), "track/track_state"
    )  # as the paper's tracker: state, reason and returns only
    assert {path for path in entities if path.startswith(("vehicle", "states"))} == {"states/track"}


def pulses(stamp_ns: int, range_m: list[float]) -> SweptPulses:
    n = len(range_m)
    return SweptPulses(
        stamp_ns=stamp_ns,
        point_stamp_ns=np.full(n, stamp_ns),
        direction_vehicle=np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (n, 1)),
        range_m=np.array(range_m, np.float32),
        laser=np.zeros(n, np.uint8),
        reflectivity=np.zeros(n, np.uint8),
        turntable_rad=0.1,
        origin_vehicle_m=(0.0, 0.0, 0.3),
    )


def test_pulses_are_counted_per_slice_and_not_drawn():
    slicer = Slicer(0.1)
    ready = [
        item for k in range(77) for item in slicer.add("sweep.swept_pulses", pulses(k * 1_327_104, [5.0, 0, 0, 7]))
    ]
    ((_, stamp_ns, joined),) = ready
    assert stamp_ns == 75 * 1_327_104  # 0.1 s; the packet after it is in the next slice
    entities = drawn(joined, "sweep/swept_pulses")
    assert set(entities) == {"plots/count/sweep/swept_pulses/pulses", "plots/other/sweep/swept_pulses/empty"}
    np.testing.assert_allclose(entities["plots/count/sweep/swept_pulses/pulses"].values, [76 * 4])
    np.testing.assert_allclose(entities["plots/other/sweep/swept_pulses/empty"].values, [50.0])


def test_a_slice_without_pulses_has_no_share():
    entities = drawn(pulses(0, []), "sweep/swept_pulses")
    assert set(entities) == {"plots/count/sweep/swept_pulses/pulses"}


def test_the_servo_goal_is_a_stepped_curve_next_to_the_servo_angle():
    entities = drawn(ServoGoal(stamp_ns=0, position_rad=np.pi / 6, speed_radps=1.0), "aim/servo_goal")
    np.testing.assert_allclose(entities["plots/servo/aim/servo_goal"].values, [30.0])
    held = [
        batch
        for batch in entities["plots/servo/aim/servo_goal"].style()
        if "interpolation" in str(batch.component_descriptor())
    ]
    assert len(held) == 1  # as steps: a goal holds until the next


def test_the_vehicles_position_is_three_curves_and_its_yaw_one():
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    motion = VehicleMotion(stamp_ns=0, xyz_map_m=np.array([1.0, 2.0, 0.5]), R_map_vehicle=R, covariance=None)
    entities = drawn(motion, "odometry/vehicle_motion")
    values = {path: entity.values.tolist() for path, entity in entities.items()}
    assert values == {
        "plots/other/odometry/vehicle_motion/position": [1.0, 2.0, 0.5],
        "plots/other/odometry/vehicle_motion/yaw": [pytest.approx(90.0)],
    }


def test_the_drones_motion_is_curves_of_force_rate_noise_and_segments():
    estimate = AutopilotMotion(
        xyz_odom_m=np.zeros(3), R_odom_drone=np.eye(3), velocity_odom_mps=np.zeros(3), odom_segment=4
    )
    motion = DroneMotion(
        stamp_ns=20,
        start_ns=0,
        segment=2,
        specific_force_drone_mps2=np.array([1.0, 2.0, 9.8]),
        angular_velocity_drone_radps=np.radians([10.0, 20.0, 30.0]),
        specific_force_noise=np.full(3, 0.07),
        angular_velocity_noise=np.full(3, np.radians(0.1)),
        up_drone=None,
        autopilot=estimate,
        gyro_bias=GyroBias(up_drone=np.array([0.0, 0.0, 1.0]), bias_radps=math.radians(0.2), sigma_radps=0.001),
    )
    values = {path: entity.values.tolist() for path, entity in drawn(motion, "drone_motion/drone_motion").items()}
    path = "plots/other/drone_motion/drone_motion"
    assert values == {
        f"{path}/force": [1.0, 2.0, 9.8],
        f"{path}/rate": pytest.approx([10.0, 20.0, 30.0]),
        f"{path}/force_noise": [0.07] * 3,
        f"{path}/rate_noise": pytest.approx([0.1] * 3),
        f"{path}/gyro_bias": [pytest.approx(0.2)],
        f"{path}/segments": [2, 4],
    }
