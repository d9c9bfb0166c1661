"""KernelDetect: the argmin of Equation 1, acceptance with reasons, and scenes without a drone."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.detect.paper.kernel_candidates import Gates
from stages.detect.paper.kernel_detect import KernelDetect
from stages.messages import Detections, KernelScores, ScoreImage, SearchResult
from tests.stages.made import depth_image, point_of, street_depth


def detect(image, **settings):
    score, detections = KernelDetect(**settings).on_image(image)
    assert isinstance(score, ScoreImage)
    assert isinstance(detections, Detections)
    check_arrays(score)
    check_arrays(detections)
    assert len(detections.reasons) == len(detections.accepted)
    return score, detections


def test_ports_are_what_the_graph_wires():
    assert list(input_ports(KernelDetect)) == ["image"]
    assert set(output_ports(KernelDetect)) == {"score_image", "detections"}


def test_a_drone_over_a_street_is_detected_at_its_position():
    image = depth_image(street_depth((200, 300)), origin=(0.1, 0.2, 0.25))
    score, detections = detect(image)
    assert detections.accepted.sum() == 1
    best = int(detections.accepted.argmax())
    centre = point_of(image, 200, 300)
    assert np.abs(detections.xyz_vehicle_m[best] - centre).max() <= 20.0 / image.focal_px + 1e-6  # within a pixel
    assert detections.stamp_ns == score.stamp_ns == image.stamp_ns
    x, y, z = detections.xyz_vehicle_m[best]
    assert detections.summary.startswith(f"drone at ({x:.2f}, {y:.2f}, {z:.2f}) m, score ")


def test_without_gates_the_lowest_score_is_the_drone():
    image = depth_image(street_depth((200, 300)))
    score, detections = detect(image, gates=None)
    row, column = np.unravel_index(np.nanargmin(score.score), score.score.shape)
    np.testing.assert_allclose(detections.xyz_vehicle_m[0], point_of(image, row, column))
    assert detections.accepted.tolist() == [True] + [False] * (len(detections.accepted) - 1)
    assert detections.reasons[:2] == ("lowest score", "not the lowest score")


def test_without_gates_a_far_pixel_beats_the_drone_as_in_the_paper():
    depth = street_depth((200, 300))
    depth[120, 256] = 60.0  # isolated in the sky, its inner box is one pixel: e = 0
    image = depth_image(depth)
    assert detect(image, gates=None)[1].xyz_vehicle_m[0][2] == 60.0
    _, gated = detect(image)
    assert gated.xyz_vehicle_m[int(gated.accepted.argmax())][2] == 20.0
    assert gated.accepted.sum() == 1
    assert gated.reasons[0] == "the inner box is 1 px at 60 m: beyond 37 m it cannot detect a drone"


def test_scores_are_sorted_and_the_sum_of_their_terms():
    _, detections = detect(depth_image(street_depth()))
    assert isinstance(detections.evidence, KernelScores)
    assert (np.diff(detections.evidence.e) >= -1e-3).all()
    np.testing.assert_array_equal(detections.evidence.e, detections.evidence.e_inner + detections.evidence.e_outer)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_the_detection_rotates_with_the_scene(turns):
    depth = street_depth((200, 300))
    _, here = detect(depth_image(depth))
    _, there = detect(depth_image(np.rot90(depth, turns).copy()))
    x, y, z = here.xyz_vehicle_m[int(here.accepted.argmax())]
    expected = {1: (y, -x, z), 2: (-x, -y, z), 3: (-y, x, z)}[turns]
    found = there.xyz_vehicle_m[int(there.accepted.argmax())]
    np.testing.assert_allclose(
        found, expected, atol=2 * 20.0 / 147.8
    )  # equal scores are ordered by position: one pixel of tolerance


def test_the_detection_moves_with_the_origin():
    _, here = detect(depth_image(street_depth()))
    _, there = detect(depth_image(street_depth(), origin=(1.0, -2.0, 0.5)))
    np.testing.assert_allclose(
        there.xyz_vehicle_m - here.xyz_vehicle_m, np.tile([1.0, -2.0, 0.5], (len(here.accepted), 1))
    )


def test_a_street_without_a_drone_has_no_detection_and_a_reason():
    _, detections = detect(depth_image(street_depth(None)))
    assert not detections.accepted.any()
    assert detections.summary.startswith("no drone: ")
    assert "candidates rejected" in detections.summary
    assert detections.result is SearchResult.ALL_REJECTED
    assert detections.reasons[0] in detections.summary


def test_for_an_empty_sky_the_summary_counts_the_returns():
    _, detections = detect(depth_image(np.zeros((512, 512))))
    assert detections.xyz_vehicle_m.shape == (0, 3)
    assert detections.summary == "no drone: 0 of 1000 returns lie within 60 deg of straight up"
    assert detections.result is SearchResult.NO_CANDIDATE


def test_pixels_nearer_than_nearest_m_are_no_candidates():
    depth = np.zeros((512, 512))
    depth[256, 256] = 0.7
    _, detections = detect(depth_image(depth))
    assert detections.summary.endswith("straight up, none of them 1 m or more above the turntable")


def test_two_drones_are_both_accepted_the_better_first():
    depth = street_depth((200, 300))
    depth[299:302, 249:252] = 19.0
    _, detections = detect(depth_image(depth))
    assert detections.accepted.sum() == 2
    assert detections.summary.endswith("1 more with a higher score")
    assert detections.result is SearchResult.DRONE


def test_an_accepted_candidate_is_published_even_if_many_rejected_ones_score_lower():
    depth = street_depth((200, 300))
    for k in range(20):
        depth[60 + 20 * k, 256] = 45.0
    _, detections = detect(depth_image(depth), max_candidates=5)
    assert len(detections.accepted) == 5
    assert detections.accepted.tolist() == [False] * 4 + [True]


@pytest.mark.parametrize(
    "settings",
    [
        {"span_m": 0.0},
        {"eps_m": 0.0},
        {"outer_side_px": 1},
        {"gates": Gates(neighbour_m=0.4)},
        {"gates": {"mistyped": 1}},
    ],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises((ValidationError, ValueError)):
        KernelDetect(**settings)
