"""The trained model: its functions, missing features, alternatives, contributions, and files that do not fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from stages.detect.candidate import Alternative
from stages.detect.trained.features import NAMES, VERSION
from stages.detect.trained.model import ALTERNATIVES, DetectorModel, Prediction, reasons_of

RANGE, SPEED = NAMES.index("range_m"), NAMES.index("top_mps")
FAR = {"alternative": 0, "feature": "range_m", "knots": (10.0, 20.0, 40.0), "values": (1.0, 0.0, -3.0)}
FAST = {"alternative": 2, "feature": "top_mps", "knots": (0.0, 10.0), "values": (0.0, -5.0), "missing": -1.0}


def model(*terms, **changed):
    priors = [(9.0, 9.0)] * len(ALTERNATIVES)
    return DetectorModel.model_validate({"feature_version": VERSION, "priors": priors, "terms": terms} | changed)


def features(**known):
    return np.array([known.get(name, math.nan) for name in NAMES])


def log_odds(made, **known):
    return made.predict(features(**known)).log_odds


def test_a_term_is_linear_between_its_knots_and_constant_beyond():
    only = model(FAR, priors=[(0.0, 0.0), *[(99.0, 99.0)] * 3])
    values = [log_odds(only, range_m=r) for r in (0.0, 10.0, 15.0, 20.0, 30.0, 40.0, 99.0)]
    assert values == pytest.approx([1.0, 1.0, 0.5, 0.0, -1.5, -3.0, -3.0])


def test_a_missing_feature_adds_its_own_value():
    only = model(FAST, priors=[(99.0, 99.0), (99.0, 99.0), (0.0, 0.0), (99.0, 99.0)])
    assert log_odds(only) == pytest.approx(-1.0)
    assert log_odds(only, top_mps=5.0) == pytest.approx(-2.5)


def test_a_drone_must_be_more_probable_than_all_alternatives_together():
    one = model(FAR, priors=[(2.0, 2.0), (3.0, 3.0), (4.0, 4.0), (5.0, 5.0)])
    over = np.array([2.0 + 1.0, 3.0, 4.0, 5.0])
    assert log_odds(one, range_m=5.0) == pytest.approx(-math.log(np.exp(-over).sum()))


def test_the_prior_depends_on_whether_there_is_telemetry():
    both = model(FAR, priors=[(0.0, 2.0), *[(99.0, 99.0)] * 3])
    assert log_odds(both, range_m=20.0) == pytest.approx(0.0)
    assert log_odds(both, range_m=20.0, over_static_nats=1.0) == pytest.approx(2.0)


def test_contributions_are_weighted_by_the_probability_of_their_alternative():
    two = model(FAR, FAST, priors=[(0.0, 0.0), (99.0, 99.0), (0.0, 0.0), (99.0, 99.0)])
    prediction = two.predict(features(range_m=40.0, top_mps=10.0))
    share = math.exp(5.0) / (math.exp(3.0) + math.exp(5.0))
    assert ALTERNATIVES[prediction.alternative] is Alternative.BIRD
    assert prediction.contributions[[RANGE, SPEED]] == pytest.approx([-3.0 * (1 - share), -5.0 * share])
    assert np.count_nonzero(prediction.contributions) == 2


def test_the_reasons_are_the_largest_contributions_with_their_values():
    contributions = np.zeros(len(NAMES))
    contributions[[RANGE, SPEED]] = 0.5, -2.0
    text = reasons_of(features(range_m=12.5), Prediction(-1.0, 2, contributions))
    assert text == "speed that it reaches, with its turn: not known (-2.0); range: 12.5 (+0.5); if not a drone: a bird"


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"feature_version": VERSION + 1}, "train it again with `grd train-detector`"),
        ({"priors": [(0.0, 0.0)]}, "4 alternatives"),
        ({"priors": [(math.nan, 0.0)] * 4}, "priors"),
        ({"terms": []}, "terms"),
        ({"terms": [FAR | {"feature": "luck"}]}, "no feature 'luck'"),
        ({"terms": [FAR | {"knots": (1.0, 1.0, 2.0)}]}, "knots must rise"),
        ({"terms": [FAR | {"values": (1.0, 2.0)}]}, "one value each"),
        ({"terms": [FAR | {"alternative": 4}]}, "alternative"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(changed, text):
    with pytest.raises(ValidationError, match=text):
        model(FAR, **changed)
