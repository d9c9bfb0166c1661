"""PaperVp: axes of a chequered courtyard from three views at any rotation; no result; bad settings."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays, hash_into
from flow.stage import input_ports, output_ports
from stages.geometry.frames import Pose, rotation_from_rpy_deg
from stages.messages import CameraMount, Image
from stages.vp import PaperVp
from stages.vp.paper_vp import assign_lines
from tests.stages.vp.synthetic_courtyard import LENS, LOOKS_DOWN, LOOKS_UP, SIZE_PX, courtyard, plain


def vp(mount=LOOKS_UP, camera_mount="vehicle", **settings):
    base = {"camera_mount": camera_mount, "T_mount_camera": mount, "lens": LENS, "size_px": SIZE_PX, "view_px": 300}
    return PaperVp(**base | settings)


def directions(R_room_carrier, mount=LOOKS_UP, camera_mount="vehicle", **settings):
    R_carrier_camera = mount.matrix()[:3, :3]
    message = vp(mount, camera_mount, **settings).on_image(
        courtyard(R_room_carrier @ R_carrier_camera, 77, camera_mount)
    )
    check_arrays(message)
    return message


def off_axes_deg(message, R_room_carrier):
    """Angle of each direction to the nearest axis of the courtyard."""
    in_room = message.direction @ R_room_carrier.T
    return np.degrees(np.arccos(np.clip(np.abs(in_room).max(axis=1), 0, 1)))


def test_ports_are_what_the_graph_wires():
    assert set(input_ports(PaperVp)) == {"image"}
    assert set(output_ports(PaperVp)) == {"vanishing_directions"}


@pytest.mark.parametrize(
    ("rpy_deg", "mount", "camera_mount"),
    [
        ((0, 0, 20), LOOKS_UP, "vehicle"),
        ((4, -3, -65), LOOKS_UP, "vehicle"),
        ((-5, 6, 130), LOOKS_DOWN, "drone"),
        ((10, 0, 75), LOOKS_DOWN, "drone"),
    ],
)
def test_the_axes_of_the_courtyard_are_found_in_mount_axes(rpy_deg, mount, camera_mount):
    R = rotation_from_rpy_deg(rpy_deg)
    message = directions(R, mount, camera_mount)
    assert message.stamp_ns == 77
    assert message.camera_mount is CameraMount(camera_mount)
    assert len(message.direction) == 3, message.reason
    assert off_axes_deg(message, R).max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(message.direction, axis=1), 1.0, atol=1e-12)
    assert len(set(np.argmax(np.abs(message.direction @ R.T), axis=1))) == 3, "three different axes"


ON_AXIS = [{"azimuth_deg": 0, "off_axis_deg": 0}] + [{"azimuth_deg": a, "off_axis_deg": 70} for a in (-90, 0)]


CORNER = (4.0, 3.0, -4.5)  # low in a corner of the courtyard: walls reach up to the axis of the lens


@pytest.mark.parametrize("settings", [{"vote": "image", "views": ON_AXIS}, {"views": ON_AXIS}, {"vote": "image"}])
def test_votes_and_layouts_of_the_views_find_the_axes_of_the_courtyard(settings):
    R = rotation_from_rpy_deg((3, -2, -65))
    message = vp(**settings).on_image(courtyard(R @ LOOKS_UP.matrix()[:3, :3], 77, "vehicle", CORNER))
    check_arrays(message)
    assert len(message.direction) == 3, message.reason
    assert off_axes_deg(message, R).max() < 1.5


def test_a_vote_in_the_image_needs_the_vanishing_points_in_the_views():
    """Three views of 60 deg at 20 deg off the axis contain the vertical, and no horizontal direction."""
    high = [{"azimuth_deg": a, "off_axis_deg": 20} for a in (-90, 30, 150)]
    R = rotation_from_rpy_deg((3, -2, -65))
    image = courtyard(R @ LOOKS_UP.matrix()[:3, :3], 77, "vehicle", CORNER)
    message = vp(vote="image", views=high, fov_deg=60, min_lines=4).on_image(image)
    assert len(message.direction) == 0
    assert "no two vanishing points are at a right angle" in message.reason


def test_the_vertical_comes_first_and_is_marked():
    message = directions(rotation_from_rpy_deg((3, 2, 40)))
    assert message.is_vertical.tolist() == [True, False, False]
    assert message.frame.tolist() == [-1, 0, 0]
    assert abs(message.direction[0, 2]) > np.cos(np.radians(6))


def test_rotating_the_camera_on_its_mount_changes_nothing():
    R = rotation_from_rpy_deg((0, 0, 25))
    turned = Pose(rpy_deg=(8.0, -5.0, 200.0))
    assert off_axes_deg(directions(R, turned), R).max() < 1.0


def test_lines_lie_on_great_circles_through_their_ends_and_belong_to_a_direction():
    message = directions(rotation_from_rpy_deg((0, 0, 20)))
    ends, normal = message.line_end, message.line_normal
    np.testing.assert_allclose(np.linalg.norm(ends, axis=2), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.einsum("nki,ni->nk", ends, normal), 0.0, atol=1e-9)
    assert (message.line_sigma_rad > 0).all()
    assert len(normal) > 100
    assert (message.line_direction >= 0).mean() > 0.9
    assert set(message.line_direction.tolist()) >= {0, 1, 2}
    of_first = normal[message.line_direction == 1]
    assert np.abs(of_first @ message.direction[1]).max() <= np.sin(np.radians(2.0))


def test_the_third_direction_is_orthogonal_to_the_other_two():
    d = directions(rotation_from_rpy_deg((5, -4, 33))).direction
    cosines = np.sort(np.abs([d[0] @ d[1], d[0] @ d[2], d[1] @ d[2]]))
    np.testing.assert_allclose(cosines[:2], 0.0, atol=1e-12)
    assert cosines[2] < np.sin(np.radians(2.0)), "found, not made orthogonal"


def test_the_same_image_gives_the_same_bits():
    digests = []
    for _ in range(2):
        digest = hashlib.sha256()
        hash_into(digest, digest, directions(rotation_from_rpy_deg((0, 0, 20))))
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]


def test_an_empty_image_has_no_directions_and_a_reason():
    message = vp().on_image(plain())
    check_arrays(message)
    assert message.direction.shape == (0, 3)
    assert message.line_normal.shape == (0, 3)
    assert message.line_end.shape == (0, 2, 3)
    assert message.reason == "0 of 3 views have a vanishing point"


def test_one_direction_in_all_views_gives_no_result():
    grey = plain().grey.copy()
    rays = LENS.unproject(np.argwhere(grey > 0)[:, ::-1].astype(np.float64))
    spokes = (np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) // 6) % 2 > 0  # all run to the zenith
    grey[:] = np.where(spokes, 60, 190).reshape(grey.shape)
    message = vp().on_image(Image(stamp_ns=1, frame_id="camera_vehicle", grey=grey))
    assert len(message.direction) == 0
    assert message.reason == "1 of 3 views have a vanishing point"
    independent = vp(apart_deg=0).on_image(Image(stamp_ns=1, frame_id="camera_vehicle", grey=grey))
    assert independent.reason == "no two vanishing points are at a right angle: 0 deg at most"
    assert len(message.line_normal) > 20
    assert (message.line_direction == -1).all()


def test_an_image_of_another_size_is_rejected_with_the_setting():
    with pytest.raises(ValueError, match="the image is 200 x 200 px, but size_px is 480: set the lens"):
        vp().on_image(plain(size_px=200))


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            {"views": [{"azimuth_deg": 0, "off_axis_deg": 130}, {"azimuth_deg": 90, "off_axis_deg": 60}]},
            "views.0: only ",
        ),
        ({"views": [{"azimuth_deg": 0, "off_axis_deg": 60}]}, "at least 2"),
        ({"fov_deg": 180.0}, "less than or equal to 120"),
        ({"camera_mount": "truck"}, "'vehicle' or 'drone'"),
        ({"vote": "hough"}, "'sphere' or 'image'"),
        ({"min_lines": 1}, "greater than or equal to 2"),
        ({"polish": True}, "Extra inputs"),
    ],
)
def test_impossible_settings_are_rejected(settings, text):
    with pytest.raises(ValidationError, match=text):
        vp(**settings)


def test_a_line_belongs_to_the_direction_its_circle_passes_nearest():
    normal = np.array([[0, 0, 1.0], [0, np.sin(0.01), np.cos(0.01)], [0.6, 0.8, 0]])
    towards = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    assert assign_lines(normal, towards, 0.02).tolist() == [0, 0, -1]
    assert assign_lines(normal, np.empty((0, 3)), 0.02).tolist() == [-1, -1, -1]
