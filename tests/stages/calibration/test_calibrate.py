"""Self-calibration on a yard with a known mount: estimates, sigmas, and rejected parameters."""

from __future__ import annotations

import numpy as np
import pytest

from stages.calibration.calibrate import CannotCalibrate, calibrate
from stages.calibration.parameters import PARAMETERS
from stages.calibration.result import CURVE, Finding, Travel, accepted, curve_rows, values_of
from stages.calibration.scan_passes import ServoTrace
from stages.calibration.servo_mount import servo_mount
from stages.calibration.solve import NAMES
from stages.geometry.frames import UNCALIBRATED_DEG
from tests.stages.calibration.made_sweep import FAST, GROUND, RIG, SLOW, STEP_RAD, YARD, sweep, wrong_mount
from tests.stages.made import START_NS

UNITS = np.array([p.per_unit for p in PARAMETERS])


def found_in(seed=0, parked=False, **how):
    true = wrong_mount(seed)
    made = sweep(true, seed=seed, **how)
    return true, calibrate(made.returns, made.trace, RIG, parked=parked)


def rejected(found):
    return {f.name: f.rejected for f in found.findings if f.rejected}


@pytest.fixture(scope="module")
def yard():
    return found_in()


def test_injected_errors_are_found_again(yard):
    true, found = yard
    after, wanted = values_of(found.numbers, servo_mount(RIG)), values_of(true, servo_mount(RIG))
    off = {name: after[name] - wanted[name] for name in NAMES}
    assert abs(np.degrees(off["tilt_x"])) < 0.01
    assert abs(np.degrees(off["tilt_y"])) < 0.01
    assert abs(off["axis_x"]) < 3e-3
    assert abs(off["axis_y"]) < 3e-3
    assert abs(np.degrees(off["play"])) < 0.02
    assert abs(off["time"]) < 1e-4
    curve = curve_rows(found.travel) @ np.array([off[name] for name in CURVE])
    was = curve_rows(found.travel) @ np.array([wanted[name] for name in CURVE])
    assert curve.std() < was.std() / 5


def test_walls_are_as_thin_afterwards_as_their_noise(yard):
    _, found = yard
    assert np.median(found.thickness.after_m) < 0.008
    assert np.median(found.thickness.before_m) > 2 * np.median(found.thickness.after_m)


def test_the_new_mount_is_equivalent_as_a_rig(yard):
    _, found = yard
    again = servo_mount(found.mount)
    for name, value in values_of(found.numbers, servo_mount(RIG)).items():
        assert values_of(again, servo_mount(RIG))[name] == pytest.approx(value, abs=1e-9), name
    assert found.mount.T_vehicle_turntable == RIG.T_vehicle_turntable


def test_a_second_calibration_finds_nothing_more(yard):
    true, found = yard
    made = sweep(true, seed=0)
    again = calibrate(made.returns, made.trace, found.mount)
    for finding in again.findings:
        if not finding.rejected:
            assert abs(finding.after - finding.before) < 1.5 * finding.sigma, finding


def test_the_zero_is_never_estimated_and_stays(yard):
    _, found = yard
    assert set(rejected(found)) == {"zero"}
    assert "no scene determines it" in rejected(found)["zero"]


def test_the_rig_contains_the_sigma_of_the_servos_angle(yard):
    *_, found = yard
    assert 0.1 <= found.mount.pointing_sigma_deg < 0.15, "no less than the sigma of an unknown zero"


def test_sigmas_hold_over_many_yards():
    scores, nees = [], []
    for seed in range(1, 7):
        true, found = found_in(seed, count=30_000)
        after, wanted = values_of(found.numbers, servo_mount(RIG)), values_of(true, servo_mount(RIG))
        estimated = [i for i, name in enumerate(NAMES) if name not in rejected(found)]
        off = np.array([after[name] - wanted[name] for name in NAMES])[estimated]
        inner = found.covariance[np.ix_(estimated, estimated)]
        scores += (off / np.sqrt(np.diag(inner))).tolist()
        nees.append(float(off @ np.linalg.solve(inner, off)) / len(estimated))
    assert np.mean(np.abs(scores) < 2) > 0.9
    assert np.sqrt(np.mean(np.square(scores))) > 0.25  # the sigmas are not too conservative
    assert np.mean(nees) < 1.6


def test_an_unobservable_mean_is_compensated_by_the_zero():
    rig, found = servo_mount(RIG), wrong_mount()
    findings = tuple(Finding(n, n, "", 0.0, 0.0, 0.0, "no scene" if n == "zero" else "") for n in NAMES)
    travel = Travel(0.0, np.pi, both_ways=True, two_speeds=True)
    uncertain = np.diag(np.full(len(NAMES), np.radians(1.0) ** 2))
    written = accepted(rig, found, findings, uncertain, travel)
    at = np.linspace(0, np.pi, 181)
    turned = -(written.zero_rad - rig.zero_rad) - written.encoder_error_rad(at)
    assert turned.mean() == pytest.approx(0.0, abs=1e-9)
    assert accepted(rig, found, findings, uncertain * 1e-8, travel).zero_rad == rig.zero_rad


def test_one_direction_determines_neither_time_offset_nor_play():
    _, found = found_in(parked=True, legs=((0.0, 180.0, SLOW),))
    assert {"time", "play", "zero"} <= set(rejected(found))
    assert "one way only" in rejected(found)["time"]
    assert "tilt_x" not in rejected(found)
    assert found.mount.servo_time_offset_s == 0.0
    assert found.mount.servo_play_deg == 0.0


def test_one_speed_does_not_separate_time_offset_and_play():
    _, found = found_in(legs=((0.0, 180.0, SLOW), (180.0, 0.0, SLOW)))
    assert "one speed only" in rejected(found)["time"]
    assert "one speed only" in rejected(found)["play"]
    assert found.mount.pointing_sigma_deg == UNCALIBRATED_DEG


def test_an_open_field_determines_tilts_but_no_rotation():
    _, found = found_in(planes=GROUND)
    reasons = rejected(found)
    assert {*CURVE, "play", "time", "axis_x", "axis_y"} <= set(reasons)
    assert "level ground" in reasons["play"]
    assert "tilt_x" not in reasons
    assert found.mount.servo_harmonics == ()


def test_a_scene_without_surfaces_is_rejected():
    with pytest.raises(CannotCalibrate, match="returned"):
        found_in(planes=())


def test_a_slowly_moving_vehicle_is_rejected():
    with pytest.raises(CannotCalibrate, match="did not stand still"):
        found_in(velocity_mps=(0.02, 0.01, 0.0))


def test_a_moving_vehicle_is_rejected():
    corners = (*YARD, (0.2, -1.0, 0.0, 9.0))
    with pytest.raises(CannotCalibrate, match="did not stand still"):
        found_in(velocity_mps=(0.8, 0.3, 0.0), planes=corners)


def test_one_direction_does_not_show_whether_the_vehicle_stood_still():
    with pytest.raises(CannotCalibrate, match="--parked"):
        found_in(legs=((0.0, 180.0, SLOW),))


def test_too_little_travel_is_rejected_in_degrees():
    with pytest.raises(CannotCalibrate, match=r"turned by 20 deg only"):
        found_in(legs=((80.0, 100.0, SLOW), (100.0, 80.0, FAST)))


@pytest.mark.parametrize("steps", [0, 1])
def test_a_servo_that_stands_still_is_to_be_driven(steps):
    made = sweep(wrong_mount(), count=8_000)
    stamp_ns = made.trace.stamp_ns
    stands_rad = 1.5 + STEP_RAD * np.random.default_rng(1).integers(0, steps + 1, len(stamp_ns))
    with pytest.raises(CannotCalibrate, match=r"the servo stood still.*record while it sweeps"):
        calibrate(made.returns, ServoTrace.of(stamp_ns, stands_rad, STEP_RAD), RIG)


def test_a_fixed_lidar_and_a_silent_servo_are_rejected():
    made = sweep(wrong_mount(), count=8_000)
    with pytest.raises(CannotCalibrate, match="fixed LiDAR"):
        calibrate(made.returns, made.trace, RIG.model_copy(update={"turns": False}))
    none = ServoTrace.of(np.zeros(0, dtype=np.int64), np.zeros(0), STEP_RAD)
    with pytest.raises(CannotCalibrate, match="no servo states"):
        calibrate(made.returns, none, RIG)
    earlier = ServoTrace(made.trace.stamp_ns - START_NS, made.trace.position_rad)
    with pytest.raises(CannotCalibrate, match="one clock"):
        calibrate(made.returns, earlier, RIG)
