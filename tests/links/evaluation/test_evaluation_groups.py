"""Many runs summed up by a word of the recording's name."""

from __future__ import annotations

import numpy as np
import pytest

from flow.link import LinkError
from links.evaluation import evaluate, read_run
from links.evaluation.groups import groups
from tests.links.evaluation.made_runs import make_run, truth_at

T_S = np.arange(0.0, 10.0, 0.1)


@pytest.fixture
def judged(tmp_path):
    """Three runs: right all the time, 5 m off all the time, silent."""
    make_run(tmp_path / "a", T_S, truth_at(T_S), recording="street-10m-s1")
    make_run(tmp_path / "b", T_S, truth_at(T_S) + np.array([5.0, 0.0, 0.0]), recording="street-20m-s1")
    make_run(tmp_path / "c", [], [], recording="park-10m-s1")
    runs = [read_run(tmp_path / name) for name in "abc"]
    return [evaluate(run, output) for run in runs for output in run.outputs]


def test_a_group_counts_right_false_and_silent_runs(judged):
    park, street = groups(judged, 1)
    assert (park.name, park.runs, park.ever_right, park.silent, park.mostly_false) == ("park", 1, 0, 1, 0)
    assert (street.name, street.runs, street.ever_right, street.silent, street.mostly_false) == ("street", 2, 1, 0, 1)
    assert street.right_share == pytest.approx(50, abs=1)
    assert park.right_share == 0
    assert street.median_rmse_m == pytest.approx(0, abs=1e-6)


def test_numbers_stand_in_their_order_and_each_run_in_one_group(judged):
    found = groups(judged, 2)
    assert [g.name for g in found] == ["10m", "20m"]
    assert sum(g.runs for g in found) == len(judged)


def test_a_word_that_is_not_there_is_an_error(judged):
    with pytest.raises(LinkError, match=r"--by 4: 'street-10m-s1' has 3 words"):
        groups(judged, 4)
