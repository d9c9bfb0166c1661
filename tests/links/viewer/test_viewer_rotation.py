"""The rotation between vehicle and drone and the drone's motion: probabilities, state, switches, unknown values."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import rerun as rr
from drawing import document, drawn, numbers, scene, values_of
from synthetic_vision import motion, rotation

from links.viewer.draw import draw
from links.viewer.draw_pose import rpy_deg
from links.viewer.layout import Vision, layout
from stages.geometry.frames import rotation_from_rpy_deg
from stages.messages import BranchState, DroneFix, RelativeRotation

NAME = "align/relative_rotation"


def scalars(entity) -> list[float]:
    return entity.values.tolist()


def at_a_fix():
    where = scene()
    at = DroneFix(stamp_ns=0, xyz_vehicle_m=np.ones(3), covariance_m2=np.eye(3), hits=3)
    drawn(at, "track/drone_fix", where)
    return where


def test_the_four_branches_and_none_of_them_are_curves_that_sum_to_all():
    values = scalars(drawn(rotation(), NAME)[f"plots/branch/{NAME}"])
    np.testing.assert_allclose(values, [60.0, 20.0, 10.0, 5.0, 5.0])
    certain = rotation(branch_probability=np.array([1.0, 1e-17, 0.0, 0.0]))
    assert scalars(drawn(certain, NAME)[f"plots/branch/{NAME}"])[4] == 0.0


def test_while_the_branch_is_open_the_curves_are_the_matches():
    two = rotation(
        state=BranchState.OPEN,
        rotations=np.tile(np.eye(3), (2, 1, 1)),
        covariances_rad2=np.tile(1e-4 * np.eye(3), (2, 1, 1)),
        probabilities=np.array([0.6, 0.3]),
    )
    np.testing.assert_allclose(scalars(drawn(two, NAME)[f"plots/branch/{NAME}"]), [60.0, 30.0, 0.0, 0.0, 10.0])
    assert "OPEN, 60.0 %" in document(drawn(two, NAME)["status"])


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (10.0, -20.0, 170.0), (-179.0, 80.0, -90.0)])
def test_angles_round_trip_through_a_rotation(rpy):
    np.testing.assert_allclose(rpy_deg(rotation_from_rpy_deg(rpy)), rpy, atol=1e-9)


def test_a_rotation_has_angles_sigmas_and_a_rotated_sphere():
    entities = drawn(rotation(), NAME)
    np.testing.assert_allclose(scalars(entities[f"plots/rotation/{NAME}"]), [0.0, 0.0, 30.0], atol=1e-9)
    np.testing.assert_allclose(scalars(entities[f"plots/rotation_sigma/{NAME}"]), [0.1, 0.2, 0.4])
    turn = entities["frames/sphere_drone"].archetypes[0]
    np.testing.assert_allclose(numbers(turn.mat3x3).reshape(3, 3).T, rotation_from_rpy_deg((0.0, 0.0, 30.0)), atol=1e-6)
    assert values_of(entities["sphere/drone/name"].archetypes[0].labels) == [
        "drone, rotated by the estimate: AMBIGUOUS"
    ]
    text = document(entities["status"])
    assert text == (
        "**align:** AMBIGUOUS, 60.0 %: roll / pitch / yaw 0.0 / 0.0 / 30.0 deg, sigma 0.10 / 0.20 / 0.40 deg; "
        "waits for motion"
    )
    assert f"vehicle/{NAME}/axes" not in entities  # the position of the drone is unknown


def test_the_drones_axes_are_at_its_fix_and_dim_while_the_branch_is_ambiguous():
    where = at_a_fix()
    R = rotation_from_rpy_deg((0.0, 0.0, 30.0))
    dim = drawn(rotation(), NAME, where)[f"vehicle/{NAME}/axes"]
    clear = drawn(rotation(state=BranchState.RESOLVED), NAME, where)[f"vehicle/{NAME}/axes"]
    assert dim.frame == "drone_position"
    np.testing.assert_allclose(numbers(dim.archetypes[0].vectors), 0.6 * R.T, atol=1e-6)
    for entity, alpha in ((dim, 0x60), (clear, 0xFF)):
        assert {int(c) & 0xFF for c in numbers(entity.archetypes[0].colors)} == {alpha}


def test_without_rotation_old_entities_are_cleared_and_the_reason_is_shown():
    where = at_a_fix()
    drawn(rotation(), NAME, where)
    entities = drawn(RelativeRotation.none(0, "no structure here"), NAME, where)
    assert isinstance(entities[f"vehicle/{NAME}"].archetypes[0], rr.Clear)
    assert f"plots/rotation/{NAME}" not in entities
    np.testing.assert_allclose(numbers(entities["frames/sphere_drone"].archetypes[0].mat3x3).reshape(3, 3), np.eye(3))
    assert values_of(entities["sphere/drone/name"].archetypes[0].labels) == ["drone, own axes"]
    assert values_of(entities["states/align"].archetypes[0].state) == ["NONE"]
    assert "**align:** NONE: no structure here" in document(entities["status"])


def test_a_branch_switch_is_logged_once_as_a_warning():
    where, logged = scene(), []
    steps = [
        (BranchState.AMBIGUOUS, 0),
        (BranchState.RESOLVED, 0),
        (BranchState.RESOLVED, 1),
        (BranchState.RESOLVED, 1),
    ]
    for state, switches in steps:
        entities = list(draw(rotation(state=state, switches=switches), NAME, where))
        logged += [
            (values_of(m.archetypes[0].text)[0], values_of(m.archetypes[0].level)[0])
            for m in entities
            if m.path == f"log/{NAME}"
        ]
    assert logged == [
        ("AMBIGUOUS: waits for motion", "WARN"),
        ("RESOLVED: waits for motion", "INFO"),
        ("the published branch changed, switch 1: waits for motion", "WARN"),
    ]
    assert scalars(next(m for m in entities if m.path == f"plots/other/{NAME}/switches")) == [1.0]


def test_a_motion_shows_matches_sigmas_and_the_direction_of_travel_in_drone_axes():
    entities = drawn(motion(), "drone_odometry/visual_motion")
    assert scalars(entities["plots/matches/drone_odometry/visual_motion"]) == [120.0]
    sigma = "plots/motion_sigma/drone_odometry/visual_motion"
    np.testing.assert_allclose(scalars(entities[f"{sigma}/rotation"]), [0.3])
    np.testing.assert_allclose(scalars(entities[f"{sigma}/direction"]), [2.0])
    travel = entities["sphere/drone_odometry/visual_motion/travel"]
    assert travel.frame == "sphere_drone"
    # the drone yawed left by 90 deg: the former forward direction is now to its right
    np.testing.assert_allclose(numbers(travel.archetypes[0].vectors), [[0.0, -1.4, 0.0]], atol=1e-6)
    assert (
        document(entities["status"])
        == "**drone_odometry:** 120 inlier features over 0.10 s, direction of travel +-2.0 deg"
    )


def test_a_drone_that_only_rotates_has_no_direction_and_no_old_arrow():
    still = dataclasses.replace(motion(), direction_from=None, direction_sigma_rad=None, reason="no motion seen")
    entities = drawn(still, "drone_odometry/visual_motion")
    assert len(entities["sphere/drone_odometry/visual_motion/travel"].archetypes[0].vectors.as_arrow_array()) == 0
    assert "plots/motion_sigma/drone_odometry/visual_motion/direction" not in entities
    assert values_of(entities["states/drone_odometry"].archetypes[0].state) == ["no motion"]
    assert document(entities["status"]).endswith("no motion seen")


def names(vision: Vision) -> set[str]:
    def below(part) -> set[str]:
        inner = getattr(part, "contents", None)
        parts = inner if isinstance(inner, list | tuple) and not isinstance(inner, str) else []
        own = {part.name} if getattr(part, "name", None) else set()
        return own.union(*(below(each) for each in parts if not isinstance(each, str)))

    return below(layout(depth_images=False, candidates=True, vision=vision).root_container)


def test_camera_views_exist_only_when_the_graph_has_their_outputs():
    without = names(Vision())
    everything = Vision(["camera_drone"], directions=True, rotation=True, odometry=True)
    added = names(everything) - without
    assert "camera drone" in added
    assert len(added) == 8, "seven views, and the tab"
    assert names(Vision(rotation=True)) - without == {
        "Rotation",
        "Yaw [%]: matches or branches green, orange, violet, blue, none red; within 20 deg of the best grey",
        "Rotation in the vehicle frame [deg]: roll red, pitch green, yaw blue",
        "Sigma of the rotation [deg], about x red, y green, z blue",
    }
