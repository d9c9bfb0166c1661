"""The trained model: log-odds that a candidate is a drone, against four alternatives.

    log_odds = -ln sum_k exp(-o_k),    o_k = prior_k + sum_j g_kj(x_j)

o_k are the log-odds of a drone over alternative k: a false return, a static object, a bird, a balloon. Each g_kj is a
piecewise linear function of one feature, given by its values at knots, constant beyond the first and the last one, and
monotone where `features.py` says so. A missing feature (NaN) adds `missing`. A drone must be more probable than every
alternative, so the evidence against one of them never replaces that against another.

`grd train-detector` writes the file (links/training); its command, data and scores are in it.

Source: ours; Hastie, Tibshirani, "Generalized Additive Models", Stat. Sci. 1 (1986), in a multinomial of alternatives.
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flow.stage import StrictModel
from stages.detect.candidate import Alternative
from stages.detect.trained.features import FEATURES, NAMES, TELEMETRY, VERSION
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarModel
from stages.kernels.detect.model import ModelTables, evaluate

ALTERNATIVES = tuple(Alternative)
REASONS = 3  # contributions named for people
LEAST_NATS = 0.1  # contributions below are not named


class Prediction(NamedTuple):
    """The model's result for a candidate."""

    log_odds: float  # of a drone
    alternative: int  # the most probable one, an index of ALTERNATIVES
    contributions: Array64  # (features,) of each feature to log_odds [nats]


class Term(StrictModel):
    """g_kj of one alternative and one feature."""

    alternative: int = Field(ge=0, lt=len(ALTERNATIVES))
    feature: str
    knots: tuple[float, ...] = Field(min_length=2)
    values: tuple[float, ...] = Field(min_length=2)  # [nats] at the knots
    missing: float = 0.0

    @model_validator(mode="after")
    def _is_a_function(self) -> Term:
        if self.feature not in NAMES:
            raise ValueError(f"there is no feature '{self.feature}'")
        if len(self.knots) != len(self.values) or any(b <= a for a, b in pairwise(self.knots)):
            raise ValueError(f"{self.feature}: knots must rise and have one value each")
        return self


class DetectorModel(StrictModel):
    """The weights file."""

    feature_version: int
    lidar_model: LidarModel = "VLP-16"  # of the runs
    priors: tuple[tuple[float, float], ...]  # of each alternative, without and with telemetry [nats]
    terms: tuple[Term, ...] = Field(min_length=1)
    trained: dict[str, Any] = {}  # command, data, versions, held-out scores: for people

    @model_validator(mode="after")
    def _fits_these_features(self) -> DetectorModel:
        if self.feature_version != VERSION:
            raise ValueError(
                f"the model has feature version {self.feature_version}, this grd has {VERSION}: "
                "train it again with `grd train-detector`"
            )
        if len(self.priors) != len(ALTERNATIVES):
            raise ValueError(f"priors: there are {len(ALTERNATIVES)} alternatives")
        return self

    def tables(self, compared: bool) -> ModelTables:
        """The model of a candidate that is compared with telemetry or not, as compiled functions take it."""
        return ModelTables(*self._terms, self._priors[int(compared)])

    @cached_property
    def _terms(self) -> tuple[NDArray[np.int64], Array64, Array64, Array64]:
        """(alternative, feature, knots) (terms, 3); knots, values (terms, most); missing (terms,)."""
        most = max(len(term.knots) for term in self.terms)
        where = [(term.alternative, NAMES.index(term.feature), len(term.knots)) for term in self.terms]
        knots, values = (np.zeros((len(self.terms), most)) for _ in range(2))
        for row, term in enumerate(self.terms):
            knots[row, : len(term.knots)], values[row, : len(term.knots)] = term.knots, term.values
        return np.array(where, dtype=np.int64), knots, values, np.array([term.missing for term in self.terms])

    @cached_property
    def _priors(self) -> tuple[Array64, Array64]:
        """Of each alternative (alternatives,), without and with telemetry."""
        without, compared = np.array(self.priors).T.copy()
        return without, compared

    def predict(self, features: Array64) -> Prediction:
        """Log-odds of a drone for features (len(FEATURES),)."""
        return Prediction(*evaluate(self.tables(not math.isnan(features[TELEMETRY])), features))


def reasons_of(features: Array64, prediction: Prediction) -> str:
    """The largest contributions as text, with the values of their features, and what it is if not a drone."""
    order: list[int] = np.argsort(-np.abs(prediction.contributions), kind="stable")[:REASONS].tolist()
    nats = {k: float(prediction.contributions[k]) for k in order if abs(prediction.contributions[k]) >= LEAST_NATS}
    reasons = [_reason(FEATURES[k].text, float(features[k]), value) for k, value in nats.items()]
    return "; ".join([*reasons, f"if not a drone: {ALTERNATIVES[prediction.alternative].value}"])


def _reason(text: str, value: float, nats: float) -> str:
    known = "not known" if math.isnan(value) else f"{value:.3g}"
    return f"{text}: {known} ({nats:+.1f})"
