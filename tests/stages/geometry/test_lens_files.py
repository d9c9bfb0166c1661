"""Lenses of calibration files: valid files, errors with their line, and a published calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.geometry.lens_files import LensFileError, lens_from_kalibr, lens_from_ocamcalib
from tests.stages.geometry.test_lens import KANNALA_BRANDT, OCAM, grid

KODAK = Path(__file__).resolve().parents[4] / "shared" / "data" / "fisheye" / "kodak_sp360_4k_ocamcalib.txt"

OCAMCALIB = """#polynomial coefficients for the DIRECT mapping function
5 -2.7e+02 0.0 -2.7e-06 1.84e-06 -8.0e-10

#inverse
3 580.0 470.0 97.0

#center: "row" and "column", starting from 0 (C convention)
728.5 729.25

#affine parameters "c", "d", "e"
1.0014 -0.0008 0.0002

#image size: "height" and "width"
1440 1440
"""

KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: equidistant
  intrinsics: [170.0, 171.0, 360.5, 359.0]
  distortion_coeffs: [0.02, -0.01, 0.002, -0.0003]
  resolution: [720, 720]
cam1:
  camera_model: omni
  distortion_model: radtan
  intrinsics: [1.0, 170.0, 171.0, 360.5, 359.0]
  distortion_coeffs: [0, 0, 0, 0]
"""


def test_a_kalibr_file_gives_its_equidistant_camera():
    assert lens_from_kalibr(KALIBR, "cam0", max_off_axis_deg=120.0) == (KANNALA_BRANDT, (720, 720))
    unsized = KALIBR.replace("  resolution: [720, 720]\n", "")
    assert lens_from_kalibr(unsized, max_off_axis_deg=120.0) == (KANNALA_BRANDT, None)
    assert lens_from_kalibr(KALIBR).lens.max_off_axis_deg < 90.0  # Kalibr uses no point beyond


@pytest.mark.parametrize(
    ("text", "camera", "text_of_error", "line"),
    [
        (KALIBR, "cam2", "no camera 'cam2' in this Kalibr file; it has: cam0, cam1", 0),
        (KALIBR, "cam1", "pinhole-equi", 8),
        (KALIBR.replace("171.0, ", "", 1), "cam0", "four numbers each", 4),
        (KALIBR.replace("0.002", "true"), "cam0", "four numbers each", 5),
        (KALIBR.replace("  intrinsics: [170.0, 171.0, 360.5, 359.0]\n", ""), "cam0", "four numbers each", 1),
        (KALIBR.replace("[720, 720]", "[720.5, 720]"), "cam0", "width and height", 6),
        (KALIBR.replace("0.02,", "-0.2,"), "cam0", "set max_off_axis_deg to at most", 5),
        (KALIBR.replace("170.0", ".inf"), "cam0", "four numbers each", 4),
        ("cam0:\n  a: [1, 2", "cam0", "no YAML", 2),
        ("cam0: 2020-99-99", "cam0", "no YAML", 0),
        ("", "cam0", "it has: none", 0),
    ],
)
def test_an_invalid_kalibr_file_gives_the_error_and_its_line(text, camera, text_of_error, line):
    with pytest.raises(LensFileError, match=text_of_error) as error:
        lens_from_kalibr(text, camera)
    assert error.value.line == line


def test_an_ocamcalib_file_gives_its_camera():
    assert lens_from_ocamcalib(OCAMCALIB, max_off_axis_deg=120.0) == (OCAM, (1440, 1440))


@pytest.mark.parametrize(
    ("text", "text_of_error", "line"),
    [
        ("", "no OCamCalib file", 0),
        (OCAMCALIB.replace("728.5", "x"), "no OCamCalib file", 8),
        (OCAMCALIB.replace("728.5", ""), "centre: 1 numbers instead of 2", 8),
        (OCAMCALIB.replace("5 -2.7e+02", "6 -2.7e+02"), "announces 6 coefficients and has 5", 2),
        (OCAMCALIB.replace("-2.7e+02", "2.7e+02"), "must be negative", 2),
        (OCAMCALIB.replace("-2.7e+02", "nan"), "finite", 2),
        (OCAMCALIB.replace("1440 1440", "1440 inf"), "image size", 14),
        (OCAMCALIB.replace("1440 1440", ""), "4 lines of numbers", 11),
    ],
)
def test_an_invalid_ocamcalib_file_gives_the_error_and_its_line(text, text_of_error, line):
    with pytest.raises(LensFileError, match=text_of_error) as error:
        lens_from_ocamcalib(text)
    assert error.value.line == line


@pytest.fixture
def kodak():
    if not KODAK.exists():
        pytest.skip("the Kodak SP360 calibration is not here (../shared/data/fisheye)")
    return KODAK.read_text(encoding="utf-8")


def test_a_real_calibration_round_trips_up_to_its_limit(kodak):
    lens, size_px = lens_from_ocamcalib(kodak, max_off_axis_deg=105.0)
    assert size_px == (1440, 1440)
    assert 690 < lens.circle_px < 720  # the image circle of a 1440 px image
    rays = grid(105.0)
    assert np.abs(lens.unproject(lens.project(rays)) - rays).max() < 1e-9


def test_the_calibrations_own_inverse_polynomial_agrees_with_ours_where_it_was_fitted(kodak):
    """world2cam: rho = sum b_i theta^i with theta from the image plane; a fit, good to 0.003 px."""
    lens, _ = lens_from_ocamcalib(kodak, max_off_axis_deg=105.0)
    inverse = [float(w) for w in kodak.splitlines()[6].split()[1:]]
    rays = grid(100.0)[24:]
    across = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan(-rays[:, 2] / across)
    rho = np.polynomial.polynomial.polyval(theta, inverse)
    x, y = rays[:, 1] / across * rho, rays[:, 0] / across * rho
    c, d, e = lens.affine_cde
    theirs = np.column_stack([x * e + y + 729.090632, x * c + y * d + 728.648728])
    assert np.abs(theirs - lens.project(rays)).max() < 0.01
