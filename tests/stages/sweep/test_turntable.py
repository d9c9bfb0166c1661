"""Angles between servo states, and points turned with them: by hand, with offset, sign, zero and harmonics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import Harmonic, LidarMount, Pose, rotation_from_rpy_deg
from stages.sweep.turntable import STATES_KEPT, Turntable
from tests.stages.caster import LASER, PULSE_NS, beams_lidar, beams_vehicle, packet
from tests.stages.made import MS, ON_ITS_SIDE, START_NS, firings, servo

ASKEW = LidarMount(
    T_vehicle_turntable=Pose(xyz_m=(0.3, -0.2, 0.5), rpy_deg=(2.0, -3.0, 40.0)),
    T_turntable_lidar=Pose(xyz_m=(0.01, 0.02, 0.1), rpy_deg=(88.0, 1.0, -2.0)),
    servo_sign=-1,
    servo_zero_deg=12.0,
    servo_harmonics=(Harmonic(order=1, amplitude_deg=0.5, phase_deg=20.0),),
)


def turntable(mount=ON_ITS_SIDE, max_gap_s=0.1, min_range_m=0.6, states=()):
    table = Turntable(mount, max_gap_s, min_range_m)
    for stamp_ns, position_rad in states:
        table.add(servo(START_NS + stamp_ns, position_rad))
    return table


def angle_rad(table, t_ns):
    return float(table.turns(np.array([t_ns], dtype=np.int64))[0, 0])


def returns_of(table, packet):
    return table.place(packet, table.turns(packet.pulse_stamp_ns))[0]


def pulses_of(table, packet):
    return table.place(packet, table.turns(packet.pulse_stamp_ns))[1]


def test_the_angle_is_linear_between_the_neighbouring_states():
    table = turntable(states=[(0, 0.2), (10 * MS, 0.4), (20 * MS, 1.0)])
    assert angle_rad(table, START_NS + int(2.5 * MS)) == pytest.approx(0.25)
    assert angle_rad(table, START_NS + 10 * MS) == pytest.approx(0.4)
    assert angle_rad(table, START_NS + 15 * MS) == pytest.approx(0.7)


def test_nothing_is_extrapolated_and_long_gaps_are_not_bridged():
    table = turntable(states=[(0, 0.0), (100 * MS, 1.0), (201 * MS, 2.0), (210 * MS, 2.1)])
    assert angle_rad(table, START_NS + 50 * MS) == pytest.approx(0.5)  # a gap of exactly 0.1 s is allowed
    for t in (-1, 150 * MS, 210 * MS + 1):
        assert math.isnan(angle_rad(table, START_NS + t))
    assert angle_rad(table, START_NS + 201 * MS) == 2.0  # the state itself is known
    assert "silent for 0.101 s" in table.why_unknown(START_NS + 150 * MS)
    assert "no servo state before" in table.why_unknown(START_NS - 1)
    assert "no servo state after" in table.why_unknown(START_NS + 211 * MS)
    assert "wired" in turntable().why_unknown(START_NS)


def test_a_single_turn_encoder_is_unwrapped():
    table = turntable(states=[(0, math.tau - 0.1), (10 * MS, 0.1), (20 * MS, 0.3)])
    assert angle_rad(table, START_NS + 5 * MS) == pytest.approx(math.tau)
    assert angle_rad(table, START_NS + 15 * MS) == pytest.approx(math.tau + 0.2)
    back = turntable(states=[(0, 0.1), (10 * MS, math.tau - 0.1)])
    assert angle_rad(back, START_NS + 5 * MS) == pytest.approx(0.0)


def test_time_offset_sign_zero_and_harmonics_follow_the_mount():
    mount = LidarMount(
        servo_sign=-1,
        servo_zero_deg=30.0,
        servo_time_offset_s=0.004,
        servo_harmonics=(Harmonic(order=2, amplitude_deg=1.0, phase_deg=15.0),),
    )
    table = turntable(mount, states=[(0, 0.5), (10 * MS, 0.5)])
    expected = -(0.5 - math.radians(30)) - math.radians(1.0) * math.sin(2 * 0.5 + math.radians(15))
    assert angle_rad(table, START_NS + 4 * MS) == pytest.approx(expected)
    assert angle_rad(table, START_NS + 14 * MS) == pytest.approx(expected)
    assert math.isnan(angle_rad(table, START_NS + 3 * MS))  # the state was true 4 ms after its stamp


def test_a_repeated_or_older_state_is_ignored():
    table = turntable(states=[(0, 0.0), (10 * MS, 1.0), (10 * MS, 5.0), (5 * MS, 5.0)])
    assert table.known_until_ns == START_NS + 10 * MS
    assert angle_rad(table, START_NS + 10 * MS) == 1.0


def test_a_point_is_turned_by_hand():
    # lidar +y (azimuth 0) -> rpy 90,0,0 -> turntable +z; lidar +x stays +x, then turns to +y at 90 deg
    table = turntable(states=[(0, math.pi / 2), (10 * MS, math.pi / 2)])
    placed = returns_of(table, firings([[0, 20, 0], [7, 0, 0], [0, 0, 9]]))
    expected = [[0, 0, 0.35 + 20], [0, 7, 0.35], [9, 0, 0.35]]  # lidar +z -> turntable -y -> vehicle +x
    np.testing.assert_allclose(placed.xyz_vehicle_m, expected, atol=1e-5)
    np.testing.assert_allclose(placed.turntable_rad, math.pi / 2)


def test_each_pulse_turns_with_the_angle_at_its_own_time():
    table = turntable(states=[(0, 0.0), (10 * MS, math.pi / 2)])
    packet = firings([[10, 0, 0]] * 3, START_NS + np.array([0, 5, 10]) * MS)
    placed = returns_of(table, packet)
    angle = np.array([0, math.pi / 4, math.pi / 2])
    expected = np.c_[10 * np.cos(angle), 10 * np.sin(angle), np.full(3, 0.35)]
    np.testing.assert_allclose(placed.xyz_vehicle_m, expected, atol=1e-5)
    np.testing.assert_allclose(placed.turntable_rad, angle, atol=1e-6)


def test_the_whole_chain_equals_the_matrices():
    mount = ASKEW.model_copy(update={"servo_sign": 1, "servo_zero_deg": 0.0, "servo_harmonics": ()})
    table = turntable(mount, states=[(0, 0.7), (10 * MS, 0.7)])
    points = np.random.default_rng(0).normal(size=(50, 3)) * 20
    placed = returns_of(table, firings(points))
    T = mount.T_vehicle_turntable.matrix()
    Rz = np.eye(4)
    Rz[:3, :3] = rotation_from_rpy_deg((0, 0, math.degrees(0.7)))
    T = T @ Rz @ mount.T_turntable_lidar.matrix()
    np.testing.assert_allclose(placed.xyz_vehicle_m, points @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    np.testing.assert_allclose(placed.origin_vehicle_m, T[:3, 3])


def test_only_returns_beyond_the_least_range_are_placed():
    table = turntable(states=[(0, 0.0), (10 * MS, 0.0)])
    placed = returns_of(table, firings([[0, 0, 0], [0.5, 0, 0], [0.7, 0, 0], [0, 0, 0], [3, 0, 0]]))
    np.testing.assert_allclose(np.linalg.norm(placed.xyz_vehicle_m - (0, 0, 0.35), axis=1), [0.7, 3.0], rtol=1e-6)
    assert placed.unplaced == 0


def test_returns_without_an_angle_are_counted_and_omitted():
    table = turntable(states=[(0, 0.0), (10 * MS, 0.0)])
    packet = firings([[5, 0, 0], [5, 0, 0], [0, 0, 0], [5, 0, 0]], START_NS + np.array([-1, 5, 20, 30]) * MS)
    placed = returns_of(table, packet)
    assert placed.point_stamp_ns.tolist() == [START_NS + 5 * MS]
    assert placed.unplaced == 2  # the pulse without return lost nothing


def test_a_bolted_down_lidar_needs_no_servo():
    table = turntable(LidarMount(turns=False, T_turntable_lidar=Pose(xyz_m=(0, 0, 1.0))))
    placed = returns_of(table, firings([[5, 1, 2]]))
    np.testing.assert_allclose(placed.xyz_vehicle_m, [[5, 1, 3]])
    assert placed.unplaced == 0


def test_memory_is_bounded_when_no_packet_comes():
    table = turntable(states=[(i * MS, 0.0) for i in range(3 * STATES_KEPT)])
    assert len(table._states) == STATES_KEPT


def test_states_that_no_pulse_needs_are_forgotten():
    table = turntable(states=[(i * 10 * MS, 0.1 * i) for i in range(10)])
    table.forget_before(START_NS + 45 * MS)
    assert table._states[0][0] == START_NS + 40 * MS
    assert angle_rad(table, START_NS + 45 * MS) == pytest.approx(0.45)


@pytest.mark.parametrize("mount", [ON_ITS_SIDE, ASKEW])
def test_a_pulse_without_return_has_the_direction_of_its_beam(mount):
    table = turntable(mount, states=[(0, 0.7), (10 * MS, 0.7)])
    ranges_m = np.full(384, 20.0)
    met = pulses_of(table, packet(START_NS + PULSE_NS, ranges_m))
    free = pulses_of(table, packet(START_NS + PULSE_NS, np.zeros(384)))
    np.testing.assert_allclose(free.direction_vehicle, met.direction_vehicle, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(free.direction_vehicle, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(met.range_m, ranges_m, rtol=1e-6)
    assert not free.range_m.any()


def test_each_pulse_has_the_direction_of_the_rotating_beam_at_its_own_time():
    table = turntable(ASKEW, states=[(0, 0.2), (10 * MS, 0.8)])  # 573 deg/s: 0.4 deg from first to last pulse
    stamp_ns = START_NS + PULSE_NS
    pulses = pulses_of(table, packet(stamp_ns, np.zeros(384)))
    states_rad = ASKEW.turntable_rad(np.array([0.2, 0.8]))
    angle = np.interp(PULSE_NS, [0, 10 * MS], states_rad)  # of the table: linear between the states
    plain = LidarMount(T_vehicle_turntable=ASKEW.T_vehicle_turntable, T_turntable_lidar=ASKEW.T_turntable_lidar)
    origin_m, direction = beams_vehicle(plain, angle, beams_lidar(stamp_ns, LASER))
    np.testing.assert_allclose(pulses.direction_vehicle, direction, atol=1e-6)
    np.testing.assert_allclose(pulses.origin_vehicle_m, origin_m[192], atol=1e-9)
    assert pulses.turntable_rad == pytest.approx(angle[192])


def test_each_pulse_keeps_its_time_laser_and_reflectivity():
    table = turntable(states=[(0, 0.0), (10 * MS, 0.0)])
    pulses = pulses_of(table, firings([[0, 20, 0], [0, 0, 0], [0, 30, 0]], START_NS + np.array([1, 2, 3]) * MS))
    assert (pulses.point_stamp_ns - START_NS).tolist() == [1 * MS, 2 * MS, 3 * MS]
    assert pulses.laser.tolist() == pulses.reflectivity.tolist() == [0, 1, 2]
    assert pulses.range_m.tolist() == [20.0, 0.0, 30.0]


@pytest.mark.parametrize(
    ("strongest_m", "last_m", "expected_m", "reflectivity"),
    [(20.0, 30.0, 20.0, 0), (30.0, 20.0, 20.0, 1), (0.0, 20.0, 20.0, 1), (20.0, 0.0, 20.0, 0), (0.0, 0.0, 0.0, 0)],
)
def test_of_two_returns_of_a_pulse_the_nearer_counts(strongest_m, last_m, expected_m, reflectivity):
    table = turntable(states=[(0, 0.0), (10 * MS, 0.0)])
    both = firings([[0, strongest_m, 0], [0, last_m, 0], [0, 40, 0]], START_NS + np.array([1, 1, 2]) * MS)
    object.__setattr__(both, "return_kind", np.array([0, 1, 0], dtype=np.uint8))
    pulses = pulses_of(table, both)
    assert pulses.range_m.tolist() == [expected_m, 40.0]
    assert pulses.reflectivity.tolist() == [reflectivity, 2]


def test_a_packet_whose_angle_is_not_known_for_every_pulse_gives_no_pulses():
    table = turntable(states=[(0, 0.0), (10 * MS, 0.0)])
    for stamps in ([5, 11], [-1, 5], [20, 21]):
        pulses = pulses_of(table, firings([[5, 0, 0], [0, 0, 0]], START_NS + np.array(stamps) * MS))
        assert pulses.range_m.size == pulses.laser.size == len(pulses.direction_vehicle) == 0
    assert math.isnan(pulses.turntable_rad)
    assert pulses_of(table, firings([[5, 0, 0], [0, 0, 0]], START_NS + np.array([5, 6]) * MS)).range_m.size == 2
