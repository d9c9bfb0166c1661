"""GreatCircleVp on synthetic images: known streets and lenses, rotated cameras, parks, masks, gravity."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from synthetic_street import LOOKS_DOWN, LOOKS_UP, fisheye, foliage, street

from stages.geometry.frames import Pose, quaternions_xyzw, rotation_from_rpy_deg, rotation_z
from stages.geometry.lens import KannalaBrandt
from stages.messages import CameraMount, DroneTilt, Image, VehicleMotion
from stages.vp import GreatCircleVp

LENS = fisheye()
UP = Pose(rpy_deg=(0.0, 0.0, 90.0))
DOWN = Pose(rpy_deg=(180.0, 0.0, -90.0))
STILL = np.zeros(3)


def image(grey, stamp_ns=5, camera_mount="vehicle", readout_s=0.0):
    return Image(stamp_ns=stamp_ns, frame_id=f"camera_{camera_mount}", grey=grey, readout_s=readout_s)


def tilt(R, stamp_ns=5, rate_radps=STILL, sigma_deg=1.0):
    return DroneTilt(
        stamp_ns=stamp_ns,
        up_drone=R[2].copy(),
        sigma_rad=np.radians(sigma_deg),
        angular_velocity_drone_radps=rate_radps,
    )


def vehicle_vp(**settings):
    return GreatCircleVp(**{"camera_mount": CameraMount.VEHICLE, "T_mount_camera": UP, "lens": LENS} | settings)


def drone_vp(**settings):
    return GreatCircleVp(**{"camera_mount": CameraMount.DRONE, "T_mount_camera": DOWN, "lens": LENS} | settings)


def off_deg(directions, truth):
    """Angle of each direction to the nearest true one (rows)."""
    return np.degrees(np.arccos(np.clip(np.abs(directions @ np.asarray(truth).T), 0, 1))).min(axis=1)


@pytest.fixture(scope="module")
def level():
    return street(LOOKS_UP, LENS)


def test_a_street_gives_its_vertical_and_one_pair_in_the_vehicle_s_axes(level):
    found = vehicle_vp().on_image(image(level, stamp_ns=77))
    assert found.stamp_ns == 77
    assert found.camera_mount is CameraMount.VEHICLE
    assert list(found.is_vertical) == [True, False, False]
    assert list(found.frame) == [-1, 0, 0]
    assert off_deg(found.direction[:1], [[0, 0, 1]]) < 0.15
    assert off_deg(found.direction[1:], np.eye(3)[:2]).max() < 0.2
    assert abs(found.direction[1] @ found.direction[2]) < 1e-9
    assert (np.degrees(found.sigma_rad) > 0.05).all()
    assert (np.degrees(found.sigma_rad) < 0.5).all()


def test_its_lines_lie_on_their_circles_and_run_in_their_directions(level):
    found = vehicle_vp().on_image(image(level))
    assert len(found.line_normal) > 50
    np.testing.assert_allclose(np.linalg.norm(found.line_normal, axis=1), 1)
    np.testing.assert_allclose(np.einsum("nej,nj->ne", found.line_end, found.line_normal), 0, atol=1e-9)
    has = found.line_direction >= 0
    assert has.mean() > 0.8
    r = np.einsum("nj,nj->n", found.line_normal[has], found.direction[found.line_direction[has]])
    assert np.degrees(np.median(np.abs(r))) < 0.25
    assert set(found.line_direction) <= {-1, 0, 1, 2}


@pytest.mark.parametrize("rpy_deg", [(0.0, 0.0, 33.0), (2.0, -1.5, -70.0), (-1.0, 2.0, 170.0)])
def test_rotating_the_vehicle_rotates_the_directions_back(rpy_deg):
    R_world_vehicle = rotation_from_rpy_deg(rpy_deg)
    found = vehicle_vp().on_image(image(street(R_world_vehicle @ LOOKS_UP, LENS)))
    assert list(found.frame) == [-1, 0, 0]
    assert off_deg(found.direction @ R_world_vehicle.T, np.eye(3)).max() < 0.3
    assert off_deg(found.direction[:1] @ R_world_vehicle.T, [[0, 0, 1]]) < 0.2


def test_another_lens_and_mount_give_the_same_directions():
    lens = KannalaBrandt(
        focal_px=(113.0, 115.0), centre_px=(242.0, 236.0), k=(0.02, -0.004, 0.0, 0.0), max_off_axis_deg=115
    )
    tilted = rotation_from_rpy_deg((15.0, -10.0, 60.0))
    mount = Pose(quaternion_xyzw=tuple(quaternions_xyzw(tilted[None])[0]))
    found = vehicle_vp(lens=lens, T_mount_camera=mount).on_image(image(street(tilted, lens)))
    assert list(found.frame) == [-1, 0, 0]
    assert off_deg(found.direction, np.eye(3)).max() < 0.3


def test_a_wall_at_an_odd_angle_is_a_second_frame_only_without_the_rules_for_further_pairs():
    grey = street(LOOKS_UP, LENS, wall_turns_deg=(0.0, 30.0))
    found = vehicle_vp(min_direction_score=-100.0, min_elsewhere_score=-100.0).on_image(image(grey))
    assert list(np.unique(found.frame)) == [-1, 0, 1]
    other = rotation_z(np.radians(30.0))[:, :2].T
    of = [found.direction[found.frame == f] for f in (0, 1)]
    street_first = off_deg(of[0], np.eye(3)[:2]).max() < 1
    assert off_deg(of[0 if street_first else 1], np.eye(3)[:2]).max() < 0.3
    assert off_deg(of[1 if street_first else 0], other).max() < 0.3
    for settings in ({"max_frames": 1}, {}):  # one wall has one horizontal direction, as shadows and hoses have
        alone = vehicle_vp(**settings).on_image(image(grey))
        assert set(alone.frame) == {-1, 0}


def test_a_drone_takes_the_vertical_from_its_tilt():
    R_world_drone = rotation_from_rpy_deg((14.0, -20.0, 50.0))
    grey = street(R_world_drone @ LOOKS_DOWN, LENS, up_m=6.0)
    answers = []
    for heading_deg in (0.0, 123.0):
        vp = drone_vp()
        vp.on_tilt(tilt(rotation_z(np.radians(heading_deg)) @ R_world_drone))
        answers.append(vp.on_image(image(grey, camera_mount="drone")))
        assert off_deg(answers[-1].direction @ R_world_drone.T, np.eye(3)).max() < 0.3
    np.testing.assert_allclose(answers[0].direction, answers[1].direction, atol=1e-6)


def test_a_drone_without_tilt_finds_the_vertical_by_itself():
    R_world_drone = rotation_from_rpy_deg((14.0, -20.0, 50.0))
    grey = street(R_world_drone @ LOOKS_DOWN, LENS, up_m=6.0)
    found = drone_vp().on_image(image(grey, camera_mount="drone"))
    assert off_deg(found.direction[:1] @ R_world_drone.T, [[0, 0, 1]]) < 0.3
    assert off_deg(found.direction @ R_world_drone.T, np.eye(3)).max() < 0.3


def test_a_tilt_is_extrapolated_to_the_image_and_ignored_when_old():
    R_world_drone = rotation_from_rpy_deg((14.0, 0.0, 20.0))
    grey = street(R_world_drone @ LOOKS_DOWN, LENS, up_m=6.0)
    before = R_world_drone @ rotation_from_rpy_deg((-6.0, 0.0, 0.0))  # 0.1 s ago, rolling at 60 deg/s
    vp = drone_vp(search_deg=0.0)
    vp.on_tilt(tilt(before, 900_000_000, np.array([np.radians(60.0), 0, 0]), sigma_deg=0.3))
    found = vp.on_image(image(grey, 1_000_000_000, "drone"))
    assert off_deg(found.direction[:1] @ R_world_drone.T, [[0, 0, 1]]) < 0.3
    late = vp.on_image(image(grey, 1_200_000_000, "drone"))  # without tilt the mount's z is the vertical, 14 deg off
    assert not len(late.direction) or off_deg(late.direction[:1] @ R_world_drone.T, [[0, 0, 1]]) > 1


@pytest.mark.parametrize("seed", range(4))
def test_foliage_and_noise_are_no_structure(seed):
    found = vehicle_vp().on_image(image(foliage(seed=seed)))
    assert not (found.frame >= 0).any()
    assert found.reason
    noise = np.random.default_rng(seed).normal(110, 12, (480, 480)).astype(np.uint8)
    assert len(vehicle_vp().on_image(image(noise)).direction) == 0


def test_a_black_image_has_no_lines_and_a_reason():
    found = vehicle_vp().on_image(image(np.zeros((480, 480), dtype=np.uint8)))
    assert found.direction.shape == (0, 3)
    assert found.line_end.shape == (0, 2, 3)
    assert "too few" in found.reason


def test_masked_pixels_and_the_rim_give_no_lines(level):
    hidden = ((100.0, 0.0), (479.0, 0.0), (479.0, 200.0), (100.0, 200.0))
    found = vehicle_vp(masked_px=(hidden,), max_off_axis_deg=80.0).on_image(image(level))
    pixels = LENS.project((found.line_end @ LOOKS_UP).reshape(-1, 3))
    assert len(pixels) > 10
    assert not ((pixels[:, 0] > 101) & (pixels[:, 1] < 199)).any()
    assert (found.line_end[:, :, 2] > np.cos(np.radians(81.0))).all()


def test_the_same_image_gives_the_same_bytes_after_any_other(level):
    vp = vehicle_vp()
    first = vp.on_image(image(level))
    vp.on_image(image(foliage()))
    again = vp.on_image(image(level))
    np.testing.assert_array_equal(first.direction, again.direction)
    np.testing.assert_array_equal(first.line_normal, again.line_normal)
    assert first.reason == again.reason


@pytest.mark.parametrize(
    "settings",
    [
        {"min_contrast": 0.0},
        {"max_frames": 0},
        {"search_deg": 120.0},
        {"masked_px": (((1.0, 2.0), (3.0, 4.0)),)},
        {"line_sigma_deg": -1.0},
        {"spam": 1},
    ],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises(ValidationError):
        vehicle_vp(**settings)


def test_a_mask_of_all_pixels_is_rejected_with_a_suggestion(level):
    everything = ((0.0, 0.0), (479.0, 0.0), (479.0, 479.0), (0.0, 479.0))
    with pytest.raises(ValueError, match="draw smaller polygons"):
        vehicle_vp(masked_px=(everything,)).on_image(image(level))


def test_an_image_or_tilt_of_another_mount_is_rejected(level):
    with pytest.raises(ValueError, match="the image is of camera_drone"):
        vehicle_vp().on_image(image(level, camera_mount="drone"))
    with pytest.raises(ValueError, match="tilt belongs to the drone"):
        vehicle_vp().on_tilt(tilt(np.eye(3)))


@pytest.mark.parametrize("rate_dps", [(0.0, 0.0, 60.0), (40.0, -30.0, 20.0)])
def test_a_rolling_shutter_is_corrected_with_the_drones_rate(rate_dps):
    rate = np.radians(rate_dps)
    rolled = street(LOOKS_DOWN, LENS, up_m=8.0, row_turn=0.03 / 479 * (rate @ LOOKS_DOWN))
    of = []
    for readout_s in (0.03, 0.0):
        vp = drone_vp()
        vp.on_tilt(tilt(np.eye(3), rate_radps=rate))
        found = vp.on_image(image(rolled, camera_mount="drone", readout_s=readout_s))
        of.append(off_deg(found.direction[:3], np.eye(3)).max())
    assert of[0] < 0.15
    assert of[1] > 2 * of[0]


def test_a_rolling_shutter_is_corrected_with_the_vehicles_rate():
    rate = np.radians([0.0, 0.0, 80.0])
    rolled = street(LOOKS_UP, LENS, row_turn=0.03 / 479 * (rate @ LOOKS_UP))
    vp = vehicle_vp()
    of = []
    for _ in range(2):
        found = vp.on_image(image(rolled, stamp_ns=60_000_000, readout_s=0.03))
        of.append(off_deg(found.direction[:3], np.eye(3)).max())
        for ms in range(0, 101, 20):
            R = rotation_z((ms - 60) * 1e-3 * rate[2])
            vp.on_motion(
                VehicleMotion(
                    stamp_ns=ms * 1_000_000, R_map_vehicle=R, xyz_map_m=np.zeros(3), covariance=np.eye(6) * 1e-6
                )
            )
    assert of[1] < 0.1  # as of an image without rotation
    assert of[0] > 0.3


def test_vehicle_motion_is_rejected_for_a_camera_of_the_drone():
    with pytest.raises(ValueError, match="motion belongs to the vehicle"):
        drone_vp().on_motion(VehicleMotion(stamp_ns=1, R_map_vehicle=np.eye(3), xyz_map_m=STILL, covariance=np.eye(6)))
