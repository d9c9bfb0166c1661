"""Rotation between an up- and a down-looking fisheye rendered from real panoramas: matches, errors, stated probability.

    GRD_RENDERS=40 python -m pytest tests/benchmarks/accuracy/bench_align_panoramas.py -s

GRD_RENDERS (10) pairs of each panorama, disturbed as in bench_vp_panoramas.py; both cameras are at the panorama's
place. A match is right when it is less than 2 deg off on one of its branches. The prior of 8 deg stands for a heading
by the drone's motion: of the matches, the most probable one that agrees with it is accepted. About 0.7 s a pair.
"""

from __future__ import annotations

import math
import os

import numpy as np
import pytest

from stages.align import JointAlign
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import CameraMount, Image
from tests.stages.panoramas import FOLDER, LABELS, Conditions, grd_stage, random_rotation, render, tilt_at

COUNT, SEED = int(os.environ.get("GRD_RENDERS", "10")), int(os.environ.get("GRD_RENDERS_SEED", "0"))
PRIOR_RAD, RIGHT_DEG, NS = math.radians(8.0), 2.0, 1_000_000_000
HEAD = (
    "| panorama | pairs | with a match [%] | right among the matches [%] | first right [%] | stated P of the first, right, "
    "wrong | wrong accepted with the prior | error, median, 95 % [deg] | within 3 sigma [%] |"
)
pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(not FOLDER.exists(), reason="needs ../shared/data/panoramas"),
]


def off(R_true: np.ndarray, R_world_vehicle: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Error (3,) [rad] of the nearest branch, drone axes."""
    about = [R_world_vehicle.T @ rotation_z(k * math.pi / 2) @ R_world_vehicle @ R for k in range(4)]
    errors = [log_rotation(np.ascontiguousarray(one.T @ R_true)) for one in about]
    return min(errors, key=lambda e: float(np.linalg.norm(e)))


def pairs(name: str):
    """R_vehicle_drone, R_world_vehicle and the message of each pair."""
    rng = np.random.default_rng([int(name), 7, SEED])
    vehicle, drone = (grd_stage(m, Conditions().lens) for m in (CameraMount.VEHICLE, CameraMount.DRONE))
    align = JointAlign()
    for k in range(COUNT):
        ns = (k + 1) * NS
        up, down = (render(name, m, random_rotation(rng, m), rng) for m in (CameraMount.VEHICLE, CameraMount.DRONE))
        drone.on_tilt(tilt_at(down.R_world_mount, rng, ns))
        list(align.on_vehicle(vehicle.on_image(Image(stamp_ns=ns, frame_id="camera_vehicle", grey=up.grey))))
        seen = drone.on_image(Image(stamp_ns=ns, frame_id="camera_drone", grey=down.grey))
        (message,) = align.on_drone(seen)
        yield up.R_world_mount.T @ down.R_world_mount, up.R_world_mount, message, rng.normal(0.0, PRIOR_RAD)


def test_the_rotation_between_renders_of_real_panoramas():
    print(f"\n{HEAD}\n{'| --- ' * 9}|")  # noqa: T201
    wrong_accepted = 0
    for name in LABELS:
        n = matched = right = first = wrong = inside = 0
        stated: dict[bool, list[float]] = {True: [], False: []}
        errors: list[float] = []
        for R_true, R_world_vehicle, message, prior_rad in pairs(name):
            n += 1
            matched += len(message.rotations) > 0
            e = [off(R_true, R_world_vehicle, R) for R in message.rotations]
            good = [math.degrees(np.linalg.norm(one)) < RIGHT_DEG for one in e]
            right += any(good)
            if good:
                first += good[0]
                stated[good[0]].append(float(message.probabilities[0]))
            for k in np.flatnonzero(good)[:1]:
                errors.append(math.degrees(np.linalg.norm(e[k])))
                inside += e[k] @ np.linalg.solve(message.covariances_rad2[k], e[k]) < 14.2  # 3 sigma, 3 degrees
            agree = [k for k, one in enumerate(e) if abs(one[2] - prior_rad) < 3 * PRIOR_RAD]
            wrong += bool(agree) and not good[agree[0]] and message.probabilities[agree[0]] > 0.5
        wrong_accepted += wrong
        p = ", ".join(f"{np.mean(v):.2f}" if v else "-" for v in stated.values())
        print(  # noqa: T201
            f"| {name} | {n} | {100 * matched / n:.0f} | {100 * right / n:.0f} | {100 * first / n:.0f} | {p} | {wrong} | "
            f"{np.median(errors):.2f}, {np.quantile(errors, 0.95):.2f} | {100 * inside / max(len(errors), 1):.0f} |"
        )
        assert right >= 0.5 * n
