"""Directions in renders of real panoramas with clutter, boards, people, blur, noise and JPEG hold their stated sigma."""

from __future__ import annotations

import numpy as np
import pytest

from stages.messages import CameraMount
from tests.stages.panoramas import FOLDER, LABELS, errors_of_renders

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="needs ../shared/data/panoramas")


@pytest.mark.parametrize("camera_mount", list(CameraMount))
@pytest.mark.parametrize("name", LABELS)
def test_each_direction_is_within_three_and_a_half_sigmas_of_a_labelled_one(name, camera_mount):
    found = errors_of_renders(name, camera_mount, 4, seed=1)
    assert sum(answer.has_frame for answer in found) >= 3
    error_deg = np.concatenate([answer.error_deg for answer in found])
    sigma_deg = np.concatenate([answer.sigma_deg for answer in found])
    assert (error_deg < 3.5 * sigma_deg).all()
    assert (sigma_deg < 0.5).all()
