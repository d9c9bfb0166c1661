"""York Urban, training half: 51 images of a pinhole camera, with hand-labelled lines and vanishing directions.

The published directions are the vanishing points of each group of lines, made orthogonal afterwards; these points are
up to 4 deg off square, so the published directions are off their own lines. `labelled` therefore fits one orthogonal
frame to all labelled lines of an image, each with its position error:

    minimise sum rho(n_i . R d_k(i) / sigma_i),   sigma_i^2 = (2^1/2 END_PX / length_i)^2 (t_i . d)^2 + STRAIGHT_RAD^2

with rho Cauchy. Its covariance is the larger of that of the residuals and a jackknife over the three groups.

Source: Denis, Elder and Estrada, ECCV 2008 (data set); the fit is ours.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stages.messages import Image

YORK = Path(__file__).resolve().parents[3] / "shared" / "data" / "vp_york_urban"
END_PX = 1.0  # error of a labelled end, one sigma
STRAIGHT_RAD = math.radians(0.25)  # of a line, as in the stage
CAUCHY = 1.5
NORMAL_MEDIAN2 = 0.455  # median of the square of a standard normal


@functools.cache
def york_camera() -> tuple[float, float, float]:
    """focal [px], and the principal point counted from 0."""
    tree = loadmat(YORK / "cameraParameters.mat")
    column, row = tree["pp"][0]
    return float(tree["focal"][0, 0] / tree["pixelSize"][0, 0]), float(column) - 1, float(row) - 1


def york_folders() -> list[Path]:
    """The folders of the images; empty without the data."""
    return sorted(YORK.glob("P*"))


def york_image(folder: Path) -> Image:
    """One image of York Urban."""
    grey = cv2.imread(str(folder / f"{folder.name}.jpg"), cv2.IMREAD_GRAYSCALE)
    return Image(stamp_ns=0, frame_id="camera_drone", grey=grey)


def york_truth(folder: Path) -> np.ndarray:
    """(3, 3) published directions as rows, camera frame (y down)."""
    tree = loadmat(folder / f"{folder.name}GroundTruthVP_Orthogonal_CamParams.mat")
    return tree["vp_orthogonal"].T * [1.0, -1.0, 1.0]


@dataclass(frozen=True)
class Labelled:
    """Orthogonal directions of the labelled lines."""

    direction: np.ndarray  # (3, 3) rows, camera frame
    sigma_deg: np.ndarray  # (3,) of each, along the axis in which it is known least


def labelled(folder: Path) -> Labelled:
    """The frame that fits the labelled lines of an image best, from the published one on."""
    tree = loadmat(folder / f"{folder.name}LinesAndVP.mat")
    focal, column, row = york_camera()
    ends = (tree["lines"] - 1.0).reshape(-1, 2, 2)
    group = tree["vp_association"].ravel() - 1
    rays = np.dstack([(ends[..., 0] - column) / focal, (ends[..., 1] - row) / focal, np.ones(ends.shape[:2])])
    normal = np.cross(rays[:, 0], rays[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle = rays.sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    tangent = np.cross(normal, middle)
    sigma = math.sqrt(2.0) * END_PX / np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    start = york_truth(folder)

    def fit(used: np.ndarray, turn: np.ndarray):
        def residuals(turn: np.ndarray) -> np.ndarray:
            d = (start @ Rotation.from_rotvec(turn).as_matrix().T)[group[used]]
            spread = np.hypot(sigma[used] * (tangent[used] * d).sum(axis=1), STRAIGHT_RAD)
            return (normal[used] * d).sum(axis=1) / spread

        return least_squares(residuals, turn, loss="cauchy", f_scale=CAUCHY)

    whole = fit(np.ones(len(group), dtype=bool), np.zeros(3))
    scatter2 = max(float(np.median(whole.fun**2)) / NORMAL_MEDIAN2, 1.0)
    groups = [g for g in range(3) if (group == g).any()]
    steps = [fit(group != g, whole.x).x - whole.x for g in groups] if len(groups) == 3 else []
    covariances = [np.linalg.inv(whole.jac.T @ whole.jac) * scatter2]
    covariances.append(sum((np.outer(step, step) for step in steps), np.zeros((3, 3))) * 2.0 / 3.0)
    direction = start @ Rotation.from_rotvec(whole.x).as_matrix().T
    return Labelled(direction, np.max([[_sigma_deg(cov, d) for d in direction] for cov in covariances], axis=0))


def _sigma_deg(covariance: np.ndarray, direction: np.ndarray) -> float:
    """Largest one-axis sigma of a direction by the covariance (3, 3) of the rotation."""
    across = np.eye(3) - np.outer(direction, direction)
    return math.degrees(math.sqrt(max(float(np.linalg.eigvalsh(across @ covariance @ across)[-1]), 0.0)))
