"""Sweep: packets wait for their angle, a sweep ends after its travel, and nothing is extrapolated."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays, hash_into
from flow.stage import input_ports, output_ports
from stages.geometry.frames import LidarMount
from stages.messages import DepthImage, SweptPoints, SweptPulses
from stages.sweep.sweep import Sweep
from tests.stages.caster import Ball, seen, still, sweeping
from tests.stages.made import MS, ON_ITS_SIDE, PACKET_NS, START_NS, firings, servo

UP = [[0.0, 20.0, 0.0]]  # along azimuth 0: straight up when the lidar lies on its side


def run(stage, messages):
    out = []
    for message in messages:
        out += stage.on_servo(message) if hasattr(message, "goal_rad") else stage.on_firings(message)
    out += stage.finish()
    for message in out:
        check_arrays(message)
    return [m for m in out if isinstance(m, SweptPoints)], [m for m in out if isinstance(m, DepthImage)]


def driven(angle_deg_at, seconds, rate_hz=100, point=UP, silent=(math.inf, math.inf)):
    """Packets and servo states of a servo whose angle [deg] is a function of time [s], silent between two times."""
    packets, states = int(seconds * 1e9 / PACKET_NS), int(seconds * rate_hz) + 2
    events = [(START_NS + i * PACKET_NS, 1, firings(point, [START_NS + i * PACKET_NS])) for i in range(packets)]
    for k in range(states):
        t = k / rate_hz
        if not silent[0] < t < silent[1]:
            stamp_ns = START_NS + round(t * 1e9)
            events.append((stamp_ns, 0, servo(stamp_ns, math.radians(angle_deg_at(t)))))
    return [message for _, _, message in sorted(events, key=lambda event: event[:2])]


def back_and_forth(amplitude_deg, speed_degps):
    """A triangle wave from 0 to amplitude and back."""
    return lambda t: amplitude_deg - abs(speed_degps * t % (2 * amplitude_deg) - amplitude_deg)


def test_ports_are_what_the_graph_wires():
    assert list(input_ports(Sweep)) == ["firings", "servo"]
    assert set(output_ports(Sweep)) == {"swept_points", "swept_pulses", "depth_image"}
    assert Sweep.optional_inputs == {"servo"}


def test_a_packet_waits_for_a_newer_servo_state_and_packets_keep_their_order():
    stage = Sweep(mount=ON_ITS_SIDE)
    assert list(stage.on_servo(servo(START_NS, 0.0))) == []
    assert list(stage.on_firings(firings(UP, [START_NS + 1 * MS]))) == []
    assert list(stage.on_firings(firings(UP, [START_NS + 9 * MS]))) == []
    out = list(stage.on_servo(servo(START_NS + 10 * MS, 0.1)))
    assert [type(m) for m in out] == [SweptPoints, SweptPulses] * 2  # of each packet the returns, then all its pulses
    assert [m.stamp_ns - START_NS for m in out] == [1 * MS, 1 * MS, 9 * MS, 9 * MS]
    np.testing.assert_allclose([m.turntable_rad[0] for m in out[::2]], [0.01, 0.09], atol=1e-6)
    np.testing.assert_allclose([m.turntable_rad for m in out[1::2]], [0.01, 0.09], atol=1e-6)
    late = list(stage.on_firings(firings(UP, [START_NS + 9_500_000])))  # its angle is known already
    assert [m.stamp_ns for m in late] == [START_NS + 9_500_000] * 2


def test_a_slice_keeps_times_lasers_reflectivity_and_counts_pulses():
    stage = Sweep(mount=ON_ITS_SIDE)
    list(stage.on_servo(servo(START_NS, 0.0)))
    packet = firings([[0, 20, 0], [0, 0, 0], [0, 30, 0]], START_NS + np.array([1, 2, 3]) * MS)
    list(stage.on_firings(packet))
    points, pulses = stage.on_servo(servo(START_NS + 10 * MS, 0.0))
    assert points.pulses == pulses.range_m.size == 3
    assert points.laser.tolist() == [0, 2]
    assert points.reflectivity.tolist() == [0, 2]
    assert (points.point_stamp_ns - START_NS).tolist() == [1 * MS, 3 * MS]
    np.testing.assert_allclose(points.xyz_vehicle_m, [[0, 0, 20.35], [0, 0, 30.35]], atol=1e-5)
    np.testing.assert_allclose(points.origin_vehicle_m, (0, 0, 0.35))
    assert (points.unplaced, points.reason) == (0, "")


def test_a_dual_return_packet_counts_each_pulse_once():
    stage = Sweep(mount=LidarMount(turns=False))
    packet = firings([[0, 5, 0], [0, 6, 0]])
    object.__setattr__(packet, "return_kind", np.array([0, 1], dtype=np.uint8))
    points, pulses = stage.on_firings(packet)
    assert (points.pulses, len(points.xyz_vehicle_m), pulses.range_m.size) == (1, 2, 1)


def test_each_180_deg_sweep_back_and_forth_makes_one_image():
    slices, images = run(Sweep(mount=ON_ITS_SIDE), driven(back_and_forth(180.0, 90.0), 6.2))
    assert len(images) == 3
    assert [math.degrees(i.turned_rad) for i in images] == pytest.approx([177, 177, 177], abs=0.2)
    ends_s = [(i.stamp_ns - START_NS) / 1e9 for i in images]
    assert ends_s == pytest.approx([177 / 90, 2 + 177 / 90, 4 + 177 / 90], abs=0.02)
    assert (images[1].start_ns - START_NS) / 1e9 == pytest.approx(2.0, abs=0.02)  # begins where the servo turned back
    assert sum(len(s.xyz_vehicle_m) for s in slices) == pytest.approx(6.2e9 / PACKET_NS, abs=2)


def test_a_continuously_rotating_servo_makes_an_image_every_180_deg():
    _, images = run(Sweep(mount=ON_ITS_SIDE, tolerance_deg=0.0), driven(lambda t: 180.0 * t, 4.1))
    assert [(i.stamp_ns - START_NS) / 1e9 for i in images] == pytest.approx([1, 2, 3, 4], abs=0.01)


def test_vibration_never_makes_an_image():
    slices, images = run(Sweep(mount=ON_ITS_SIDE), driven(lambda t: 40 + 5 * math.sin(2 * math.pi * 17 * t), 3.0))
    assert images == []
    assert len(slices) > 2000


def test_encoder_jitter_does_not_interrupt_a_sweep():
    rng = np.random.default_rng(3)
    tick = 360 / 4096

    def angle_deg(t):  # 0.1 deg a state, so that one in four goes back
        return round((10 * t + rng.normal(0, 0.1)) / tick) * tick

    _, images = run(Sweep(mount=ON_ITS_SIDE, sweep_deg=20.0, tolerance_deg=1.0), driven(angle_deg, 2.1))
    assert len(images) == 1


def test_a_sweep_with_ramps_that_stops_short_within_the_tolerance_is_whole():
    def angle_deg(t, end):
        return end * (1 - math.cos(math.pi * min(t / 2.6, 1.0))) / 2

    short = [run(Sweep(mount=ON_ITS_SIDE), driven(lambda t, e=end: angle_deg(t, e), 3.5))[1] for end in (177.5, 176.5)]
    assert [len(images) for images in short] == [1, 0]


def test_returns_while_the_servo_is_at_rest_are_in_no_image():
    _, images = run(Sweep(mount=ON_ITS_SIDE), driven(lambda t: max(0.0, 90 * (t - 2.0)), 4.1))
    assert len(images) == 1
    assert (images[0].start_ns - START_NS) / 1e9 == pytest.approx(2.0, abs=0.02)


def test_returns_in_a_servo_gap_are_omitted_with_a_reason_and_the_sweep_restarts():
    slices, images = run(Sweep(mount=ON_ITS_SIDE), driven(lambda t: 90 * t, 2.1, silent=(1.0, 1.2)))
    lost = [s for s in slices if s.unplaced]
    assert sum(s.unplaced for s in lost) == pytest.approx(0.2e9 / PACKET_NS, abs=10)
    assert all("silent for 0.2" in s.reason for s in lost)
    assert all(1.0 <= (s.stamp_ns - START_NS) / 1e9 <= 1.2 for s in lost)
    assert images == []


def test_the_image_has_the_points_the_slices_had():
    ball = seen([Ball(still(2.0, -3.0, 12.0), 0.25)], sweeping(math.radians(90)), 2.1)
    slices, (image,) = run(Sweep(mount=ON_ITS_SIDE), ball)
    points = np.concatenate([s.xyz_vehicle_m for s in slices if image.start_ns <= s.stamp_ns <= image.stamp_ns])
    assert len(points) > 20
    assert image.points == image.returns == len(points)
    np.testing.assert_allclose(np.linalg.norm(points - [2, -3, 12], axis=1), 0.25, atol=1e-3)
    rows, columns = np.nonzero(image.depth_m)
    assert abs(columns.mean() + 0.5 - 256 - 2 / 11.75 * image.focal_px) < 2
    assert abs(rows.mean() + 0.5 - 256 + 3 / 11.75 * image.focal_px) < 2


def test_rotating_the_turntable_by_90_deg_rotates_the_points():
    def swept_points(zero_deg):
        mount = ON_ITS_SIDE.model_copy(update={"servo_zero_deg": zero_deg})
        points = [[5.0, 20.0, 1.0], [-3.0, 9.0, 2.0]]
        slices, _ = run(Sweep(mount=mount), driven(lambda t: 30 * t, 0.5, point=points[:1]))
        return np.concatenate([s.xyz_vehicle_m for s in slices])

    straight, turned = swept_points(0.0), swept_points(-90.0)
    np.testing.assert_allclose(turned, straight[:, [1, 0, 2]] * [-1, 1, 1], atol=1e-4)


def test_a_bolted_down_lidar_gives_an_image_each_revolution_without_a_servo():
    stage = Sweep(mount=LidarMount(turns=False))
    images = []
    for i in range(230):  # 75.35 packets a revolution
        azimuth = i * PACKET_NS / 1e8 * math.tau % math.tau
        out = stage.on_firings(firings([[1, 0, 8.0]], [START_NS + i * PACKET_NS], azimuth_rad=azimuth))
        images += [m for m in out if isinstance(m, DepthImage)]
    assert len(images) == 3
    assert [(i.stamp_ns - START_NS) / 1e8 for i in images] == pytest.approx([1, 2, 3], abs=0.04)
    assert all(i.turned_rad == 0.0 for i in images)
    assert images[0].depth_m.max() == 8.0


def test_packets_before_the_first_state_and_after_the_last_are_dropped_with_a_reason():
    slices, images = run(Sweep(mount=ON_ITS_SIDE), [firings(UP, [START_NS]), firings(UP, [START_NS + 50 * MS])])
    assert [s.unplaced for s in slices] == [1, 1]
    assert all("no servo state yet" in s.reason for s in slices)
    stage = Sweep(mount=ON_ITS_SIDE)
    messages = [servo(START_NS, 0.0), firings(UP, [START_NS + 5 * MS])]
    slices, images = run(stage, messages)
    assert "no servo state after" in slices[0].reason
    assert images == []


def test_the_queue_is_bounded_when_the_servo_never_answers():
    stage = Sweep(mount=ON_ITS_SIDE, max_wait_s=9.5e-9 * PACKET_NS)
    out = [m for i in range(50) for m in stage.on_firings(firings(UP, [START_NS + i * PACKET_NS]))]
    assert [m.range_m.size for m in out if isinstance(m, SweptPulses)] == [0] * 40  # without an angle, no direction
    assert len([m for m in out if isinstance(m, SweptPoints)]) == 40
    assert len(stage._waiting) == 10


def test_a_partial_sweep_makes_no_image_at_the_end():
    _, images = run(Sweep(mount=ON_ITS_SIDE), driven(lambda t: 90 * t, 1.9))
    assert images == []


def test_a_packet_without_pulses_is_nothing():
    assert list(Sweep(mount=ON_ITS_SIDE).on_firings(firings([]))) == []


def test_the_same_input_gives_the_same_bits():
    import hashlib

    digests = []
    for _ in range(2):
        hasher = hashlib.sha256()
        slices, images = run(Sweep(mount=ON_ITS_SIDE), driven(lambda t: 90 * t, 2.1))
        for message in [*slices, *images]:
            hash_into(hasher, hasher, message)
        digests.append(hasher.hexdigest())
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"mount": ON_ITS_SIDE, "fov_deg": 180.0},
        {"mount": ON_ITS_SIDE, "sweep_deg": 2.0, "tolerance_deg": 3.0},
        {"mount": ON_ITS_SIDE, "image_size_px": 8},
        {"mount": ON_ITS_SIDE, "max_servo_gap_s": 0.0},
        {"mount": ON_ITS_SIDE, "mistyped": 1},
    ],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises((ValidationError, ValueError)):
        Sweep(**settings)
