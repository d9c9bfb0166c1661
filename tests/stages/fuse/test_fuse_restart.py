"""A restart of grd in flight: the heading of the earlier run, the chance that it does not hold, and wrong ones."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flow.message import Message
from stages.fuse import Fuse
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import heading_rad
from stages.messages import HeadingPrior
from tests.stages.fuse.imu_flights import ImuFlight, ns
from tests.stages.fuse.judged import Flown, fly


class Restarted(ImuFlight):
    """A flight with priors at 10 Hz, wrong by a yaw and a displacement."""

    turned_deg, moved_m, sigma_m, from_s = 0.0, 0.0, 1.0, 0.3

    def events(self) -> list[tuple[int, str, Message]]:
        made = [(ns(t) + 1, "prior", self.prior(t)) for t in np.arange(self.from_s, min(self.until_s, 5.0), 0.1)]
        return sorted([*super().events(), *made], key=lambda event: event[0])

    def prior(self, t: float) -> HeadingPrior:
        R, xyz_m, _ = self.truth(t)
        yaw_rad = heading_rad(R) + math.radians(3.0 + self.turned_deg)
        moved = np.array([self.moved_m + 0.5, -0.5, 1.0])
        return HeadingPrior(
            stamp_ns=ns(t),
            yaw_map_rad=yaw_rad,
            yaw_map_odom_rad=0.0,
            sigma_rad=math.radians(3.0),
            xyz_map_m=xyz_m + moved,
            position_sigma_m=self.sigma_m,
        )


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


def test_a_prior_that_comes_after_the_first_positions_is_used_too():
    assert hover(from_s=2.0).decided_s < 10.0


def test_a_prior_at_another_position_does_not_decide():
    flown = hover(moved_m=6.0, turned_deg=90.0)
    assert not any(flown.full)


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
