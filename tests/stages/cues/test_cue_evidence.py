"""Cues as evidence: caps, outliers, biases, and wrong cues."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stages.cues.bias import AGREES_NS, CONTRADICTS_NS, LEAST, CueBias
from stages.cues.evidence import NO_CUE, CueEvidence, CueWeights, ObjectState, measure, slow_covariance_m2
from stages.geometry.frames import rotation_z
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import CueKind, DroneCue, VehicleMotion
from tests.stages.made import START_NS

S = 1_000_000_000

TRAIL = VehicleTrajectory()
PLACE_M = np.array([12.0, -5.0, 9.0])
SEARCH_M = 65.0


def thing(xyz_m=PLACE_M, t_s: float = 0.0) -> ObjectState:
    return ObjectState(START_NS + round(1e9 * t_s), np.asarray(xyz_m), np.zeros(3), (0.01, 0.0, 0.01))


def gnss(xyz_m=PLACE_M, t_s: float = 0.0, bias_m: float = 3.5) -> DroneCue:
    return cue("gnss", CueKind.POSITION, xyz_m, 0.3, bias_m, t_s)


def uwb(range_m: float, t_s: float = 0.0) -> DroneCue:
    return cue("uwb", CueKind.RANGE, [range_m], 0.1, 0.3, t_s)


def altitude(up_m: float, t_s: float = 0.0) -> DroneCue:
    return cue("altitude", CueKind.HEIGHT, [up_m], 0.3, 1.5, t_s)


def cue(source: str, kind: CueKind, value_m, noise_m: float, bias_m: float, t_s: float) -> DroneCue:
    n = len(value_m)
    return DroneCue(
        stamp_ns=START_NS + round(1e9 * t_s),
        source=source,
        kind=kind,
        value_m=np.asarray(value_m, dtype=np.float64),
        covariance_m2=noise_m**2 * np.eye(n),
        bias_covariance_m2=bias_m**2 * np.eye(n),
        bias_time_s=120.0,
        yaw_sigma_rad=0.0,
        reference_map_m=np.zeros(3),
    )


def nats_of(*cues: DroneCue, at=PLACE_M, weights: CueWeights | None = None, t_s: float = 0.0) -> float:
    evidence = CueEvidence(weights or CueWeights(), SEARCH_M)
    for one in cues:
        evidence.add(one, TRAIL, [])
    return evidence.nats(thing(at, t_s), TRAIL, START_NS + round(1e9 * t_s))[0]


def test_the_jacobian_of_each_kind_is_its_derivative():
    reference_m, step = np.array([0.3, 0.2, 0.5]), 1e-6
    for kind in CueKind:
        _, H = measure(kind, PLACE_M, reference_m)
        for axis in range(3):
            d = step * np.eye(3)[axis]
            ahead, behind = (measure(kind, PLACE_M + s * d, reference_m)[0] for s in (1, -1))
            assert H[:, axis] == pytest.approx((ahead - behind) / (2 * step), abs=1e-6)


def test_the_log_ratio_is_that_of_the_mixture():
    weights = CueWeights(max_altitude=6.0, max_sum=6.0)
    S = 0.3**2 + 1.5**2 + 0.01
    ratio = SEARCH_M * math.exp(-0.5 * 1.0**2 / S) / math.sqrt(math.tau * S)
    assert nats_of(altitude(PLACE_M[2] + 1.0), weights=weights) == pytest.approx(math.log(0.7 * ratio + 0.3))


def test_each_cue_and_their_sum_are_capped():
    range_m = float(np.linalg.norm(PLACE_M))
    assert nats_of(gnss()) == 2.0
    assert nats_of(uwb(range_m)) == 2.0
    assert nats_of(altitude(9.0)) == 1.0
    assert nats_of(gnss(), uwb(range_m), altitude(9.0)) == 2.0
    assert nats_of(gnss(), weights=CueWeights(max_gnss=0.0)) == 0.0


def test_a_cue_elsewhere_costs_at_most_the_log_of_its_outlier_probability():
    assert nats_of(gnss(PLACE_M + np.array([30.0, 0.0, 0.0]))) == pytest.approx(math.log(0.3), abs=1e-3)
    assert nats_of(gnss(PLACE_M + np.array([3000.0, 0.0, 0.0]))) == pytest.approx(math.log(0.3))


def test_a_cue_that_contradicts_removes_what_the_others_add():
    range_m = float(np.linalg.norm(PLACE_M))
    assert nats_of(gnss(), uwb(range_m + 15.0), altitude(9.0)) == pytest.approx(math.log(0.3), abs=1e-3)


def test_one_reflection_of_a_ranging_radio_changes_nothing():
    range_m = float(np.linalg.norm(PLACE_M))
    assert nats_of(*[uwb(range_m + extra, 0.1 * k) for k, extra in enumerate((0.0, 0.1, 8.0))], t_s=0.2) == 2.0
    assert nats_of(*[uwb(range_m + extra, 0.1 * k) for k, extra in enumerate((0.0, 7.0, 8.0))], t_s=0.2) < -1.0


def test_old_cues_are_no_evidence():
    assert nats_of(gnss(), t_s=1.4) == 2.0
    assert nats_of(gnss(), t_s=1.6) == 0.0


def test_a_cue_is_compared_with_the_object_at_the_time_of_its_measurement():
    flying = ObjectState(
        START_NS + 200_000_000, PLACE_M + np.array([2.0, 0.0, 0.0]), np.array([10.0, 0.0, 0.0]), (0.01, 0, 0.01)
    )
    evidence = CueEvidence(CueWeights(), SEARCH_M)
    evidence.add(gnss(bias_m=0.1), TRAIL, [])
    assert evidence.nats(flying, TRAIL, flying.stamp_ns)[0] == 2.0
    still = flying._replace(velocity_mps=np.zeros(3))
    assert evidence.nats(still, TRAIL, flying.stamp_ns)[0] < 0.0


def test_the_bias_is_estimated_and_corrects_the_position():
    evidence, bias_m = CueEvidence(CueWeights(), SEARCH_M), np.array([2.0, -3.0, 1.0])
    for k in range(10):
        state = evidence.add(gnss(PLACE_M + bias_m, 0.2 * k), TRAIL, [thing(t_s=0.2 * k)])
    assert state.trusted
    assert state.bias_m == pytest.approx(bias_m, abs=0.15)
    assert state.bias_sigma_m < 0.5
    assert state.xyz_vehicle_m == pytest.approx(PLACE_M, abs=0.15)
    assert state.offset_m == pytest.approx(math.sqrt(14.0))


def test_a_cue_30_m_off_is_reported_and_not_used():
    evidence = CueEvidence(CueWeights(), SEARCH_M)
    wrong_m = PLACE_M + np.array([21.0, -21.0, 0.0])
    for k in range(LEAST):
        state = evidence.add(gnss(wrong_m, 0.2 * k), TRAIL, [thing(t_s=0.2 * k)])
    assert not state.trusted
    assert "contradicts the LiDAR, 29.7 m" in state.reason
    assert state.xyz_vehicle_m is None
    assert evidence.nats(thing(wrong_m, 0.4), TRAIL, START_NS + 400_000_000) == NO_CUE


def test_a_cue_is_trusted_again_after_it_agreed_for_some_time():
    bias = CueBias(np.array([[1.0]]))
    noise_m2 = np.array([[0.01]])
    for k in range(LEAST):
        bias.compare(START_NS + k * CONTRADICTS_NS // (LEAST - 1), np.array([20.0]), noise_m2)
    assert not bias.trusted
    assert bias.mean_m == 0.0  # a contradiction is no bias
    for k in range(10):
        assert not bias.trusted
        bias.compare(START_NS + S + k * AGREES_NS // 9, np.array([0.5]), noise_m2)
    assert bias.trusted


@pytest.mark.parametrize(("rate_hz", "distrusted_s"), [(1.0, 2.0), (5.0, 0.4), (10.0, 0.4), (50.0, 0.4)])
def test_trust_is_lost_after_a_time_whatever_the_rate(rate_hz, distrusted_s):
    bias, times = CueBias(np.array([[1.0]])), np.arange(0.0, 4.0, 1 / rate_hz)
    for t in times:
        bias.compare(START_NS + round(1e9 * t), np.array([20.0]), np.array([[0.01]]))
        assert bias.trusted == (t < distrusted_s - 1e-9), t


def test_without_the_lidar_a_bias_is_forgotten_slowly():
    stationary_m2 = np.array([[4.0]])
    bias = CueBias(stationary_m2)
    bias.predict(START_NS, stationary_m2, 120.0)
    bias.compare(START_NS, np.array([3.0]), np.array([[0.01]]))
    before = float(bias.mean_m[0])
    bias.predict(START_NS + 120_000_000_000, stationary_m2, 120.0)
    assert float(bias.mean_m[0]) == pytest.approx(before / math.e)
    assert float(bias.covariance_m2[0, 0]) == pytest.approx(4.0 * (1 - math.exp(-2.0)), rel=0.02)


def test_an_error_of_north_acts_across_the_direction_to_the_drone():
    turned = replace(gnss(np.array([10.0, 0.0, 5.0])), yaw_sigma_rad=0.1)
    assert slow_covariance_m2(turned) == pytest.approx(np.diag([3.5**2, 3.5**2 + 1.0, 3.5**2]))
    assert slow_covariance_m2(gnss()) == pytest.approx(3.5**2 * np.eye(3))


def test_a_cue_of_another_kind_starts_a_new_bias_but_stays_distrusted():
    evidence = CueEvidence(CueWeights(), SEARCH_M)
    for k in range(LEAST):
        evidence.add(gnss(PLACE_M + np.array([30.0, 0, 0]), 0.2 * k), TRAIL, [thing(t_s=0.2 * k)])
    level = cue("gnss", CueKind.LEVEL_AND_HEIGHT, [13.0, 9.0], 0.3, 3.5, 1.0)
    assert not evidence.add(level, TRAIL, []).trusted


def test_a_new_frame_map_restores_the_priors_and_keeps_the_trust():
    evidence, range_m = CueEvidence(CueWeights(), SEARCH_M), float(np.linalg.norm(PLACE_M))
    for k in range(10):
        evidence.add(gnss(PLACE_M + np.array([2.0, -3.0, 1.0]), 0.2 * k), TRAIL, [thing(t_s=0.2 * k)])
        evidence.add(uwb(range_m + 20.0, 0.2 * k), TRAIL, [thing(t_s=0.2 * k)])
    evidence.reset()
    assert evidence.nats(thing(t_s=1.8), TRAIL, START_NS + 1_800_000_000) == NO_CUE
    state = evidence.add(gnss(t_s=2.0), TRAIL, [])
    assert state.bias_m == pytest.approx(np.zeros(3))
    assert state.bias_sigma_m == pytest.approx(3.5)
    assert state.trusted
    assert not evidence.add(uwb(range_m, 2.0), TRAIL, []).trusted


def test_the_position_for_the_search_is_in_the_axes_of_the_turned_vehicle():
    trail = VehicleTrajectory()
    xyz_m = np.array([50.0, 20.0, 0.0])
    trail.add(VehicleMotion(stamp_ns=START_NS, xyz_map_m=xyz_m, R_map_vehicle=rotation_z(0.7), covariance=None))
    state = CueEvidence(CueWeights(), SEARCH_M).add(gnss(rotation_z(0.7) @ PLACE_M), trail, [])
    assert state.xyz_vehicle_m == pytest.approx(PLACE_M)
