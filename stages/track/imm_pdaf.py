# pyright: basic, reportMissingImports=false
"""Interacting multiple models with probabilistic data association (IMM-PDAF), on Stone Soup; extra `baseline`.

Two constant-velocity models, calm and manoeuvring. Each step mixes their states, updates each with all gated
measurements weighted by their association probabilities, and weights the models by the measurements' likelihood.

Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 11.6 (IMM);
Bar-Shalom, Daum, Huang, "The Probabilistic Data Association Filter", IEEE CSM 29 (2009).
"""

from __future__ import annotations

import datetime
from typing import Any, NamedTuple

import numpy as np
from stonesoup.functions import gm_reduce_single
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

from stages.geometry.frames import Array64

POSITION, VELOCITY = [0, 2, 4], [1, 3, 5]  # of the state: x, vx, y, vy, z, vz
EPOCH = datetime.datetime(1970, 1, 1)


class ImmSettings(NamedTuple):
    """Constants of the filter."""

    noise_mps: tuple[float, float]  # velocity noise of the models after 1 s, calm and manoeuvring
    stay: float  # probability that a model stays valid over a step
    sigma_m: float  # of a measurement, each axis
    start_speed_mps: float  # one sigma of the velocity at the start
    detection_probability: float  # in a step
    gate_probability: float
    clutter_per_m3: float  # false measurements in a step


class ImmPdaf:
    """One track: position and velocity in a static frame."""

    def __init__(self, xyz_m: Array64, stamp_ns: int, settings: ImmSettings) -> None:
        self._settings, self.stamp_ns = settings, stamp_ns
        self._measurement = LinearGaussian(ndim_state=6, mapping=POSITION, noise_covar=np.eye(3) * settings.sigma_m**2)
        self._updater = KalmanUpdater(self._measurement)
        self._associate: list[Any] = [_hypothesiser(noise, self._updater, settings) for noise in settings.noise_mps]
        mean = np.zeros(6)
        mean[POSITION] = xyz_m
        covariance = np.diag([settings.sigma_m**2, settings.start_speed_mps**2] * 3)
        self._states = [GaussianState(mean, covariance, timestamp=_time(stamp_ns)) for _ in self._associate]
        self.probabilities = np.full(len(self._states), 1.0 / len(self._states))  # of the models

    def step(self, xyz_m: Array64, stamp_ns: int) -> int:
        """Predict to `stamp_ns` and update with measurements (n, 3). Returns how many fell into a model's gate."""
        settings, n = self._settings, len(self._states)
        transition = np.full((n, n), (1.0 - settings.stay) / (n - 1))
        np.fill_diagonal(transition, settings.stay)
        predicted = self.probabilities @ transition
        mixed = [_merged(self._states, self.probabilities * transition[:, j] / predicted[j]) for j in range(n)]
        when = _time(stamp_ns)
        found = [Detection(xyz, timestamp=when, measurement_model=self._measurement) for xyz in xyz_m]
        gated, likelihood = 0, np.zeros(n)
        for j, hypothesiser in enumerate(self._associate):
            hypotheses = hypothesiser.hypothesise(mixed[j], found, when)
            weights = np.array([float(hypothesis.probability) for hypothesis in hypotheses])
            states: list[Any] = [self._updater.update(h) if h else h.prediction for h in hypotheses]
            self._states[j] = _merged(states, weights / weights.sum())
            likelihood[j] = weights.sum()
            gated = max(gated, len(weights) - 1)
        self.probabilities = predicted * likelihood / float(predicted @ likelihood)
        self.stamp_ns = stamp_ns
        return gated

    def estimate(self) -> tuple[Array64, Array64, Array64]:
        """Position (3,), velocity (3,) and covariance (3, 3) of the position, of all models together."""
        state = _merged(self._states, self.probabilities)
        mean = np.array(state.state_vector, dtype=np.float64)[:, 0]
        return mean[POSITION], mean[VELOCITY], np.array(state.covar, dtype=np.float64)[np.ix_(POSITION, POSITION)]


def _hypothesiser(noise_mps: float, updater: KalmanUpdater, settings: ImmSettings) -> PDAHypothesiser:
    model = CombinedLinearGaussianTransitionModel([ConstantVelocity(noise_mps**2)] * 3)
    return PDAHypothesiser(
        KalmanPredictor(model),
        updater,
        clutter_spatial_density=settings.clutter_per_m3,
        prob_detect=settings.detection_probability,
        prob_gate=settings.gate_probability,
        normalise=False,
    )


def _merged(states: list[GaussianState], weights: Array64) -> GaussianState:
    """The Gaussian with the mean and covariance of a mixture."""
    if len(states) == 1:
        return states[0]
    means = np.column_stack([np.array(state.state_vector, dtype=np.float64) for state in states])
    covariances = np.stack([np.array(state.covar, dtype=np.float64) for state in states], axis=2)
    mean, covariance = gm_reduce_single(means, covariances, weights)
    return GaussianState(mean, covariance, timestamp=states[0].timestamp)


def _time(stamp_ns: int) -> datetime.datetime:
    """Time to the microsecond, in which Stone Soup computes."""
    return EPOCH + datetime.timedelta(microseconds=stamp_ns // 1000)
