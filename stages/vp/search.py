"""The search for structure in lines: the vertical, the horizontal pairs, or a reason why there is none.

Irregular lines, such as branches in a park, fit every direction a little, so each result must stand out significantly.

Source: ours, for P IV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.vp.directions import PARTS, all_directions, parts_of, upright, without
from stages.kernels.vp.spectrum import APART_RAD
from stages.messages import WeightedAnswers
from stages.vp.directions import Lines, Structure, assign, jackknife, refine, residual_sigma
from stages.vp.rivals import Rivals, compare
from stages.vp.spectrum import pair_support, peaks, wrap_90deg, yaw_spectrum
from stages.vp.verticals import propose_verticals, refine_vertical

BINS = 180  # of the yaw spectrum: 0.5 deg each
PAIR_LINES = 45  # number of longest lines whose pairs propose verticals
PROPOSALS = 8
FURTHER_SCORE = 1.5  # added to `min_score` for further pairs
PEAKS = 3  # highest peaks of the yaw spectrum to refine for the first pair
DUPLICATE_RAD = math.radians(1.0)  # refined verticals nearer than this are one
TRIAL_ITERATIONS = 4
MIN_DIRECTION_LINES = 2  # of a horizontal direction
MAX_REJECTED = 3  # further pairs that are tried in vain


@dataclass(frozen=True)
class VerticalPrior:
    """Prior knowledge of the vertical."""

    up: Array64
    sigma_rad: float
    cone_rad: float  # search cone about `up`; 0: refine from `up`


@dataclass(frozen=True)
class SearchLimits:
    """Thresholds of the search; sigmas in radians."""

    sigma_model: float
    least_sigma: float
    least_scatter: float
    max_frames: int
    min_lines: int
    min_score: float
    min_direction_score: float
    min_elsewhere_score: float
    confident_direction_score: float
    confident_elsewhere_score: float
    weak_sigma: float


@dataclass(frozen=True)
class FoundDirections:
    """Directions in the layout of the message `VanishingDirections`."""

    direction: Array64
    sigma_rad: Array64
    frame: NDArray[np.int64]
    line_direction: NDArray[np.int64]
    reason: str
    answers: WeightedAnswers | None = None


def find_structure(lines: Lines, prior: VerticalPrior, limits: SearchLimits) -> FoundDirections:
    """The best upright structure of the lines; or several with weights; or no direction and the reason."""
    m = len(lines.normal)
    if m < limits.min_lines:
        return _no_directions(m, f"too few straight lines: {m}")
    starts = np.array([prior.up])
    if prior.cone_rad > 0:
        found = propose_verticals(lines, prior.up, prior.cone_rad, limits.sigma_model, PAIR_LINES, PROPOSALS)
        starts = found if len(found) else starts
    gate = math.radians(1.0) if prior.cone_rad > 0 else 2.0 * prior.sigma_rad
    verticals: list[Array64] = []
    for start in starts:
        v = refine_vertical(lines, start, prior.up, prior.sigma_rad, limits.sigma_model, gate)
        if all(abs(float(v @ other)) < math.cos(DUPLICATE_RAD) for other in verticals):
            verticals.append(v)
    pairs = sorted((p for v in verticals for p in _pairs(lines, v, prior, limits)), key=lambda p: -p.agreement)
    yaws, confident, peak = _frames(lines, pairs[0].axes, limits)
    if not yaws:
        vertical = verticals[0] if len(verticals) == 1 else pairs[0].axes[:, 2]
        return _vertical_only(lines, vertical, prior, limits, peak)
    given = prior.up, prior.sigma_rad, limits.sigma_model
    structure = refine(lines, pairs[0].axes, np.array(yaws), *given)
    rivals = compare(lines, structure.axes, [pair.axes for pair in pairs], limits.sigma_model)
    if rivals.answers:  # best first
        others = [refine(lines, pairs[k].axes, np.zeros(1), *given) for k, _ in rivals.answers]
        return _ambiguous(lines, [structure, *others], [1.0, *(weight for _, weight in rivals.answers)], limits)
    return _directions_of(lines, structure, confident, rivals, limits)


def _pairs(lines: Lines, vertical: Array64, prior: VerticalPrior, limits: SearchLimits) -> list[Structure]:
    """The vertical and one horizontal pair, refined from each of the highest peaks of the spectrum."""
    axes = upright(vertical)
    spectrum = yaw_spectrum(lines, axes, ~_along_vertical(lines, vertical, limits), limits.sigma_model, BINS)
    return [
        refine(
            lines, axes @ _about_z(yaw), np.zeros(1), prior.up, prior.sigma_rad, limits.sigma_model, TRIAL_ITERATIONS
        )
        for yaw in peaks(spectrum, PEAKS)
    ]


def _along_vertical(lines: Lines, vertical: Array64, limits: SearchLimits) -> NDArray[np.bool_]:
    return np.abs(lines.normal @ vertical) < 3.0 * residual_sigma(lines, vertical, limits.sigma_model)


def _frames(lines: Lines, axes: Array64, limits: SearchLimits) -> tuple[list[float], list[bool], float]:
    """Yaws of the significant horizontal pairs relative to `axes`, the axes of the best pair.

    Also returns whether each is confident, and the score of the first. A further pair must be significant without the
    lines of any 90 deg of azimuth, in which a board, a car or a shelf lies; and each of its directions by itself: an
    object such as a shadow edge has one direction only. One that is less so is weak: not confident, but kept. The first
    pair is weak as well if another one is confident: alone it may be one facade, beside another it may be a board.
    """
    free = ~_along_vertical(lines, axes[:, 2], limits)
    yaws: list[float] = []
    confident: list[bool] = []
    rejected: list[float] = []
    first_score = 0.0
    while len(yaws) < limits.max_frames and len(rejected) < MAX_REJECTED:
        spectrum = yaw_spectrum(lines, axes, free, limits.sigma_model, BINS)
        allowed = np.ones(BINS, dtype=np.bool_)
        for yaw in yaws + rejected:
            allowed &= np.abs(wrap_90deg(spectrum.yaw_rad - yaw)) > APART_RAD
        if not yaws:  # the first pair lies along the given axes
            allowed = np.abs(wrap_90deg(spectrum.yaw_rad)) < APART_RAD / 2
        peak = int(np.argmax(np.where(allowed, spectrum.score, -np.inf)))
        yaw, score = float(spectrum.yaw_rad[peak]) if yaws else 0.0, float(spectrum.score[peak])
        first_score = first_score if yaws else score
        if score < limits.min_score + (FURTHER_SCORE if yaws else 0.0):
            break
        near = _near(lines, axes, yaw, limits) & free
        if near.sum() < limits.min_lines * (1.5 if yaws else 1.0):
            break
        direction, elsewhere = pair_support(lines, axes, free, limits.sigma_model, yaw)
        if not yaws or (direction >= limits.min_direction_score and elsewhere >= limits.min_elsewhere_score):
            yaws.append(yaw)
            confident.append(
                direction >= limits.confident_direction_score and elsewhere >= limits.confident_elsewhere_score
            )
        else:
            rejected.append(yaw)
        free = free & ~near
    if yaws and not any(confident):
        confident[0] = True
    return yaws, confident, first_score


def _near(lines: Lines, axes: Array64, yaw: float, limits: SearchLimits) -> NDArray[np.bool_]:
    directions = all_directions(axes, np.array([yaw]))[1:]
    return assign(lines, directions, 2.0 * limits.sigma_model)[0] >= 0


def _directions_of(
    lines: Lines, s: Structure, confident: list[bool], rivals: Rivals, limits: SearchLimits
) -> FoundDirections:
    """The directions that have lines.

    Sigmas by the larger of information matrix and jackknife, with the rivals and `least_sigma`.
    """
    directions = all_directions(s.axes, s.yaw_rad)
    counts = np.bincount(s.assigned[s.assigned >= 0], minlength=len(directions))
    local = directions @ s.axes
    sigma = np.hypot(_sigmas_of(lines, s, local, limits), np.sqrt(rivals.variance_rad2(local)))
    rows: list[Array64] = []
    sigmas: list[float] = []
    frames: list[int] = []
    number = np.full(len(directions), -1, dtype=np.int64)
    for k, d in enumerate(directions):
        f = (k - 1) // 2 if k else -1
        in_frame = counts[1 + 2 * f] + counts[2 + 2 * f] if k else counts[0]
        if k and (counts[k] < MIN_DIRECTION_LINES or in_frame < limits.min_lines):
            continue  # the vertical is kept: horizontal lines determine it as well
        number[k] = len(rows)
        rows.append(d)
        frames.append(f)
        sigmas.append(
            math.hypot(float(sigma[k]), limits.least_sigma, 0.0 if f < 0 or confident[f] else limits.weak_sigma)
        )
    line_direction = np.where(s.assigned >= 0, number[s.assigned], -1)
    if not rows:
        return _no_directions(len(lines.normal), "no direction has enough lines after refinement")
    pairs = len({f for f in frames if f >= 0})
    weak = len({f for f in frames if f >= 0 and not confident[f]})
    which = f" ({weak} weak)" if weak else ""
    reason = f"{pairs} horizontal frame{'s' if pairs != 1 else ''}{which}, {int((line_direction >= 0).sum())} lines"
    return FoundDirections(np.array(rows), np.array(sigmas), np.array(frames, dtype=np.int64), line_direction, reason)


def _sigmas_of(lines: Lines, s: Structure, local: Array64, limits: SearchLimits) -> list[float]:
    """Sigma per axis of directions (k, 3) in the axes of a structure, by its residuals or a jackknife."""
    cov: Array64 = np.linalg.inv(s.information).astype(np.float64) * max(s.scatter, limits.least_scatter) ** 2
    return _sigmas(np.array([cov, jackknife(lines, s, limits.sigma_model)]), local)


def _sigmas(cov: Array64, local: Array64) -> list[float]:
    """Largest one-axis sigma of each direction (k, 3), in frame 0's axes, by covariances (c, n, n) of the unknowns.

    d -> d + omega x d, omega in frame 0's axes; the yaw of a further frame is added to its third.
    """
    A = np.zeros((len(local), 3, cov.shape[1]))
    A[:, range(3), range(3)] = 1.0
    for k in range(3, len(local)):
        A[k, 2, 2 + (k - 1) // 2] = 1.0
    turn = A @ cov[:, None] @ A.transpose(0, 2, 1)
    about = (turn @ local[:, :, None])[..., 0]
    squares = (turn[..., 0, 0] + turn[..., 1, 1] + turn[..., 2, 2] - (about * local).sum(axis=2)) / 2
    return np.sqrt(np.maximum(squares, 0.0)).max(axis=0).tolist()  # a rotation about d does not change d


def _vertical_only(
    lines: Lines, v: Array64, prior: VerticalPrior, limits: SearchLimits, peak: float
) -> FoundDirections:
    near = _along_vertical(lines, v, limits)
    reason = f"no horizontal structure: best score {peak:.1f} sigma, required {limits.min_score:g}"
    if near.sum() < limits.min_lines or prior.cone_rad > 0:
        return _no_directions(len(near), reason)
    axes = upright(v)
    spread = residual_sigma(lines, v, limits.sigma_model)[near]
    J, r = lines.normal[near] @ axes[:, :2] / spread[:, None], lines.normal[near] @ v / spread
    weighted = J.T * lines.weight[near]
    H = weighted @ J + np.eye(2) / prior.sigma_rad**2
    part = parts_of(lines.normal[near], lines.tangent[near], axes)
    inside = [part == k for k in range(PARTS)]
    if near.sum() - max(own.sum() for own in inside) < limits.min_lines:
        return _no_directions(len(near), f"{reason}; the upright lines are in one part of the image")
    steps = [without(H, weighted[:, own] @ J[own], weighted[:, own] @ r[own]) for own in inside]
    by_parts = (PARTS - 1) / PARTS * float(np.square(steps).sum()) / 2
    sigma = math.hypot(math.sqrt(max(float(np.trace(np.linalg.inv(H))) / 2, by_parts)), limits.least_sigma)
    if sigma > prior.sigma_rad:
        return _no_directions(len(near), f"{reason}; parts of the upright lines disagree")
    none = np.array([-1], dtype=np.int64)
    return FoundDirections(v[None], np.array([sigma]), none, np.where(near, 0, -1).astype(np.int64), reason)


def _ambiguous(lines: Lines, found: list[Structure], weights: list[float], limits: SearchLimits) -> FoundDirections:
    """No single answer: structures with their weights, each with its vertical and its first horizontal pair."""
    z = np.array([[0.0, 0.0, 1.0]])
    sigmas: list[float] = []
    for s in found:
        (sigma,) = _sigmas_of(lines, s, z, limits)
        sigmas.append(math.hypot(sigma, limits.least_sigma))
    answers = WeightedAnswers(
        up=np.array([s.axes[:, 2] for s in found]),
        sigma_rad=np.array(sigmas),
        probability=np.array(weights) / sum(weights),
        line_direction=np.array([np.where(s.assigned < 3, s.assigned, -1) for s in found], dtype=np.int64),
    )
    reason = f"ambiguous: {len(found)} verticals fit the lines about equally well; connect an attitude"
    return replace(_no_directions(len(lines.normal), reason), answers=answers)


def _no_directions(m: int, reason: str) -> FoundDirections:
    return FoundDirections(
        np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.int64), np.full(m, -1, dtype=np.int64), reason
    )


def _about_z(angle: float) -> Array64:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
