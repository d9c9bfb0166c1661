"""Draw docs/images/reliability.png: stated against actual errors of vanishing directions, simulated and real side by side.

    python -m tests.benchmarks.draw_reliability [IMAGES_PER_CAMERA]

Needs the extras `evaluate` and `simulate`. The real half needs ../shared/data (panoramas, York Urban, corridor) and is
empty without it. Prints one line per group; writes images of simulated failures to docs/images/vp_failure_*.jpg.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib import pyplot as plt

from stages.geometry.lens_files import lens_from_ocamcalib
from stages.kernels.vp.directions import CAUCHY
from stages.messages import CameraMount, Image
from stages.vp import GreatCircleVp
from stages.vp.great_circle_vp import FULL_WEIGHT_RAD
from tests.benchmarks.bench_vp import R_MOUNT_CAMERA, forward_stage, york_stage
from tests.stages import panoramas
from tests.stages.panoramas import DirectionErrors, direction_errors
from tests.stages.reliability import DATA, grd_stage
from tests.stages.simulated_views import SCENES, View, views
from tests.stages.york_urban import labelled, york_folders, york_image, york_truth

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
SEED = 201  # of worlds that no threshold was chosen with
MAX_FAILURES = 3
LINE_SIGMA_DEG = 0.25  # `line_sigma_deg` of the stage
Groups = dict[str, list[DirectionErrors]]


def main() -> None:
    """Compute both halves, print the table, draw the figure."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    matplotlib.use("Agg")
    print(corridor())  # noqa: T201
    real = real_groups(4 * count)
    simulated = simulated_groups(count)
    figure, both = plt.subplots(1, 2, figsize=(9.5, 4.0), sharey=True, layout="constrained")
    for axes, title, groups in zip(both, ("simulated", "real"), (simulated, real), strict=True):
        draw(axes, title, groups)
    both[0].set_ylabel("share of directions with a smaller error")
    figure.savefig(IMAGES / "reliability.png", dpi=75)


def draw(axes: plt.Axes, title: str, groups: Groups) -> None:
    """One curve per group: share of directions whose error is below k stated sigmas."""
    k = np.linspace(0, 6, 121)
    axes.plot(k, 1 - np.exp(-(k**2) / 2), color="0.6", ls="--", label="Gaussian, two axes")
    for name, found in groups.items():
        error, sigma = (np.concatenate([getattr(a, part) for a in found]) for part in ("error_deg", "sigma_deg"))
        axes.plot(k, [(error < at * sigma).mean() for at in k], label=f"{name} ({len(found)} images)")
        share = ", ".join(f"{100 * np.mean(error < at * sigma):.1f}" for at in (1, 2, 3))
        frames, wrong = 100 * np.mean([a.has_frame for a in found]), sum(a.wrong for a in found)
        errors = f"{np.median(error):.2f}, {np.quantile(error, 0.95):.2f} | {np.median(sigma):.2f}"
        print(f"| {title}, {name} | {len(found)} | {frames:.0f} | {errors} | {share} | {wrong} |")  # noqa: T201
    axes.set(title=title, xlabel="error / stated sigma", ylim=(0, 1.02), xlim=(0, 6))
    axes.legend(loc="lower right", fontsize=7)


def simulated_groups(count: int) -> Groups:
    """Five scenes without and with clutter; images of the failures with clutter."""
    groups: Groups = {}
    failures = 0
    for clutter in (False, True):
        name = "with clutter" if clutter else "without clutter"
        for scene in SCENES:
            stages: dict[CameraMount, GreatCircleVp] = {}
            for view in views(scene, SEED, count, clutter):
                vp = stages.setdefault(view.camera_mount, grd_stage(view))
                if view.tilt is not None:
                    vp.on_tilt(view.tilt)
                found = vp.on_image(view.image)
                result = direction_errors(found, view.R_world_mount, view.truth)
                groups.setdefault(name, []).append(result)
                if clutter and failures < MAX_FAILURES and (not result.has_frame or not result.within):
                    failures += 1
                    save_failure(IMAGES / f"vp_failure_{failures}.jpg", scene, view, found.line_end, result)
    return groups


def save_failure(file: Path, scene: str, view: View, ends: np.ndarray, result: DirectionErrors) -> None:
    """The image with its lines, and below it the reason and the errors."""
    image = np.ascontiguousarray(view.colour[..., ::-1])
    camera = view.scenario.cameras.vehicle if view.camera_mount is CameraMount.VEHICLE else view.scenario.cameras.drone
    assert camera is not None
    for arc in ends @ grd_stage(view).settings.T_mount_camera.matrix()[:3, :3]:
        share = np.linspace(0, 1, 9)[:, None]
        path = (1 - share) * arc[0] + share * arc[1]
        at = camera.true_lens.project(path / np.linalg.norm(path, axis=1, keepdims=True))
        if np.isfinite(at).all():
            cv2.polylines(image, [np.rint(at).astype(np.int32)], False, (0, 255, 255), 1, cv2.LINE_AA)
    pairs = zip(result.error_deg, result.sigma_deg, strict=True)
    errors = ", ".join(f"{error:.1f} ({sigma:.2f})" for error, sigma in pairs)
    text = (f"{scene}, {view.camera_mount.value}: {result.reason}", f"error (stated sigma) [deg]: {errors or '-'}")
    bar = np.full((50, image.shape[1], 3), 255, np.uint8)
    for row, line in enumerate(text):
        cv2.putText(bar, line[:140], (6, 20 + 22 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.imwrite(str(file), np.vstack([image, bar]), [cv2.IMWRITE_JPEG_QUALITY, 70])
    print(f"{file.name}: {' | '.join(text)}")  # noqa: T201


def real_groups(count: int) -> Groups:
    """Renders of panoramas, `count` of each and camera, and York's training half; empty without the data."""
    groups: Groups = {}
    if panoramas.FOLDER.exists():
        for name in panoramas.LABELS:
            group = "panorama kept back" if name == panoramas.KEPT_BACK else "three panoramas"
            for mount in CameraMount:
                groups.setdefault(group, []).extend(panoramas.errors_of_renders(name, mount, count, SEED))
    return {**groups, **york()}


def york() -> Groups:
    """Three directions of each image, without gravity, against the published directions and the labelled lines.

    The last group has the sigma of the labels in that of the answer.
    """
    vp = york_stage()
    groups: Groups = {}
    for folder in york_folders():
        directions = vp.on_image(york_image(folder))
        sigma, has_frame = np.degrees(directions.sigma_rad), bool((directions.frame >= 0).any())
        lines = labelled(folder)
        label_sigma = lines.sigma_deg[_nearest(directions.direction, lines.direction)[1]]
        for name, truth, stated in (
            ("York, published directions", york_truth(folder), sigma),
            ("York, labelled lines", lines.direction, sigma),
            ("York, labelled lines and their sigma", lines.direction, np.hypot(sigma, label_sigma)),
        ):
            error = _nearest(directions.direction, truth)[0]
            groups.setdefault(name, []).append(DirectionErrors(error, stated, has_frame, directions.reason))
    return groups


def _nearest(direction: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle [deg] of each direction (n, 3), mount axes, to the nearest true one, camera axes, and its index."""
    cosine = np.abs(direction @ R_MOUNT_CAMERA @ truth.T)
    return np.degrees(np.arccos(np.clip(cosine.max(axis=1), 0.0, 1.0))), cosine.argmax(axis=1)


def corridor() -> str:
    """Angles between the directions in the real corridor, each by its own lines alone; the building's are right.

    Also by the lines within 80 and 70 deg of the axis alone, with the sigma of each angle by resampling the lines.
    """
    folder = DATA / "fisheye"
    if not folder.exists():
        return "corridor: not here"
    lens = lens_from_ocamcalib((folder / "corridor_1600_ocamcalib.txt").read_text()).lens
    grey = cv2.imread(str(folder / "corridor_1600.jpg"), cv2.IMREAD_GRAYSCALE)
    vp = forward_stage(lens)
    found = vp.on_image(Image(stamp_ns=0, frame_id="camera_drone", grey=grey))
    extent_rad = np.arccos(np.clip((found.line_end[:, 0] * found.line_end[:, 1]).sum(axis=1), -1.0, 1.0))
    middle = found.line_end.sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    along_axis = middle @ vp.settings.T_mount_camera.matrix()[:3, 2]

    def off_square(lines: np.ndarray) -> np.ndarray:
        """Angles (3,) off square [deg] by the lines with these indices."""
        own = [lines[found.line_direction[lines] == k] for k in range(len(found.direction))]
        d = [
            _by_own_lines(found.line_normal[mine], middle[mine], found.line_sigma_rad[mine], extent_rad[mine], start)
            for mine, start in zip(own, found.direction, strict=True)
        ]
        d = [own * np.sign(own @ start) for own, start in zip(d, found.direction, strict=True)]
        return np.array([90.0 - math.degrees(math.acos(d[i] @ d[j])) for i in range(len(d)) for j in range(i)])

    texts, rng = [], np.random.default_rng(0)
    for limit_deg in (180.0, 80.0, 70.0):
        used = np.flatnonzero(along_axis > math.cos(math.radians(limit_deg)))
        sigma = np.std([off_square(rng.choice(used, len(used))) for _ in range(200)], axis=0)
        angles = ", ".join(f"{abs(a):.2f} (sigma {s:.2f})" for a, s in zip(off_square(used), sigma, strict=True))
        numbers = np.bincount(found.line_direction[used] + 1)[1:]
        texts.append(f"within {limit_deg:.0f} deg of the axis, {numbers} lines, {angles}")
    sigma = ", ".join(f"{s:.2f}" for s in np.degrees(found.sigma_rad))
    return f"corridor: off a right angle, each direction by its own lines {'; '.join(texts)} deg; sigma {sigma} deg"


def _by_own_lines(
    normal: np.ndarray, middle: np.ndarray, sigma_rad: np.ndarray, extent_rad: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """The direction (3,) of lines (m, 3) alone, with errors and weights as in the stage (stages/vp/directions.py)."""
    tangent, d, full = np.cross(normal, middle), start, np.minimum(extent_rad / FULL_WEIGHT_RAD, 1.0)
    for _ in range(20):
        spread = np.hypot(sigma_rad * (tangent @ d), math.radians(LINE_SIGMA_DEG))
        weight = full / (spread**2 + (normal @ d / CAUCHY) ** 2)
        d = np.linalg.eigh((normal * weight[:, None]).T @ normal)[1][:, 0]
    return d


if __name__ == "__main__":
    main()
