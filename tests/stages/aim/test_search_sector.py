"""The sector of the search by a cue, and that a wrong cue does not prevent the search."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.aim import BeamAim
from stages.aim.search_sector import SECTOR_PASSES, WHOLE_PASSES, SearchSector, sector_rad
from stages.messages import CueState
from tests.stages.aim.test_beam_aim import candidates, fly, towards, tracking
from tests.stages.made import MS, ON_ITS_SIDE, START_NS, servo

TRAVEL_RAD = (0.0, math.pi)
FAR_M = np.array([-20.0, 20.0, 15.0])  # at 135 deg
P_M2 = 9.0 * np.eye(3)


def test_the_sector_is_about_the_direction_of_the_cue():
    low, high = sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, P_M2) or (0.0, 0.0)
    assert (low + high) / 2 == pytest.approx(math.radians(135.0), abs=0.02)
    assert (high - low) / 2 == pytest.approx(math.asin(7.0 / (20.0 * math.sqrt(2.0))), abs=0.03)  # 2 sigma and a margin


def test_turning_cue_and_covariance_by_180_deg_changes_nothing():
    opposite = FAR_M * [-1.0, -1.0, 1.0]
    assert sector_rad(ON_ITS_SIDE, TRAVEL_RAD, opposite, P_M2) == sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, P_M2)


def test_a_more_precise_cue_gives_a_narrower_sector_and_one_overhead_none():
    wide, narrow = (sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, s * P_M2) for s in (1.0, 0.1))
    assert wide is not None
    assert narrow is not None
    assert narrow[1] - narrow[0] < wide[1] - wide[0]
    assert sector_rad(ON_ITS_SIDE, TRAVEL_RAD, np.array([0.5, 0.5, 20.0]), P_M2) is None


def test_the_whole_travel_follows_some_passes_of_the_sector():
    sector = SearchSector(ON_ITS_SIDE, TRAVEL_RAD)
    sector.update("gnss", START_NS, FAR_M, P_M2)
    whole = [sector.limits(START_NS, passes) == TRAVEL_RAD for passes in range(2 * (SECTOR_PASSES + WHOLE_PASSES))]
    assert whole == 2 * (SECTOR_PASSES * [False] + WHOLE_PASSES * [True])


def test_without_a_recent_or_trusted_cue_the_whole_travel_is_searched():
    sector = SearchSector(ON_ITS_SIDE, TRAVEL_RAD)
    assert sector.limits(START_NS, 0) == TRAVEL_RAD
    sector.update("gnss", START_NS, FAR_M, P_M2)
    assert sector.limits(START_NS + 2_000_000_000, 0) == TRAVEL_RAD
    sector.update("gnss", START_NS, FAR_M, P_M2)
    sector.withdraw("gnss")
    assert sector.limits(START_NS, 0) == TRAVEL_RAD


def cue_state(t_s: float, xyz_m=FAR_M, trusted: bool = True, source: str = "gnss") -> CueState:
    return CueState(
        stamp_ns=START_NS + round(1e9 * t_s),
        source=source,
        trusted=trusted,
        reason="made",
        bias_m=np.zeros(3),
        bias_sigma_m=3.0,
        offset_m=math.nan,
        xyz_vehicle_m=xyz_m if trusted else None,
        covariance_m2=P_M2 if trusted else None,
    )


def test_the_servo_goes_to_the_sector_at_full_speed_and_sweeps_it_before_the_rest():
    aim = BeamAim(mount=ON_ITS_SIDE)
    flight = fly(aim, 4.0, lambda aim, t_s: aim.on_cue(cue_state(t_s)))
    low, high = sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, P_M2) or (0.0, 0.0)
    _, first = flight.goals[0]
    assert first.position_rad == pytest.approx(low)
    assert first.speed_radps == pytest.approx(55 * math.tau / 60)
    reached = flight.ends_reached()
    assert reached[1 : SECTOR_PASSES + 1] == pytest.approx([high, low], abs=2e-3)
    assert {0.0, round(math.pi, 3)} <= set(reached)


def test_a_cue_that_is_no_longer_trusted_frees_the_sweep():
    def publish(aim: BeamAim, t_s: float) -> None:
        aim.on_cue(cue_state(t_s, trusted=t_s < 0.5))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 2.5, publish)
    assert {0.0, round(math.pi, 3)} & set(flight.ends_reached())
    assert flight.goals[-1][1].position_rad in (0.0, pytest.approx(math.pi))


def test_a_candidate_during_the_approach_of_the_sector_does_not_end_the_search():
    def publish(aim: BeamAim, t_s: float) -> None:
        aim.on_cue(cue_state(t_s))
        if 0.05 <= t_s < 0.4:
            aim.on_candidates(candidates(towards(20.0, 30.0)(np.array([0.0]))[0], t_s, 0.6))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 5.0, publish)
    low, high = sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, P_M2) or (0.0, 0.0)
    after = [goal.position_rad for t_s, goal in flight.goals if t_s > 1.5]
    assert {round(low, 3), round(high, 3)} <= {round(goal, 3) for goal in after}


def test_a_lost_goal_is_sent_again_and_a_servo_that_never_reaches_the_sector_searches_elsewhere():
    aim, goals = BeamAim(mount=ON_ITS_SIDE), []
    for tick in range(600):
        aim.on_cue(cue_state(0.005 * tick))
        if (goal := aim.on_servo(servo(START_NS + 5 * tick * MS, 0.3))) is not None:
            goals.append(round(goal.position_rad, 3))
    low, _ = sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, P_M2) or (0.0, 0.0)
    assert goals[:2] == [round(low, 3)] * 2
    assert {0.0, round(math.pi, 3)} <= set(goals)


def test_a_cue_of_another_source_that_is_not_trusted_does_not_withdraw_the_sector():
    def publish(aim: BeamAim, t_s: float) -> None:
        aim.on_cue(cue_state(t_s))
        aim.on_cue(cue_state(t_s, trusted=False, source="uwb"))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 1.5, publish)
    low, high = sector_rad(ON_ITS_SIDE, TRAVEL_RAD, FAR_M, P_M2) or (0.0, 0.0)
    assert flight.ends_reached()[:2] == pytest.approx([low, high], abs=2e-3)


def test_the_second_drone_is_searched_on_the_whole_travel():
    track = tracking(towards(135.0, 30.0))

    def publish(aim: BeamAim, t_s: float) -> None:
        aim.on_cue(cue_state(t_s))
        if t_s > 0.6:  # during the first passes of the sector
            track(aim, t_s)

    flight = fly(BeamAim(mount=ON_ITS_SIDE, max_drones=2), 6.0, publish)
    assert np.degrees(np.ptp(flight.servo_rad[300:])) > 90.0
