"""A picture's yaw beside the turns felt: weighed with them, and worth no more than the last pictures scattered."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.align.lock import YawLock
from stages.align.reckoning import Reckoned, Reckoning
from stages.align.refine import Refined
from stages.align.surprise import Surprise

S = 1_000_000_000
DRIFT = math.radians(0.1) ** 2  # a picture


def refined(yaw_deg: float, sigma_deg: float = 0.3) -> Refined:
    covariance = np.diag([0.05, 0.05, 0.05, 0.05, sigma_deg]) ** 2 * math.radians(1.0) ** 2
    covariance[0, 4] = covariance[4, 0] = 0.5 * math.sqrt(covariance[0, 0] * covariance[4, 4])
    return Refined(np.eye(3), np.eye(3), math.radians(yaw_deg), covariance, 2, 20, 20)


class Pair:
    """The surprise and the lock it asks, as the stage uses them."""

    def __init__(self) -> None:
        self.lock = YawLock()
        self.surprise = Surprise(Reckoning(parked=True), self.lock)
        self.k = 0

    def see(self, yaw_deg: float, sigma_deg: float = 0.3, variance: float = DRIFT) -> Refined:
        """One more picture; dead reckoning has the yaw at zero."""
        self.k += 1
        at = Reckoned(self.k * S // 5, 0.0, 0.0, variance)
        self.lock.variance_rad2 += variance
        told = self.surprise.weigh_yaw(refined(yaw_deg, sigma_deg), at)
        self.lock.accept(math.radians(yaw_deg), math.radians(sigma_deg), at)
        return told


def deg(told: Refined) -> tuple[float, float]:
    return math.degrees(told.yaw_rad), math.degrees(told.yaw_sigma_rad)


def test_the_first_picture_is_told_as_it_is():
    told = Pair().see(20.0)
    assert deg(told) == pytest.approx((20.0, 0.3))


def test_pictures_that_agree_are_told_no_worse_than_they_are():
    pair = Pair()
    for _ in range(20):
        yaw, sigma = deg(pair.see(20.0))
        assert yaw == pytest.approx(20.0, abs=0.01)
        assert 0.1 < sigma <= 0.3 + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_pictures_that_scatter_more_than_they_know_are_told_as_they_scatter(seed):
    pair, rng = Pair(), np.random.default_rng(seed)
    errors = rng.normal(0.0, 0.9, 200)
    told = np.array([deg(pair.see(20.0 + e)) for e in errors])[20:]
    off = told[:, 0] - 20.0
    assert np.sqrt(np.mean(off**2)) < 0.35 * np.sqrt(np.mean(errors[20:] ** 2))
    assert np.mean((off / told[:, 1]) ** 2) < 1.5
    assert np.mean((errors[20:] / 0.3) ** 2) > 5.0  # as each picture says of itself


def test_one_odd_picture_is_told_as_doubtful_and_soon_forgotten():
    pair = Pair()
    for _ in range(20):
        pair.see(20.0)
    yaw, sigma = deg(pair.see(22.0))
    assert yaw - 20.0 < 1.2
    assert sigma > max(yaw - 20.0, 22.0 - yaw) / 1.5
    assert deg(pair.see(20.0))[0] == pytest.approx(20.0, abs=0.2)


def test_a_step_of_what_was_known_is_followed_and_told_as_doubtful_until_then():
    """An autopilot that corrects its own yaw by 2 deg: both are wrong by no more than they say at any time."""
    pair = Pair()
    for _ in range(20):
        pair.see(20.0)
    told = [deg(pair.see(22.0)) for _ in range(25)]
    assert all(abs(yaw - 22.0) < 1.5 * sigma for yaw, sigma in told)
    assert told[-1] == pytest.approx((22.0, 0.25), abs=0.1)


def test_turns_that_nobody_feels_contradict_nothing():
    pair = Pair()
    pair.see(20.0)
    told = pair.see(45.0, variance=math.radians(8.0) ** 2)
    assert deg(told) == pytest.approx((45.0, 0.3))


def test_the_covariance_stays_one():
    pair, rng = Pair(), np.random.default_rng(1)
    for e in rng.normal(0.0, 0.9, 50):
        covariance = pair.see(20.0 + e).covariance
        np.testing.assert_allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
