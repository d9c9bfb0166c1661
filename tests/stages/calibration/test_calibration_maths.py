"""The formulas of the calibration by hand: mount, servo, columns, planes, clusters."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stages.calibration.columns import drift_columns, laser_columns, mount_columns, place
from stages.calibration.motion import shift
from stages.calibration.patches import find_patches
from stages.calibration.result import Travel, unseen
from stages.calibration.scan_passes import Returns, ServoAt, ServoTrace, servo_at, smoothed
from stages.calibration.servo_mount import harmonics, lidar_mount, servo_mount
from stages.calibration.solve import NAMES, clustered, linearise, prior_information, sandwich, surfaces, without_planes
from stages.geometry.frames import Harmonic, LidarMount, Pose
from stages.kernels.calibration.scan_passes import play_sides
from tests.stages.calibration.made_sweep import STEP_RAD, YARD, sweep, wrong_mount

ASKEW = LidarMount(
    T_turntable_lidar=Pose(xyz_m=(0.01, 0.02, 0.1), rpy_deg=(88.0, 1.0, -2.0)),
    servo_sign=-1,
    servo_zero_deg=12.0,
    servo_time_offset_s=0.003,
    servo_harmonics=(Harmonic(order=1, amplitude_deg=0.5, phase_deg=20.0), Harmonic(order=3, amplitude_deg=0.1)),
    servo_play_deg=0.4,
)
MS = 1_000_000


def test_a_rig_becomes_numbers_and_the_same_rig_again():
    again = lidar_mount(servo_mount(ASKEW), ASKEW)
    assert again.T_turntable_lidar.matrix() == pytest.approx(ASKEW.T_turntable_lidar.matrix(), abs=1e-12)
    at = np.linspace(-1, 4, 7)
    assert again.turntable_rad(at) == pytest.approx(ASKEW.turntable_rad(at), abs=1e-12)
    assert (again.servo_sign, again.servo_time_offset_s) == (-1, 0.003)
    assert again.servo_play_deg == pytest.approx(0.4)


def test_the_encoders_error_is_the_rigs():
    at = np.array([0.3, 1.7])
    by_hand = math.radians(0.5) * np.sin(at + math.radians(20)) + math.radians(0.1) * np.sin(3 * at)
    assert servo_mount(ASKEW).encoder_error_rad(at) == pytest.approx(by_hand)


def test_sine_and_cosine_become_amplitude_and_phase():
    (term,) = harmonics({2: (math.radians(0.3), math.radians(0.4)), 1: (0.0, 0.0)})
    assert term.order == 2
    assert term.amplitude_deg == pytest.approx(0.5)
    assert term.phase_deg == pytest.approx(math.degrees(math.atan2(4, 3)))


def test_placed_returns_equal_those_of_the_turntable():
    mount = servo_mount(ASKEW)
    p, s = np.array([[1.0, 2.0, 3.0]]), np.array([0.7])
    placed = place(
        Returns(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.uint8), p),
        ServoAt(s, np.zeros(1), np.array([1.0])),
        mount,
        np.zeros(16),
    )
    angle = float(ASKEW.turntable_rad(s)[0]) + math.radians(0.4) / 2  # sign -1: lags in the other direction
    c, v = math.cos(angle), math.sin(angle)
    T = ASKEW.T_turntable_lidar.matrix()
    q = T[:3, :3] @ p[0] + T[:3, 3]
    assert placed.xyz_m[0] == pytest.approx([c * q[0] - v * q[1], v * q[0] + c * q[1], q[2]])


def test_every_column_is_the_derivative_by_its_parameter():
    rng = np.random.default_rng(1)
    mount, n = servo_mount(ASKEW), 20
    returns = Returns(np.zeros(n, dtype=np.int64), rng.integers(0, 16, n).astype(np.uint8), rng.normal(0, 9, (n, 3)))
    rate = rng.normal(0, 2, n)
    play_side = np.where(rate > 0, 1.0, -1.0)
    position = rng.uniform(0, 3, n)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def away(step, bias=np.zeros(16)):  # noqa: B008
        later = ServoAt(position - rate * step.get("time", 0.0), rate, play_side)
        return np.einsum("ij,ij->i", place(returns, later, mount.moved(step), bias).xyz_m, normal)

    placed = place(returns, ServoAt(position, rate, play_side), mount, np.zeros(16))
    columns = mount_columns(placed, normal, mount)
    assert set(columns) == set(NAMES)
    for name in NAMES:
        slope = (away({name: 1e-6}) - away({name: -1e-6})) / 2e-6
        assert columns[name] == pytest.approx(slope, abs=1e-5), name
    lasers = laser_columns(placed, normal, returns.laser, 16)
    for laser in (0, 7, 15):
        bias = np.eye(16)[laser] * 1e-6
        assert lasers[:, laser] == pytest.approx((away({}, bias) - away({})) / 1e-6, abs=1e-6)


def test_a_drive_moves_returns_along_and_a_turn_about_z():
    placed = place(
        Returns(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.uint8), np.array([[2.0, 0.0, 0.0]])),
        ServoAt(np.zeros(1), np.zeros(1), np.ones(1)),
        servo_mount(LidarMount()),
        np.zeros(16),
    )
    columns = drift_columns(placed, np.array([[0.0, 1.0, 0.0]]), np.array([3.0]))
    assert columns[0] == pytest.approx([0, 3, 0, 0, 0, 6])  # 3 s at 1 m/s along y; 3 s at 1 rad/s, 2 m out


def test_encoder_steps_are_smoothed_but_not_its_motion():
    t = np.arange(400) * 5 * MS
    true = np.radians(np.interp(t * 1e-9, [0.0, 1.0, 2.0], [0.0, 66.3, 0.0]))
    coarse = np.round(true / STEP_RAD) * STEP_RAD
    fine = smoothed(t, coarse, STEP_RAD)
    assert (fine - true)[20:180].std() < 0.4 * (coarse - true)[20:180].std()
    assert (fine - true)[30:170].std() < 0.08 * (coarse - true)[30:170].std()  # steady over half a second
    assert np.abs(fine - true).max() < 1.2 * STEP_RAD


def test_the_turntable_lags_and_its_side_is_unknown_after_a_reversal():
    position = np.radians([0.0, 1.0, 2.0, 3.0, 2.9, 2.6, 2.0, 1.0])
    play_side = np.empty(len(position))
    play_sides(position, math.radians(0.3), play_side)
    assert play_side[2:4] == pytest.approx([1.0, 1.0])
    assert np.isnan(play_side[4:6]).all()  # within the play, and just beyond
    assert play_side[6:] == pytest.approx([-1.0, -1.0])


def test_the_servo_is_looked_up_at_the_corrected_time():
    trace = ServoTrace(np.arange(40, dtype=np.int64) * 10 * MS, np.arange(40) * 0.1)
    mount = servo_mount(LidarMount(servo_time_offset_s=0.005))
    at = servo_at(trace, np.array([205 * MS, 210 * MS, 999 * MS]), mount, 0.1)
    assert at.position_rad[:2] == pytest.approx([2.0, 2.05])
    assert math.isnan(at.position_rad[2])
    assert at.rate_radps[:2] == pytest.approx([10.0, 10.0])


def test_repeated_and_late_states_are_omitted():
    trace = ServoTrace.of(np.array([0, 5, 5, 3, 9], dtype=np.int64) * MS, np.array([0, 1, 7, 8, 2]) * 0.1, STEP_RAD)
    assert trace.stamp_ns.tolist() == [0, 5 * MS, 9 * MS]


def wall(x_m=6.2, noise_m=0.008, count=4000, seed=0):
    rng = np.random.default_rng(seed)
    direction = np.column_stack([np.ones(count), rng.uniform(-0.3, 0.3, count), rng.uniform(-0.3, 0.3, count)])
    return direction * (x_m + rng.normal(0, noise_m, count))[:, None]


def test_a_wall_becomes_patches_with_its_normal_and_its_noise():
    xyz = wall()
    patches = find_patches(xyz, np.zeros_like(xyz), 0.003)
    assert len(patches.first) >= 3
    assert np.abs(patches.normal[:, 0]) == pytest.approx(np.ones(len(patches.first)), abs=0.01)
    assert patches.residual_m.std() == pytest.approx(0.008, rel=0.15)
    assert patches.on_plane_m[:, 0] == pytest.approx(np.full(len(patches.index), 6.2), abs=0.01)
    assert len(np.unique(patches.index)) == len(patches.index)  # no return is used twice


def test_outliers_do_not_tilt_a_patch_and_a_random_cloud_has_none():
    xyz = np.vstack([wall(), np.add(wall(seed=1)[:300], [0.3, 0.0, 0.0])])
    patches = find_patches(xyz, np.zeros_like(xyz), 0.003)
    assert (patches.index < 4000).mean() > 0.995
    cloud = np.random.default_rng(0).uniform(5, 8, (4000, 3))
    assert len(find_patches(cloud, np.zeros_like(cloud), 0.003).first) == 0


def test_the_motion_of_a_plane_is_projected_out():
    xyz = wall()
    patches = find_patches(xyz, np.zeros_like(xyz), 0.003)
    weight = np.random.default_rng(2).uniform(0.5, 2.0, len(patches.index))
    moved = patches.plane_basis @ [0.3, -0.2, 0.7]
    other = np.sin(40 * patches.on_plane_m[:, 1])
    left = without_planes(np.column_stack([moved, other]), weight, patches)
    assert np.abs(left[:, 0]).max() < 1e-9
    one = patches.patch == 1
    basis, target = patches.plane_basis[one] * weight[one, None], (other * weight)[one]
    by_hand = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
    assert left[one, 1] == pytest.approx(by_hand, abs=1e-9)


def test_scores_of_a_cluster_are_summed_before_they_are_squared():
    score = np.array([[1.0], [2.0], [5.0]])
    assert clustered(score, np.array([7, 7, 9]))[0, 0] == (1 + 2) ** 2 + 5**2


def test_static_upright_objects_match_best_without_a_shift():
    made = sweep(wrong_mount(), planes=YARD, count=30_000)
    placed = place(
        made.returns, servo_at(made.trace, made.returns.stamp_ns, wrong_mount(), 0.1), wrong_mount(), np.zeros(16)
    )
    stands = shift(placed.xyz_m, made.returns.stamp_ns)
    late = made.returns.stamp_ns > (made.returns.stamp_ns[0] + made.returns.stamp_ns[-1]) // 2
    assert stands is not None
    assert not stands.moved
    moved = shift(placed.xyz_m + np.where(late, 1.0, 0.0)[:, None] * [1.0, -0.6, 0.0], made.returns.stamp_ns)
    assert moved is not None
    assert moved.moved
    assert moved.best_m == pytest.approx((1.0, -0.6), abs=0.21)


def test_unobservable_parameters_are_named_whatever_the_scene():
    everything = Travel(0.0, 3.0, both_ways=True, two_speeds=True)
    assert set(unseen(everything)) == {"zero"}
    assert set(unseen(Travel(0.0, 3.0, both_ways=False, two_speeds=True))) == {"zero", "time", "play"}
    t = np.linspace(0, 1, 100)
    swept = Travel.of(t, np.where(t < 0.5, 1.0, -3.0))
    assert swept.both_ways
    assert swept.two_speeds
    assert not Travel.of(t, np.ones(100)).both_ways


def test_a_patch_excludes_the_margin_of_its_cell():
    xyz = wall(count=20_000)
    patches = find_patches(xyz, np.zeros_like(xyz), 0.003)
    for k in range(len(patches.first)):
        inside = patches.on_plane_m[patches.patch == k]
        assert np.ptp(inside[:, 1:], axis=0).max() <= 1.0 - 2 * 0.05 + 1e-9  # cells of 1 m from 6 m on


def test_errors_common_to_a_surface_increase_the_sigmas():
    true = wrong_mount()
    made = sweep(true, count=30_000)
    system = linearise(made.returns, made.trace, true, np.zeros(16), 0.0026, 0.1)
    assert system is not None
    surface = surfaces(system.patches)[system.patches.patch]
    assert 5 <= len(np.unique(surface)) < len(system.patches.first)
    rng = np.random.default_rng(3)
    size = np.abs(rng.normal(size=len(system.residual)))
    along = np.sign(system.columns[:, 0])  # all of a surface push one number the same way
    together = replace(system, residual=size * along * rng.choice([-1, 1], surface.max() + 1)[surface])
    separate = replace(system, residual=size * rng.choice([-1, 1], len(size)))
    moments = np.arange(len(size)) * 10**9  # no two returns at one moment
    wide, narrow = (np.diag(sandwich(each, moments, prior_information(16)))[0] for each in (together, separate))
    ratio = np.sqrt(wide / narrow)
    assert ratio > 5
