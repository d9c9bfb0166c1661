"""Fusion of the yaw of an image with dead reckoning, with a variance of at least the scatter of recent images."""

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
    """The innovation gate and its tracker, as the stage uses them."""

    def __init__(self, rate_hz: float = 5.0) -> None:
        self.rate_hz = rate_hz
        self.tracker = YawTracker()
        self.innovation_gate = InnovationGate(DeadReckoning(parked=True), self.tracker)
        self.k = 0

    def see(self, yaw_deg: float, sigma_deg: float = 0.3, variance: float | None = None) -> Refined:
        """Add an image; the dead reckoned yaw is zero."""
        self.k += 1
        variance = DRIFT * 5.0 / self.rate_hz if variance is None else variance
        at = DeadReckonedYaw(round(self.k * S / self.rate_hz), 0.0, 0.0, variance)
        self.tracker.variance_rad2 += variance
        image = self.innovation_gate.with_scatter(refined(yaw_deg, sigma_deg), at)
        output = self.innovation_gate.weigh_yaw(image, at)
        self.tracker.accept(image.yaw_rad, image.yaw_sigma_rad, at)
        return output


def deg(output: Refined) -> tuple[float, float]:
    return math.degrees(output.yaw_rad), math.degrees(output.yaw_sigma_rad)


def test_the_first_measurement_is_unchanged():
    output = Pair().see(20.0)
    assert deg(output) == pytest.approx((20.0, 0.3))


def test_consistent_images_keep_their_sigma():
    pair = Pair()
    for _ in range(20):
        yaw, sigma = deg(pair.see(20.0))
        assert yaw == pytest.approx(20.0, abs=0.01)
        assert 0.1 < sigma <= 0.3 + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_images_with_more_scatter_than_their_sigma_get_the_sigma_of_the_scatter(seed):
    pair, rng = Pair(), np.random.default_rng(seed)
    errors = rng.normal(0.0, 0.9, 200)
    output = np.array([deg(pair.see(20.0 + e)) for e in errors])[20:]
    off = output[:, 0] - 20.0
    assert np.sqrt(np.mean(off**2)) < 0.35 * np.sqrt(np.mean(errors[20:] ** 2))
    assert np.mean((off / output[:, 1]) ** 2) < 1.5  # with the sigma of each image it would be 9


@pytest.mark.parametrize("rate_hz", [5.0, 30.0])
def test_correlated_errors_do_not_average_out_with_more_images(rate_hz):
    """A Gauss-Markov error of 0.6 deg of 0.5 s, for images with a sigma of 0.3 deg."""
    off, sigma = [], []
    for seed in range(20):
        pair, rng = Pair(rate_hz), np.random.default_rng(seed)
        keep, error = math.exp(-1.0 / rate_hz / 0.5), 0.0
        for k in range(round(30 * rate_hz)):
            error = keep * error + rng.normal(0.0, 0.6 * math.sqrt(1.0 - keep**2))
            yaw, yaw_sigma = deg(pair.see(20.0 + error))
            if k > 5 * rate_hz:
                off.append(yaw - 20.0)
                sigma.append(yaw_sigma)
    assert np.mean((np.array(off) / np.array(sigma)) ** 2) < 2.5  # 5 if all images at 30 Hz counted as independent


def test_one_outlier_inflates_the_variance_for_a_short_time():
    pair = Pair()
    for _ in range(20):
        pair.see(20.0)
    yaw, sigma = deg(pair.see(22.0))
    assert yaw - 20.0 < 1.2
    assert sigma > max(yaw - 20.0, 22.0 - yaw) / 1.7
    assert deg(pair.see(20.0))[0] == pytest.approx(20.0, abs=0.2)


def test_a_step_of_dead_reckoning_is_followed_with_inflated_variance():
    """An autopilot that corrects its own yaw by 2 deg: the error stays within sigma at all times."""
    pair = Pair()
    for _ in range(20):
        pair.see(20.0)
    output = [deg(pair.see(22.0)) for _ in range(25)]
    assert all(abs(yaw - 22.0) < 1.7 * sigma for yaw, sigma in output)
    assert output[-1] == pytest.approx((22.0, 0.25), abs=0.1)


def test_an_unmeasured_turn_is_no_contradiction():
    pair = Pair()
    pair.see(20.0)
    output = pair.see(45.0, variance=math.radians(8.0) ** 2)
    assert deg(output) == pytest.approx((45.0, 0.3))


def test_the_covariance_stays_positive_definite():
    pair, rng = Pair(), np.random.default_rng(1)
    for e in rng.normal(0.0, 0.9, 50):
        covariance = pair.see(20.0 + e).covariance
        np.testing.assert_allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
