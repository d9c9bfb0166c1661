"""A restart of grd in flight: the heading of the earlier run, the chance that it does not hold, and wrong ones."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from flow.message import Message
from stages.fuse import Fuse
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import heading_rad, rotation_z
from stages.messages import DroneFix, HeadingPrior
from tests.stages.fuse.fuse_inputs import late
from tests.stages.fuse.imu_flights import ImuFlight, ns, seconds
from tests.stages.fuse.judged import Flown, fly


class Restarted(ImuFlight):
    """A flight at a speed, with priors at 10 Hz that are wrong by a yaw and a displacement."""

    speed_mps, turned_deg, moved_m, sigma_m, from_s = 0.0, 0.0, 0.0, 1.0, 0.3

    def _goal(self, t: np.ndarray) -> np.ndarray:
        return super()._goal(t) + np.outer(t, [self.speed_mps, 0.0, 0.0])

    def events(self) -> list[tuple[int, str, Message]]:
        made = [(ns(t) + 1, "prior", self.prior(t)) for t in np.arange(self.from_s, min(self.until_s, 5.0), 0.1)]
        return sorted([*map(self.with_velocity, super().events()), *made], key=lambda event: event[0])

    def with_velocity(self, event: tuple[int, str, Message]) -> tuple[int, str, Message]:
        """A LiDAR position with the velocity of a tracker on a parked vehicle."""
        at_ns, port, fix = event
        if not isinstance(fix, DroneFix):
            return event
        velocity = self.truth(seconds(fix.stamp_ns))[2] + np.array([0.3, -0.3, 0.0])
        return at_ns, port, dataclasses.replace(fix, velocity_vehicle_mps=velocity)

    def prior(self, t: float) -> HeadingPrior:
        R, xyz_m, velocity = self.truth(t)
        yaw_rad = heading_rad(R) + math.radians(3.0 + self.turned_deg)
        moved = np.array([self.moved_m + 0.5, -0.5, 1.0])
        return HeadingPrior(
            stamp_ns=ns(t),
            yaw_map_rad=yaw_rad,
            yaw_map_odom_rad=0.0,
            sigma_rad=math.radians(3.0),
            xyz_map_m=xyz_m + moved,
            position_sigma_m=self.sigma_m,
            velocity_map_mps=rotation_z(math.radians(self.turned_deg)) @ velocity,
            velocity_sigma_mps=0.4,
        )


class Passing(Restarted):
    """The drone flies at 5 m/s."""

    speed_mps = 5.0


def hover(seed: int = 1, until_s: float = 12.0, **changes: float) -> Flown:
    flight = Restarted(kind="hover", seed=seed, until_s=until_s, wind_mps=1.5)
    for name, value in changes.items():
        setattr(flight, name, value)
    return fly(flight)


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_hovering_drone_has_its_heading_again_within_seconds(seed: int):
    flown = hover(seed)
    assert flown.decided_s < 7.5
    assert flown.wrong == 0
    assert np.abs(flown.yaw_deg).max() < 10.0


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_drone_at_constant_speed_has_its_heading_again_within_3_s(seed: int):
    """The prior's position has drifted; the direction of flight shows that its frame is the same."""
    flight = Passing(kind="hover", seed=seed, until_s=6.0, wind_mps=1.5)
    flight.moved_m = 0.5
    flown = fly(flight)
    assert flown.decided_s < 3.0
    assert flown.wrong == 0
    assert np.abs(flown.yaw_deg).max() < 10.0


@pytest.mark.parametrize("turned_deg", [-90.0, 60.0, 180.0])
def test_a_frame_that_has_turned_is_shown_by_the_direction_of_flight(turned_deg: float):
    flight = Passing(kind="hover", seed=1, until_s=6.0, wind_mps=1.5)
    flight.turned_deg = turned_deg
    assert not any(fly(flight).full)


@pytest.mark.parametrize("late_s", [0.1, 0.3])
def test_positions_that_arrive_late_are_compared_with_the_prior_of_their_time(late_s: float):
    flown = fly(Restarted(kind="hover", seed=1, until_s=12.0, wind_mps=1.5), fault=late(("fix",), late_s))
    assert flown.decided_s < 7.5
    assert flown.wrong == 0


def test_a_prior_that_comes_after_the_first_positions_is_used_too():
    assert hover(from_s=2.0).decided_s < 10.0


@pytest.mark.parametrize("moved_m", [6.0, 200.0])
def test_a_prior_at_another_position_does_not_decide(moved_m: float):
    flown = hover(moved_m=moved_m, turned_deg=90.0)
    assert not any(flown.full)
    assert flown.poses[-1].estimate is not None


def test_a_more_uncertain_prior_weighs_less():
    def probability(sigma_m: float) -> float:
        flown = hover(until_s=1.5, sigma_m=sigma_m)
        return next(float(heading.probability[0]) for heading in flown.headings if len(heading.probability))

    assert 0.9 < probability(4.0) < probability(1.0) < 1.0


def test_a_wrong_yaw_at_the_right_position_is_overruled_by_manoeuvres():
    flight = Restarted(kind="fast", seed=2, until_s=14.0)
    flight.turned_deg = 90.0
    flown = fly(flight)
    last = flown.headings[-1]
    assert last.decided
    assert abs(flown.yaw_deg[-1]) < 10.0


def test_the_share_of_changed_frames_is_a_setting():
    flight = Restarted(kind="hover", seed=1, until_s=3.0, wind_mps=0.0)
    flown = fly(flight, Fuse(errors=FuseErrors(changed_frames=0.9)))
    assert not any(flown.full)
