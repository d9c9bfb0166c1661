"""The texts at the end of a run: the figures of two runs side by side, and when the pose was FULL for the first time."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from links.cli.run_output import truth_texts
from links.cli.side_by_side import side_by_side
from links.runs.fused_poses import rms
from links.runs.request import RunResult

S = 1_000_000_000


def run(states: dict[str, int], errors: Any = None, poses: Any = None) -> RunResult:
    settings, rejections = SimpleNamespace(yaw="none"), {"yaw of autopilot's axes unknown": 3, "no position": 1}
    results = SimpleNamespace(
        pose_states=states, pose_reason="no track", resets=0, fixes=[], settings=settings, gate_rejections=rejections
    )
    report = SimpleNamespace(first_ns=S, last_ns=11 * S)
    return RunResult(Path("a.mcap"), Path("out"), cast(Any, report), cast(Any, results), errors, poses, None, 1.0, [])


def fused(state: str) -> Any:
    nan = np.full(1, np.nan)
    values = {"stamps_ns": np.array([3 * S]), "full": np.array([state == "FULL"])}
    return SimpleNamespace(**values, distance_m=nan, angle_rad=nan, has_truth=False)


def rows(runs: list[tuple[str, RunResult]]) -> dict[str, list[str]]:
    first, *columns = (list(column.cells) for column in side_by_side(runs).columns)
    return {str(name): [str(column[k]) for column in columns] for k, name in enumerate(first)}


def test_what_the_gate_accepts_and_why_it_rejects_the_rest_is_one_line():
    assert truth_texts(run({"FULL": 8, "LOST": 1}))[1] == (
        "autopilot's gate (yaw: none): accepts 5 of 9 poses; rejects 3 yaw of autopilot's axes unknown, 1 no position"
    )


@pytest.mark.parametrize("truth_first", [True, False])
def test_a_figure_that_only_one_of_two_runs_has_is_a_dash_in_the_other(truth_first: bool):
    errors = SimpleNamespace(stamps_ns=np.array([2 * S]), error_m=np.array([[0.3, 0.0, 0.4]]))
    runs = [("with", run({}, errors)), ("without", run({}))]
    figures = rows(runs if truth_first else runs[::-1])["their 3D RMSE [m]"]
    assert figures == (["0.500", "-"] if truth_first else ["-", "0.500"])


@pytest.mark.parametrize(
    ("states", "poses", "text", "figure"),
    [
        ({"FULL": 5}, fused("FULL"), "FULL after 2.0 s", "2.0"),
        ({"LOST": 5}, None, "never FULL, at the end: no track", "never"),
        ({"POSITION_ONLY": 5}, fused("POSITION_ONLY"), "never FULL, at the end: no track", "never"),
        ({"FULL": 5}, None, "FULL, but pose_vehicle_drone.tum is cut off", "-"),
        ({"FULL": 5, "POSITION_ONLY": 5}, fused("POSITION_ONLY"), "FULL, but pose_vehicle_drone.tum is cut off", "-"),
    ],
)
def test_never_full_is_only_reported_when_no_pose_was_full(states: Any, poses: Any, text: str, figure: str):
    ended = run(states, poses=poses)
    assert f"; {text}" in truth_texts(ended)[0]
    assert rows([("a", ended)])["whole pose (FULL) after [s]"] == [figure]


def test_the_root_mean_square_leaves_out_what_is_not_known():
    assert rms(np.array([3.0, np.nan, 4.0])) == pytest.approx(12.5**0.5)
    assert np.isnan(rms(np.array([np.nan])))
