"""Lenses: formulas by hand, round trips beyond 90 deg, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from stages.geometry.lens import Equidistant, KannalaBrandt, Lens, OCam

EQUIDISTANT = Equidistant(focal_px=175.0, centre_px=(359.5, 359.5), max_off_axis_deg=120.0)
KANNALA_BRANDT = KannalaBrandt(
    focal_px=(170.0, 171.0), centre_px=(360.5, 359.0), k=(0.02, -0.01, 0.002, -0.0003), max_off_axis_deg=120.0
)
OCAM = OCam(
    polynomial=(-2.7e02, 0.0, -2.7e-06, 1.84e-06, -8.0e-10),
    centre_px=(729.25, 728.5),
    affine_cde=(1.0014, -0.0008, 0.0002),
    max_off_axis_deg=120.0,
)
RIG_LENS = TypeAdapter(Lens)  # as a rig file's `lens:` is read
LENSES = [EQUIDISTANT, KANNALA_BRANDT, OCAM]
each_lens = pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)


def rays_at(off_axis_deg, azimuth_deg):
    theta, phi = np.radians(np.broadcast_arrays(off_axis_deg, azimuth_deg))
    return np.column_stack(
        [(np.sin(theta) * np.cos(phi)).ravel(), (np.sin(theta) * np.sin(phi)).ravel(), np.cos(theta).ravel()]
    )


def grid(limit_deg):
    return rays_at(np.linspace(0.0, limit_deg, 181)[:, None], np.arange(0.0, 360.0, 15.0))


def test_an_equidistant_lens_puts_a_ray_at_focal_length_times_angle():
    pixels = EQUIDISTANT.project(rays_at([0.0, 90.0, 110.0, 110.0], [0.0, 0.0, 90.0, 180.0]))
    far = 175.0 * math.radians(110)
    expected = [(359.5, 359.5), (359.5 + 175 * math.pi / 2, 359.5), (359.5, 359.5 + far), (359.5 - far, 359.5)]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_kannala_brandt_is_an_odd_polynomial_of_the_angle_with_two_focal_lengths():
    theta = math.radians(100.0)
    rho = theta + 0.02 * theta**3 - 0.01 * theta**5 + 0.002 * theta**7 - 0.0003 * theta**9
    ray = rays_at([100.0], [30.0])
    expected = (360.5 + 170 * rho * math.cos(math.pi / 6), 359.0 + 171 * rho * math.sin(math.pi / 6))
    np.testing.assert_allclose(KANNALA_BRANDT.project(ray)[0], expected, atol=1e-9)


def test_an_ocam_pixel_is_unprojected_as_in_cam2world():
    """Scaramuzza's C code, with x down the rows, y along the columns and z towards the viewer."""
    row, column = 300.0, 1100.0
    c, d, e = OCAM.affine_cde
    determinant = c - d * e
    xp = ((row - 728.5) - d * (column - 729.25)) / determinant
    yp = (-e * (row - 728.5) + c * (column - 729.25)) / determinant
    zp = np.polynomial.polynomial.polyval(math.hypot(xp, yp), OCAM.polynomial)
    norm = math.sqrt(xp**2 + yp**2 + zp**2)
    np.testing.assert_allclose(
        OCAM.unproject(np.array([[column, row]]))[0], [yp / norm, xp / norm, -zp / norm], atol=1e-12
    )


@each_lens
def test_the_axis_meets_the_centre(lens):
    np.testing.assert_allclose(lens.project(np.array([[0.0, 0.0, 2.0]]))[0], lens.centre_px, atol=1e-12)
    np.testing.assert_allclose(lens.unproject(np.array([lens.centre_px]))[0], [0.0, 0.0, 1.0], atol=1e-12)


@each_lens
def test_rays_come_back_from_their_pixels_up_to_120_deg_off_axis(lens):
    rays = grid(120.0)
    back = lens.unproject(lens.project(rays))
    assert np.abs(back - rays).max() < 1e-9


@each_lens
def test_pixels_come_back_from_their_rays(lens):
    column, row = np.meshgrid(np.arange(0.0, 1440.0, 7.3), np.arange(0.0, 1440.0, 7.3))
    pixels = np.column_stack([column.ravel(), row.ravel()])
    rays = lens.unproject(pixels)
    seen = np.isfinite(rays[:, 0])
    assert seen.sum() > 1000
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, atol=1e-12)
    assert np.abs(lens.project(rays[seen]) - pixels[seen]).max() < 1e-6


@given(
    st.floats(0.0, 119.9),
    st.floats(0.0, 360.0),
    st.tuples(st.floats(-0.02, 0.03), st.floats(-0.004, 0.004), st.floats(0, 0.0005), st.floats(0, 1e-5)),
    st.floats(0.01, 1e3),
)
def test_any_monotonic_kannala_brandt_lens_round_trips(off_axis_deg, azimuth_deg, k, length):
    lens = KannalaBrandt(focal_px=(300.0, 290.0), centre_px=(500.0, 510.0), k=k, max_off_axis_deg=120.0)
    ray = rays_at([off_axis_deg], [azimuth_deg])
    np.testing.assert_allclose(lens.unproject(lens.project(length * ray)), ray, atol=1e-9)


@each_lens
def test_the_image_is_not_mirrored_and_the_radius_grows_with_the_angle(lens):
    """x of the ray is to the right, y down, also beyond 90 deg: no mirroring."""
    for off_axis_deg in (5.0, 60.0, 95.0, 118.0):
        right, down = lens.project(rays_at([off_axis_deg] * 2, [0.0, 90.0])) - lens.centre_px
        assert right[0] > abs(right[1])
        assert down[1] > abs(down[0])
    radius = np.linalg.norm(lens.project(rays_at(np.linspace(0, 119, 120), 40.0)) - lens.centre_px, axis=1)
    assert (np.diff(radius) > 0).all()


@each_lens
def test_an_enlarged_image_shows_the_same_rays(lens):
    """Pixel centres are whole numbers, so a pixel at p of the small image covers the large one around 2 p + 0.5."""
    large = lens.scaled(2.0)
    rays = grid(119.0)
    np.testing.assert_allclose(large.project(rays), 2 * lens.project(rays) + 0.5, atol=1e-6)
    assert large.circle_px == pytest.approx(2 * lens.circle_px, rel=1e-9)


@each_lens
def test_rays_and_pixels_beyond_the_lens_are_nan(lens):
    assert np.isnan(lens.project(rays_at([120.01, 180.0], [45.0, 0.0]))).all()
    edge = np.add(lens.centre_px, (lens.circle_px * 1.01, 0.0))
    assert np.isnan(lens.unproject(edge[None])).all()


@each_lens
def test_a_zero_ray_has_no_pixel(lens):
    for nothing in ([0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, -1.0]):
        assert np.isnan(lens.project(np.array([nothing]))).all()
    assert np.isnan(lens.unproject(np.array([[np.nan, 3.0], [np.inf, 3.0]]))).all()
    assert lens.project(np.empty((0, 3))).shape == (0, 2)


def test_arrays_of_another_shape_are_rejected():
    with pytest.raises(ValueError, match=r"shape \(n, 3\), got \(3,\)"):
        EQUIDISTANT.project(np.array([0.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match=r"shape \(n, 2\)"):
        EQUIDISTANT.unproject(np.zeros((4, 3)))


def test_a_non_monotonic_lens_reports_its_largest_valid_angle():
    settings = {"focal_px": (170.0, 170.0), "centre_px": (360.0, 360.0), "k": (-0.1, 0.0, 0.0, 0.0)}
    with pytest.raises(ValidationError, match=r"fold the image back at 10\d\.\d deg off axis: set max_off_axis_deg"):
        KannalaBrandt(**settings, max_off_axis_deg=117.5)  # 1 - 0.3 theta^2 = 0 at 104.6 deg
    KannalaBrandt(**settings, max_off_axis_deg=104.0)


def test_a_lens_round_trips_through_a_rig_file():
    for lens in LENSES:
        assert RIG_LENS.validate_python(lens.model_dump(mode="json")) == lens


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        ({"model": "pinhole"}, "ocam"),
        ({"model": "equidistant", "focal_px": -3, "centre_px": [1, 2]}, "greater than 0"),
        ({"model": "equidistant", "focal_px": 3, "centre_px": [1, 2], "k1": 0}, "Extra inputs"),
        ({"model": "ocam", "polynomial": [3.0, 0.0], "centre_px": [1, 2]}, "must be negative"),
        ({"model": "ocam", "polynomial": [-3.0, 0.0], "centre_px": [1, 2], "affine_cde": [0, 0, 0]}, "singular"),
    ],
)
def test_an_impossible_lens_is_rejected(tree, text):
    with pytest.raises(ValidationError, match=text):
        RIG_LENS.validate_python(tree)
