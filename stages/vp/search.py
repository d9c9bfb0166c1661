"""The search for structure: which vertical, how many horizontal pairs, and whether there is anything at all.

Source: ours, for P IV; "no structure here" is an answer: a park's branches fit any direction a little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.vp.directions import all_directions, upright
from stages.kernels.vp.spectrum import APART_RAD
from stages.vp.directions import Lines, Structure, assign, refine, residual_sigma
from stages.vp.spectrum import peaks, quarter, yaw_spectrum
from stages.vp.verticals import propose_verticals, refine_vertical

BINS = 180  # of the yaw spectrum: half a degree
PAIR_LINES = 45  # proposals for the vertical come from so many of the widest lines
PROPOSALS = 8
FURTHER_SCORE = 1.5  # a second pair has to stand out by so much more
PEAKS = 3  # of the yaw spectrum are tried for the first pair
NEARLY_RAD = math.radians(1.0)  # two starts nearer than this come to the same
TRIAL_ROUNDS = 4
SAME_RAD = math.radians(3.0)  # two verticals nearer than this are one
RIVAL_SHARE = 0.85  # of the best vertical's agreement: another one as good means that none is sure
MIN_EXTRA = 2  # lines that a direction needs to be told


@dataclass(frozen=True)
class Prior:
    """What is known of the vertical before the picture is looked at."""

    up: Array64
    sigma_rad: float
    cone_rad: float  # 0: it is near enough to start from


@dataclass(frozen=True)
class Limits:
    """When something counts."""

    sigma_model: float
    least_sigma: float
    least_scatter: float
    max_frames: int
    min_lines: int
    min_score: float


@dataclass(frozen=True)
class Found:
    """Directions as the message wants them."""

    direction: Array64
    sigma_rad: Array64
    frame: NDArray[np.int64]
    line_direction: NDArray[np.int64]
    reason: str


def find_structure(lines: Lines, prior: Prior, limits: Limits) -> Found:
    """The best upright structure of the lines, or none and why."""
    m = len(lines.normal)
    if m < limits.min_lines:
        return _nothing(m, f"{m} straight lines: too few")
    starts = np.array([prior.up])
    if prior.cone_rad > 0:
        found = propose_verticals(lines, prior.up, prior.cone_rad, limits.sigma_model, PAIR_LINES, PROPOSALS)
        starts = found if len(found) else starts
    gate = math.radians(1.0) if prior.cone_rad > 0 else 2.0 * prior.sigma_rad
    verticals: list[Array64] = []
    for start in starts:
        v = refine_vertical(lines, start, prior.up, prior.sigma_rad, limits.sigma_model, gate)
        if all(abs(float(v @ other)) < math.cos(NEARLY_RAD) for other in verticals):
            verticals.append(v)
    pairs = sorted((_best_pair(lines, v, prior, limits) for v in verticals), key=lambda p: -p.agreement)
    for other in pairs[1:]:
        apart = abs(float(other.axes[:, 2] @ pairs[0].axes[:, 2])) < math.cos(SAME_RAD)
        if apart and other.agreement > RIVAL_SHARE * pairs[0].agreement:
            return _nothing(m, "two verticals fit the lines about as well: an attitude would decide")
    yaws, peak = _frames(lines, pairs[0].axes, limits)
    if not yaws:
        vertical = verticals[0] if len(verticals) == 1 else pairs[0].axes[:, 2]
        return _vertical_only(lines, vertical, prior, limits, peak)
    structure = refine(lines, pairs[0].axes, np.array(yaws), prior.up, prior.sigma_rad, limits.sigma_model)
    return _told(lines, structure, limits)


def _best_pair(lines: Lines, vertical: Array64, prior: Prior, limits: Limits) -> Structure:
    """The vertical and one horizontal pair, refined from each of the spectrum's highest peaks: the best of them."""
    axes = upright(vertical)
    spectrum = yaw_spectrum(lines, axes, ~_along_vertical(lines, vertical, limits), limits.sigma_model, BINS)
    found = [
        refine(lines, axes @ _about_z(yaw), np.zeros(1), prior.up, prior.sigma_rad, limits.sigma_model, TRIAL_ROUNDS)
        for yaw in peaks(spectrum, PEAKS)
    ]
    return max(found, key=lambda s: s.agreement)


def _along_vertical(lines: Lines, vertical: Array64, limits: Limits) -> NDArray[np.bool_]:
    return np.abs(lines.normal @ vertical) < 3.0 * residual_sigma(lines, vertical, limits.sigma_model)


def _frames(lines: Lines, axes: Array64, limits: Limits) -> tuple[list[float], float]:
    """Yaws of all horizontal pairs against the best one, whose axes are given; none when nothing stands out.

    Also how high the highest peak of the spectrum was.
    """
    free = ~_along_vertical(lines, axes[:, 2], limits)
    yaws: list[float] = []
    highest = 0.0
    for _ in range(limits.max_frames):
        spectrum = yaw_spectrum(lines, axes, free, limits.sigma_model, BINS)
        apart = np.ones(BINS, dtype=np.bool_)
        for yaw in yaws:
            apart &= np.abs(quarter(spectrum.yaw_rad - yaw)) > APART_RAD
        if not yaws:  # it is the frame's own axes, or nothing
            apart = np.abs(quarter(spectrum.yaw_rad)) < APART_RAD / 2
        peak = int(np.argmax(np.where(apart, spectrum.score, -np.inf)))
        highest = max(highest, float(spectrum.score[peak]))
        near = _near(lines, axes, float(spectrum.yaw_rad[peak]) if yaws else 0.0, limits) & free
        more = FURTHER_SCORE if yaws else 0.0
        if spectrum.score[peak] < limits.min_score + more or near.sum() < limits.min_lines * (1.5 if yaws else 1.0):
            break
        yaws.append(float(spectrum.yaw_rad[peak]) if yaws else 0.0)
        free = free & ~near
    return yaws, highest


def _near(lines: Lines, axes: Array64, yaw: float, limits: Limits) -> NDArray[np.bool_]:
    directions = all_directions(axes, np.array([yaw]))[1:]
    return assign(lines, directions, 2.0 * limits.sigma_model)[0] >= 0


def _told(lines: Lines, s: Structure, limits: Limits) -> Found:
    """Directions with lines of their own; sigma by the information, no smaller than the floor."""
    directions = all_directions(s.axes, s.yaw_rad)
    counts = np.bincount(s.assigned[s.assigned >= 0], minlength=len(directions))
    cov: Array64 = np.linalg.inv(s.information).astype(np.float64) * max(s.scatter, limits.least_scatter) ** 2
    rows: list[Array64] = []
    sigmas: list[float] = []
    frames: list[int] = []
    number = np.full(len(directions), -1, dtype=np.int64)
    for k, d in enumerate(directions):
        f = (k - 1) // 2 if k else -1
        in_frame = counts[1 + 2 * f] + counts[2 + 2 * f] if k else counts[0]
        if k and (counts[k] < MIN_EXTRA or in_frame < limits.min_lines):
            continue  # the vertical is known by the horizontal ones, too
        number[k] = len(rows)
        rows.append(d)
        frames.append(f)
        sigmas.append(math.hypot(_sigma(cov, s.axes, d, f), limits.least_sigma))
    line_direction = np.where(s.assigned >= 0, number[s.assigned], -1)
    if not rows:
        return _nothing(len(lines.normal), "no direction has enough lines after refinement")
    pairs = len({f for f in frames if f >= 0})
    reason = f"{pairs} horizontal frame{'s' if pairs != 1 else ''}, {int((line_direction >= 0).sum())} lines"
    return Found(np.array(rows), np.array(sigmas), np.array(frames, dtype=np.int64), line_direction, reason)


def _sigma(cov: Array64, axes: Array64, d: Array64, frame: int) -> float:
    """One-axis sigma of a direction: d -> d + omega x d, omega in frame 0's axes, yaw added to its third."""
    A = np.zeros((3, len(cov)))
    A[:, :3] = np.eye(3)
    if frame > 0:
        A[2, 2 + frame] = 1.0
    turn = A @ cov @ A.T
    local = axes.T @ d
    return math.sqrt(max(float(turn.trace() - local @ turn @ local) / 2, 0.0))  # a turn about d moves it nowhere


def _vertical_only(lines: Lines, v: Array64, prior: Prior, limits: Limits, peak: float) -> Found:
    near = _along_vertical(lines, v, limits)
    why = f"no horizontal structure: the best direction stands out by {peak:.1f} of {limits.min_score:g} sigma"
    if near.sum() < limits.min_lines or prior.cone_rad > 0:
        return _nothing(len(near), why)
    e = upright(v)[:, :2]
    J = lines.normal[near] @ e / residual_sigma(lines, v, limits.sigma_model)[near, None]
    H = (J.T * lines.weight[near]) @ J + np.eye(2) / prior.sigma_rad**2
    spread = math.hypot(math.sqrt(float(np.trace(np.linalg.inv(H))) / 2), limits.least_sigma)
    none = np.array([-1], dtype=np.int64)
    return Found(v[None], np.array([spread]), none, np.where(near, 0, -1).astype(np.int64), why)


def _nothing(m: int, reason: str) -> Found:
    return Found(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.int64), np.full(m, -1, dtype=np.int64), reason)


def _about_z(angle: float) -> Array64:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
