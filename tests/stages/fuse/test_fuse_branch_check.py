"""A rotation by both cameras is FULL only when the drone's motion has agreed with it: a branch that is RESOLVED and wrong
crashes a hovering drone, too."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.heading.hypothesis_bank import BranchSettings, HypothesisBank
from stages.messages import PoseState
from tests.stages.fuse.ekf import EkfFuse
from tests.stages.fuse.made_drone_flight import Made, ns

FULL, AMBIGUOUS, COASTING = PoseState.FULL, PoseState.AMBIGUOUS, PoseState.COASTING


@dataclass
class HoverThenFly(Made):
    """Hovers, then flies off at 3 m/s."""

    flies_at_s: float = 5.0

    def xyz_world_m(self, t):
        flown_s = max(t - self.flies_at_s, 0.0)
        way_m = 1.5 * flown_s**2 if flown_s < 1 else 3.0 * flown_s - 1.5
        return np.array([3.0 + 0.8 * way_m, 4.0 + 0.6 * way_m + 0.05 * math.sin(t), 15.0])


def first(poses, state):
    return next((pose for pose in poses if pose.state is state), None)


def wrong(made, poses):
    return sum(angle > 45 for angle in made.judge(poses).angle_deg)


@pytest.mark.parametrize("stage", [Fuse, EkfFuse])
@pytest.mark.parametrize("quarter", range(4))
def test_a_hovering_drone_is_never_full_by_vanishing_points_alone(quarter, stage):
    made = Made(until_s=8, radius_m=0.0, quarters=((0.0, quarter),))
    poses = made.run(stage())
    assert not any(pose.R_vehicle_drone is not None for pose in poses)
    assert poses[-1].state is AMBIGUOUS
    assert "fly some metres" in poses[-1].reason
    assert made.judge(poses, after_s=2).rmse_m() < 0.15  # its position is published


@pytest.mark.parametrize(("autopilot", "images"), [("odometry", False), ("attitude", True), ("none", True)])
def test_two_seconds_and_a_half_of_flight_make_it_full(autopilot, images):
    made = HoverThenFly(until_s=10, autopilot=autopilot, images=images)
    poses = made.run(Fuse())
    assert ns(5.0) < first(poses, FULL).stamp_ns < ns(7.5)
    assert poses[-1].state is FULL
    assert wrong(made, poses) == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_without_autopilot_positions_the_images_reject_a_wrong_branch(quarter, seed):
    made = Made(until_s=9, autopilot="none", images=True, quarters=((0.0, quarter),), seed=seed)
    poses = made.run(Fuse())
    assert wrong(made, poses) == 0
    assert poses[-1].state is AMBIGUOUS


@pytest.mark.parametrize("reported", [True, False])
def test_a_branch_that_changes_without_an_autopilot_ends_full(reported):
    made = Made(until_s=9, autopilot="none", images=True, quarters=((5.0, 1),), switches=reported)
    poses = made.run(Fuse())
    assert first(poses, FULL) is not None
    assert wrong(made, poses) == 0
    assert poses[-1].state is AMBIGUOUS


def test_without_a_second_source_there_is_no_confirmation():
    poses = Made(until_s=6, autopilot="attitude").run(Fuse())
    assert poses[-1].state is AMBIGUOUS


def test_once_full_it_stays_so_through_a_hover():
    @dataclass
    class FlyThenHover(HoverThenFly):
        def xyz_world_m(self, t):
            return super().xyz_world_m(min(t + self.flies_at_s, self.flies_at_s + 4.0))

    made = FlyThenHover(until_s=45)
    poses = made.run(Fuse())
    after = [pose.state for pose in poses if pose.stamp_ns > ns(4)]
    assert set(after) == {FULL}


@pytest.mark.parametrize("trust", [0.95, 0.99999])
def test_align_does_not_resolve_by_a_prior_without_motion(trust):
    """A prior may make a branch nearly certain, but only windows of motion make it RESOLVED."""
    bank = HypothesisBank(BranchSettings())
    bank.expect_yaw(0.0, math.radians(5), trust)
    bank.expect_yaw(0.0, math.radians(5), trust)
    assert bank.probability[0] > 0.9
    assert not bank.resolved(0, 0.999)
