"""Tables of flights: what is flown again, what counts as by cues, and how rows are summed up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from links.simulated.matrix import cue_gaps, cue_table, lidar_table
from links.simulated.matrix.flight_lines import flown
from links.simulated.world.scene import Truth
from stages.messages import PoseState
from stages.messages.pose import PoseEstimate, PositionEstimate

S = 1_000_000_000


@dataclass(frozen=True)
class Flight:
    name: str
    seed: int
    variant: str


def test_a_flight_in_the_file_is_not_repeated_and_an_impossible_one_leaves_no_row(tmp_path: Path):
    flights = [Flight("a", 1, "none"), Flight("a", 2, "none"), Flight("b", 1, "none")]
    made: list[Flight] = []

    def fly(flight: Flight, progress: Any) -> dict[str, Any] | None:
        made.append(flight)
        return None if flight.name == "b" else {"cell": flight.name, "seed": flight.seed, "variant": flight.variant}

    assert len(flown(tmp_path, flights[:1], fly, 1)) == 1
    rows = flown(tmp_path, flights, fly, 1)
    assert [(row["cell"], row["seed"]) for row in rows] == [("a", 1), ("a", 2)]
    assert made == flights
    assert flown(tmp_path, flights[:2], fly, 1) == rows
    assert len(made) == 3


@pytest.mark.parametrize(
    ("log_odds", "reason", "expected"),
    [
        (3.5, "10 scan passes; cues +2.0 (gnss +2.0)", True),
        (5.5, "10 scan passes; cues +2.0 (gnss +2.0)", False),
        (3.5, "10 scan passes; cues -0.7 (gnss -0.7)", False),
        (3.5, "10 scan passes", False),
    ],
)
def test_an_acceptance_is_by_cues_if_it_is_below_the_threshold_without_them(log_odds, reason, expected):
    assert cue_table.by_cues(log_odds, reason) is expected


def test_the_table_of_cues_counts_found_flights_and_false_acceptances():
    found: dict[str, Any] = {"cell": "campus-20m-orbit-parked", "exposed": 0, "first_drone": 1}
    rows = [
        found | {"variant": "none", "seed": 1, "first_fix_s": 2.0, "reported_s": None, "false": []},
        found | {"variant": "none", "seed": 2, "first_fix_s": None, "reported_s": None, "false": [{"by_cues": False}]},
        found | {"variant": "gnss", "seed": 1, "first_fix_s": 1.0, "reported_s": 3.0, "false": [{"by_cues": True}]},
        found | {"variant": "gnss", "seed": 2, "first_fix_s": 2.0, "reported_s": 3.0, "false": []},
    ]
    table = cue_table.table_of(rows)
    assert "| 20 m | none | 2 | 1 | inf | inf | 1 (0) | 0 |" in table
    assert "| 20 m | gnss | 2 | 2 | 1.50 | 2.00 | 1 (1) | 2 |" in table


def test_the_table_of_lidars_has_the_errors_of_all_flights_of_a_model():
    row: dict[str, Any] = {"cell": "a", "seed": 1, "variant": "XT16", "wrong": 0}
    rows = [
        row | {"first_fix_s": 2.0, "seconds": 5.0, "errors_m": [0.3, 0.4]},
        row | {"first_fix_s": None, "seconds": 0.0, "errors_m": [], "wrong": 2},
        row | {"first_fix_s": 4.0, "seconds": 5.0, "errors_m": [0.0, 0.0, 0.0]},
    ]
    assert "| XT16 | 3 | 2 | 4.0, not found | 0.224 | 0.5 | 2 |" in lidar_table.table_of(rows)
    assert "| XT16 | 1 | 0 | not found, not found | - | - | 2 |" in lidar_table.table_of(rows[1:2])


def test_the_scenario_of_a_gap_has_the_gap_and_the_cues():
    scenario = cue_gaps.scenario_of(cue_gaps.Flight(3, "gnss"))
    assert scenario.lidar_gaps_s == ((17.0, 22.0),)
    assert scenario.duration_s > 22.0
    assert scenario.cues is not None
    assert cue_gaps.scenario_of(cue_gaps.Flight(3, "none")).cues is None


def gap_tap(*poses: Any) -> cue_gaps.GapTap:
    """After poses; the vehicle stands at the origin, yaw 90 deg, and the drone at (10, 0, 10)."""
    R, t = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)
    tap = cue_gaps.GapTap()
    tap.truth = cast(
        Truth,
        SimpleNamespace(
            start_ns=0,
            T_world_vehicle=lambda at: (R[None], t[None]),
            T_world_drone=lambda at: (np.eye(3)[None], np.array([[10.0, 0.0, 10.0]])),
        ),
    )
    for since_s, state, estimate in poses:
        stamp_ns = round(S * (cue_gaps.GAP_S[0] + since_s))
        tap._on_pose(cast(Any, SimpleNamespace(stamp_ns=stamp_ns, state=state, estimate=estimate)), since_s, tap.truth)
    return tap


def position(error_m: float) -> PositionEstimate:
    eye, zero = np.eye(3), np.zeros(3)
    return PositionEstimate(
        xyz_vehicle_m=np.array([error_m, -10.0, 10.0]),
        covariance_vehicle_m2=0.25 * eye,
        velocity_vehicle_mps=zero,
        xyz_map_m=zero,
        covariance_map_m2=eye,
        velocity_map_mps=zero,
        velocity_covariance=eye,
    )


def test_errors_of_a_gap_are_those_of_the_newest_pose_until_then():
    coasting = PoseState.COASTING
    tap = gap_tap((0.5, coasting, position(0.1)), (1.9, coasting, position(2.0)), (4.9, coasting, position(3.0)))
    assert tap.errors[1.0] == pytest.approx((0.1, 0.5 * 3**0.5))
    assert tap.errors[2.0][0] == pytest.approx(2.0)
    assert tap.errors[5.0][0] == pytest.approx(3.0)
    assert tap.inside == 1
    lost = gap_tap((0.5, coasting, position(0.1)), (3.0, PoseState.LOST, None))
    assert set(lost.errors) == {1.0, 2.0}
    assert lost.states == {"COASTING": 1, "LOST": 1}


def test_the_covariance_of_a_pose_is_turned_to_the_vehicles_axes():
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.diag([0, 0, 0, 1.0, 4.0, 9.0])
    pose = cast(Any, SimpleNamespace(R_vehicle_drone=R, covariance=covariance))
    assert not isinstance(pose, PoseEstimate)
    np.testing.assert_allclose(cue_gaps.position_covariance_m2(pose), np.diag([4.0, 1.0, 9.0]))
