"""Fits the detector's model to candidate rows and scores it on others.

Penalised maximum likelihood over the values at the knots, which are quantiles of the training data. The penalty pulls
to the prior knowledge: log likelihood ratios of the telemetry count as they are, in part, since their observations err
together; everything else counts nothing until the data show it. Its strength is chosen by the log loss on flights that
were left out, since the rows of one flight are not independent. The range is not used: its effect would be that of the
ranges at which the training flights have drones.

Source: grd; Wood, Generalized Additive Models (2017), 5.3 (penalised linear splines); SciPy's L-BFGS-B.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from flow.link import LinkError
from links.evaluation.errors import brier_and_log_loss
from links.evaluation.stage_metrics import SCORE_RANGES_M
from links.training.candidates import CandidateRows
from stages.detect.trained.features import FEATURES, NAMES, TELEMETRY, VERSION
from stages.detect.trained.model import ALTERNATIVES, DetectorModel, Term
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarModel

KNOTS = 6
LEAST_KNOWN = 50  # rows that have a feature, to use it
LLR_KNOTS = (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0)  # [nats] of features that are log likelihood ratios
# assumed: the part of each log likelihood ratio that counts before the data show it
LLR_SHARE = {
    "displaced_nats": 0.8, "over_bird_nats": 0.9, "over_balloon_nats": 0.9, "return_count_nats": 0.5,
    "imu_over_static_nats": 0.5, "imu_over_bird_nats": 0.5, "imu_over_balloon_nats": 0.5,
}  # fmt: skip
PRIOR_PENALTY = 0.02  # assumed; of the priors, relative to the other parameters
STRENGTHS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # of the penalty
FOLDS = 5
EASY_SHARE = 0.05  # assumed; of the single observations without telemetry that are used; they are most of all rows
OF_FLIERS = (  # size, and open air around it: tell a drone from a bird or balloon, too
    "return_ratio", "return_count_nats", "free_sectors", "least_free", "isolated_score", "neighbour_score",
)  # fmt: skip
USED: tuple[tuple[str, ...], ...] = (  # features of each alternative
    (
        "existence_nats", "false_per_s", "scan_passes", "first_returns", "return_ratio", "neighbour_score",
    ),
    (
        "scan_passes", "return_count_nats", "free_sectors", "least_free", "neighbour_score", "isolated_score",
        "large_object_m", "large_object_share", "too_long_share", "straight_sigmas", "moves", "near_rejected",
        "revisited", "displaced_nats", "passes_since_reacquired", "imu_over_static_nats",
    ),
    (
        *OF_FLIERS, "top_mps", "relative_speed_mps", "acceleration_mps2", "fastest_mps", "hardest_mps2", "calm_s",
        "over_bird_nats", "imu_over_bird_nats",
    ),
    (*OF_FLIERS, "rough_share", "straight_mps", "over_balloon_nats", "imu_over_balloon_nats"),
)  # fmt: skip


@dataclass(frozen=True)
class Score:
    """Scores of probabilities in a range band, with telemetry or without."""

    band: str
    rows: int
    drones: int
    brier: float
    log_loss: float


@dataclass(frozen=True, eq=False)
class _Column:
    """One parameter: a ramp from `low` to `high` of a feature, its missing flag (low NaN), or a prior (no feature)."""

    alternative: int
    feature: str
    low: float  # of a prior: 1 with telemetry, 0 without
    high: float
    sign: int
    mean: float  # to which the penalty pulls it


def train(
    rows: CandidateRows,
    trained: dict[str, Any],
    left_out: Sequence[str] = (),
    lidar_model: LidarModel = "VLP-16",
    start: DetectorModel | None = None,
    strengths: Sequence[float] | None = None,
) -> DetectorModel:
    """The model of these rows, of runs with this LiDAR. `left_out`: features that it does not use (ablation).

    `start`: a model of other rows; the penalty pulls to its weights. `strengths`: of the penalty, to choose from (None:
    STRENGTHS).
    """
    if min(rows.is_drone.sum(), (~rows.is_drone).sum()) < 100 or len(np.unique(rows.recording)) < 2:
        raise LinkError("training needs at least 100 rows of drones, 100 of others, and two recordings")
    easy = ~rows.is_drone & ~rows.with_telemetry & (rows.feature("scan_passes") <= 1)
    kept = ~easy | (np.random.default_rng(0).uniform(size=len(easy)) < EASY_SHARE)
    weight = np.where(easy, 1.0 / EASY_SHARE, 1.0)[kept]
    columns = _columns(rows.take(kept), left_out, start)
    A, y = _design(rows.X[kept], columns), rows.is_drone[kept]
    fold = rows.recording[kept] % FOLDS
    strengths = strengths or STRENGTHS
    several = strengths if len(strengths) > 1 else ()
    losses = {strength: _left_out_loss(A, y, weight, fold, columns, strength) for strength in several}
    strength = min(losses, key=lambda s: losses[s]) if losses else strengths[0]
    theta = _fitted(A, y, weight, columns, strength)
    trained["strength"], trained["left_out_log_loss"] = strength, {s: round(v, 5) for s, v in losses.items()}
    return _model(columns, theta, trained, lidar_model)


def predicted(model: DetectorModel, rows: CandidateRows) -> Array64:
    """Probabilities (n,) by the model."""
    return 1.0 / (1.0 + np.exp(-np.array([model.predict(x).log_odds for x in rows.X])))


def scores(rows: CandidateRows, probability: Array64) -> list[Score]:
    """Brier score and log loss [nats] by range band, with and without telemetry."""
    found: list[Score] = []
    for telemetry in (True, False):
        for low, high in pairwise(SCORE_RANGES_M):
            here = (rows.with_telemetry == telemetry) & (rows.feature("range_m") >= low)
            here &= rows.feature("range_m") < high
            if here.any():
                name = f"{low:.0f} to {high:.0f} m, {'with' if telemetry else 'without'} telemetry"
                drones = int(rows.is_drone[here].sum())
                found.append(
                    Score(name, int(here.sum()), drones, *brier_and_log_loss(probability[here], rows.is_drone[here]))
                )
    return found


def _columns(rows: CandidateRows, left_out: Sequence[str], start: DetectorModel | None) -> list[_Column]:
    """The parameters, with knots at quantiles of the drones and three times as many other rows, or those of `start`."""
    rng, others = np.random.default_rng(0), np.nonzero(~rows.is_drone)[0]
    drones = np.nonzero(rows.is_drone)[0]
    some = np.concatenate([drones, rng.choice(others, min(3 * len(drones), len(others)), replace=False)])
    before = {(t.alternative, t.feature): t for t in start.terms} if start is not None else {}
    columns: list[_Column] = []
    for alternative, names in enumerate(USED):
        for with_telemetry in (0, 1):
            mean = 2.0 * with_telemetry if start is None else start.priors[alternative][with_telemetry]
            columns.append(_Column(alternative, "", float(with_telemetry), float(with_telemetry), 0, mean))
        for name in names:
            if name in left_out:
                continue
            term = before.get((alternative, name))
            columns += _of_term(term) if term is not None else _new_term(alternative, name, rows, some)
    return columns


def _new_term(alternative: int, name: str, rows: CandidateRows, some: NDArray[np.int64]) -> list[_Column]:
    """The parameters of a feature, by its values in `some` rows; none where it is hardly ever known."""
    x, share = rows.feature(name)[some], LLR_SHARE.get(name, 0.0)
    known = x[~np.isnan(x)]
    if len(known) < LEAST_KNOWN:
        return []
    knots = np.array(LLR_KNOTS) if name in LLR_SHARE else np.unique(_rounded(np.quantile(known, _levels())))
    sign = FEATURES[NAMES.index(name)].monotone
    ramps = [_Column(alternative, name, a, b, sign, share * (b - a)) for a, b in pairwise(knots.tolist())]
    return ramps + _missing(alternative, name, 0.0)


def _of_term(term: Term) -> list[_Column]:
    """The parameters of a term of the model to start from."""
    sign, name = FEATURES[NAMES.index(term.feature)].monotone, term.feature
    steps = zip(pairwise(term.knots), pairwise(term.values), strict=True)
    ramps = [_Column(term.alternative, name, a, b, sign, after - value) for (a, b), (value, after) in steps]
    return ramps + _missing(term.alternative, name, term.missing)


def _missing(alternative: int, name: str, mean: float) -> list[_Column]:
    """The parameter of a missing feature; a log likelihood ratio that is missing is no evidence."""
    if name.endswith("_nats"):
        return []
    return [_Column(alternative, name, np.nan, np.nan, 0, mean)]


def _levels() -> Array64:
    return np.linspace(0.02, 0.98, KNOTS)


def _rounded(values: Array64) -> Array64:
    return np.array([float(f"{value:.4g}") for value in values])


def _design(X: Array64, columns: Sequence[_Column]) -> list[NDArray[np.float32]]:
    """The design matrix (n, parameters) of each alternative. Ramps of ratios below 0 are -1 to 0: 0 is no evidence."""
    with_telemetry = ~np.isnan(X[:, TELEMETRY])
    found: list[NDArray[np.float32]] = []
    for alternative in range(len(ALTERNATIVES)):
        parts: list[Array64] = []
        for c in columns:
            if c.alternative != alternative:
                continue
            if not c.feature:
                parts.append((with_telemetry == (c.low == 1.0)).astype(np.float64))
                continue
            x = X[:, NAMES.index(c.feature)]
            missing = np.isnan(x)
            if np.isnan(c.low):
                parts.append(missing.astype(np.float64))
            else:
                ramp = np.clip((np.where(missing, 0.0, x) - c.low) / (c.high - c.low), 0.0, 1.0) - _start(c)
                parts.append(np.where(missing, 0.0, ramp))
        found.append(np.column_stack(parts).astype(np.float32))
    return found


def _start(c: _Column) -> float:
    """Value of a ramp that counts as no evidence."""
    return 1.0 if c.feature.endswith("_nats") and c.high <= 0.0 else 0.0


def _over(A: list[NDArray[np.float32]], theta: Array64) -> Array64:
    """Log-odds (n, alternatives) of a drone over each alternative."""
    parts = np.split(theta.astype(np.float32), np.cumsum([a.shape[1] for a in A])[:-1])
    return np.column_stack([a @ part for a, part in zip(A, parts, strict=True)]).astype(np.float64)


def _total(over: Array64) -> tuple[Array64, Array64]:
    """Log-odds (n,) of a drone, and the probability (n, alternatives) of each alternative among them."""
    least = over.min(axis=1, keepdims=True)
    weight = np.exp(least - over)
    return least[:, 0] - np.log(weight.sum(axis=1)), weight / weight.sum(axis=1, keepdims=True)


def _loss(log_odds: Array64, y: NDArray[np.bool_]) -> Array64:
    return np.logaddexp(0.0, np.where(y, -log_odds, log_odds))


def _fitted(
    A: list[NDArray[np.float32]], y: NDArray[np.bool_], weight: Array64, columns: Sequence[_Column], strength: float
) -> Array64:
    mean = np.array([c.mean for c in columns])
    penalty = strength * np.array([1.0 if c.feature else PRIOR_PENALTY for c in columns])

    def objective(theta: Array64) -> tuple[float, Array64]:
        log_odds, share = _total(_over(A, theta))
        error = ((1.0 / (1.0 + np.exp(-log_odds)) - y) * weight)[:, None] * share
        slope = np.concatenate([a.T @ error[:, k].astype(np.float32) for k, a in enumerate(A)]).astype(np.float64)
        off = theta - mean
        return float(_loss(log_odds, y) @ weight + 0.5 * (penalty * off) @ off), slope + penalty * off

    bounds = [(0.0, None) if c.sign > 0 else (None, 0.0) if c.sign < 0 else (None, None) for c in columns]
    return minimize(objective, mean, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 400}).x


def _left_out_loss(
    A: list[NDArray[np.float32]],
    y: NDArray[np.bool_],
    weight: Array64,
    fold: NDArray[np.int64],
    columns: Sequence[_Column],
    strength: float,
) -> float:
    """Log loss over folds of recordings, each by a fit to the others."""
    total = 0.0
    for k in np.unique(fold):
        own, other = fold != k, fold == k
        theta = _fitted([a[own] for a in A], y[own], weight[own], columns, strength)
        total += float(_loss(_total(_over([a[other] for a in A], theta))[0], y[other]) @ weight[other])
    return total / float(weight.sum())


def _model(
    columns: Sequence[_Column], theta: Array64, trained: dict[str, Any], lidar_model: LidarModel
) -> DetectorModel:
    priors = np.zeros((len(ALTERNATIVES), 2))
    ramps: dict[tuple[int, str], list[tuple[_Column, float]]] = {}
    missing: dict[tuple[int, str], float] = {}
    for c, value in zip(columns, theta.tolist(), strict=True):
        if not c.feature:
            priors[c.alternative, int(c.low)] = value
        elif np.isnan(c.low):
            missing[c.alternative, c.feature] = value
        else:
            ramps.setdefault((c.alternative, c.feature), []).append((c, value))
    terms: list[Term] = []
    for (alternative, feature), parts in ramps.items():
        values = np.cumsum([0.0, *(value for _, value in parts)]) - sum(_start(c) * value for c, value in parts)
        if np.abs(values).max() < 5e-4 and abs(missing.get((alternative, feature), 0.0)) < 5e-4:
            continue
        terms.append(
            Term(
                alternative=alternative,
                feature=feature,
                knots=(parts[0][0].low, *(c.high for c, _ in parts)),
                values=tuple(round(value, 4) for value in values.tolist()),
                missing=round(missing.get((alternative, feature), 0.0), 4),
            )
        )
    rounded = tuple((round(without, 4), round(with_, 4)) for without, with_ in priors.tolist())
    return DetectorModel(
        feature_version=VERSION, lidar_model=lidar_model, priors=rounded, terms=tuple(terms), trained=trained
    )
