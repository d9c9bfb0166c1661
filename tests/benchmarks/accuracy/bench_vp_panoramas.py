"""Vanishing directions on renders of four real panoramas: is the stated sigma true, and are there wrong answers?

    GRD_RENDERS=100 python -m pytest tests/benchmarks/accuracy/bench_vp_panoramas.py -s

GRD_RENDERS (20) renders of each panorama and camera: 235 deg fisheye of 720 px, any yaw, tilted as a vehicle or a
drone, with exposure, blur, noise, JPEG, people, and in half of them a printed board. One panorama is kept back: no
threshold was chosen with it. GRD_RENDERS_SEED (0) draws others. About 0.3 s a render. Then other lenses and harder
images, GRD_RENDERS of each panorama but the one kept back, and camera.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from stages.messages import CameraMount
from tests.stages.panoramas import (
    FOLDER,
    KEPT_BACK,
    LABELS,
    Conditions,
    equisolid,
    errors_of_renders,
    fisheye,
    sensor,
)

COUNT, SEED = int(os.environ.get("GRD_RENDERS", "20")), int(os.environ.get("GRD_RENDERS_SEED", "0"))
CASES = {
    "vehicle": (CameraMount.VEHICLE, True),
    "drone": (CameraMount.DRONE, True),
    "no tilt": (CameraMount.DRONE, False),
}
CONDITIONS = {
    "equidistant, 180 deg": Conditions(lens=fisheye(fov_deg=180.0)),
    "equidistant, 220 deg": Conditions(lens=fisheye(fov_deg=220.0)),
    "equisolid, 180 deg": Conditions(lens=equisolid(720, 180.0)),
    "equisolid, 210 deg": Conditions(lens=equisolid(720, 210.0)),
    "defocus of 3 px": Conditions(sensor=sensor(blur_px=3.0)),
    "noise of 15 grey levels": Conditions(sensor=sensor(noise=15.0)),
    "an eighth of the light, noise of 4": Conditions(sensor=sensor(gain=0.12, noise=4.0)),
    "overexposed three times": Conditions(sensor=sensor(gain=3.0)),
    "JPEG quality 15": Conditions(sensor=sensor(quality=15)),
    "8 people, 3 boards": Conditions(people=8, boards=3),
}
HEAD = (
    "| panorama, camera | renders | with a horizontal pair [%] | all within 3 sigma [%] | wrong: > 2 deg at sigma < 0.5 "
    "| error [deg] | sigma [deg] | within 1, 2, 3 sigma [%] |"
)
pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(not FOLDER.exists(), reason="needs ../shared/data/panoramas"),
]


def row(name, found):
    share = [f"{100 * np.mean(values):5.1f}" for values in ([a.has_frame for a in found], [a.within for a in found])]
    error = np.concatenate([a.error_deg for a in found])
    sigma = np.concatenate([a.sigma_deg for a in found])
    reliability = " ".join(f"{100 * np.mean(error < k * sigma):.0f}" for k in (1, 2, 3))
    return (
        f"| {name} | {len(found)} | {share[0]} | {share[1]} | {sum(a.wrong for a in found)} | {np.median(error):.2f} | "
        f"{np.median(sigma):.2f} | {reliability} |"
    )


def test_stated_sigmas_and_wrong_answers_on_renders_of_real_panoramas():
    print(f"\n{HEAD}\n{'| --- ' * 8}|")  # noqa: T201
    used, kept_back = [], []
    for name in LABELS:
        for case, (camera_mount, tilt) in CASES.items():
            found = errors_of_renders(name, camera_mount, COUNT, SEED, tilt)
            (kept_back if name == KEPT_BACK else used).extend(found)
            print(row(f"{name}{' (kept back)' if name == KEPT_BACK else ''}, {case}", found))  # noqa: T201
    print(row("three panoramas", used))  # noqa: T201
    print(row("kept back", kept_back))  # noqa: T201
    for found in (used, kept_back):
        assert np.mean([a.has_frame for a in found]) >= 0.8
        assert np.mean([a.within for a in found]) >= 0.95
        assert np.mean([a.wrong for a in found]) <= 0.005  # goal: 0 of 1000


def test_stated_sigmas_and_wrong_answers_through_other_lenses_and_in_hard_images():
    print(f"\n{HEAD}\n{'| --- ' * 8}|")  # noqa: T201
    wrong = []
    for title, conditions in CONDITIONS.items():
        found = [
            answer
            for name in LABELS
            for camera_mount in CameraMount
            if name != KEPT_BACK
            for answer in errors_of_renders(name, camera_mount, COUNT, SEED, conditions=conditions)
        ]
        print(row(title, found))  # noqa: T201
        wrong += [a.wrong for a in found]
    assert np.mean(wrong) <= 0.005  # goal: 0 of 1000
