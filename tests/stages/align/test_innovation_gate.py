"""A image's yaw beside the turns felt: weighed with them, and worth no more than the last images scattered."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.align.dead_reckoning import DeadReckonedYaw, DeadReckoning
from stages.align.innovation_gate import InnovationGate
from stages.align.refine import Refined
from stages.align.yaw_tracker import YawTracker

S = 1_000_000_000
DRIFT = math.radians(0.1) ** 2  # in 0.2 s


def refined(yaw_deg: float, sigma_deg: float = 0.3) -> Refined:
    covariance = np.diag([0.05, 0.05, 0.05, 0.05, sigma_deg]) ** 2 * math.radians(1.0) ** 2
    covariance[0, 4] = covariance[4, 0] = 0.5 * math.sqrt(covariance[0, 0] * covariance[4, 4])
    return Refined(np.eye(3), np.eye(3), math.radians(yaw_deg), covariance, 2, 20, 20)


class Pair:
    """The surprise and the lock it asks, as the stage uses them."""

    def __init__(self, rate_hz: float = 5.0) -> None:
        self.rate_hz = rate_hz
        self.tracker = YawTracker()
        self.innovation_gate = InnovationGate(DeadReckoning(parked=True), self.tracker)
        self.k = 0

    def see(self, yaw_deg: float, sigma_deg: float = 0.3, variance: float | None = None) -> Refined:
        """One more image; dead reckoning has the yaw at zero."""
        self.k += 1
        variance = DRIFT * 5.0 / self.rate_hz if variance is None else variance
        at = DeadReckonedYaw(round(self.k * S / self.rate_hz), 0.0, 0.0, variance)
        self.tracker.variance_rad2 += variance
        picture = self.innovation_gate.with_scatter(refined(yaw_deg, sigma_deg), at)
        told = self.innovation_gate.weigh_yaw(picture, at)
        self.tracker.accept(picture.yaw_rad, picture.yaw_sigma_rad, at)
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
    assert np.mean((off / told[:, 1]) ** 2) < 1.5  # as each image says of itself that would be 9


@pytest.mark.parametrize("rate_hz", [5.0, 30.0])
def test_errors_that_last_are_not_averaged_away_by_more_pictures(rate_hz):
    """A Gauss-Markov error of 0.6 deg that lasts 0.5 s, of images that say 0.3."""
    off, sigma = [], []
    for seed in range(20):
        pair, rng = Pair(rate_hz), np.random.default_rng(seed)
        keep, error = math.exp(-1.0 / rate_hz / 0.5), 0.0
        for k in range(round(30 * rate_hz)):
            error = keep * error + rng.normal(0.0, 0.6 * math.sqrt(1.0 - keep**2))
            yaw, told = deg(pair.see(20.0 + error))
            if k > 5 * rate_hz:
                off.append(yaw - 20.0)
                sigma.append(told)
    assert np.mean((np.array(off) / np.array(sigma)) ** 2) < 2.5  # 5 were each image of 30 Hz taken for new


def test_one_odd_picture_is_told_as_doubtful_and_soon_forgotten():
    pair = Pair()
    for _ in range(20):
        pair.see(20.0)
    yaw, sigma = deg(pair.see(22.0))
    assert yaw - 20.0 < 1.2
    assert sigma > max(yaw - 20.0, 22.0 - yaw) / 1.7
    assert deg(pair.see(20.0))[0] == pytest.approx(20.0, abs=0.2)


def test_a_step_of_what_was_known_is_followed_and_told_as_doubtful_until_then():
    """An autopilot that corrects its own yaw by 2 deg: both are wrong by no more than they say at any time."""
    pair = Pair()
    for _ in range(20):
        pair.see(20.0)
    told = [deg(pair.see(22.0)) for _ in range(25)]
    assert all(abs(yaw - 22.0) < 1.7 * sigma for yaw, sigma in told)
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
