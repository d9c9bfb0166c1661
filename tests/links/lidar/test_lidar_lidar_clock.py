"""Device time to host time: exact where possible, otherwise with a bounded error; disagreements are counted."""

import numpy as np
import pytest
from hand_built import HOUR_NS, ONE_PACKET_MS, SINGLE_PACKET_NS, captured_records

from links.lidar import Lidar
from links.lidar.lidar_clock import LidarClock, PacketTime
from links.lidar.reject_reason import PacketRejectReason

START_NS = 1_700_000_000_000_000_123


def device_us(true_ns, phase_ns=0):
    return (true_ns + phase_ns) % HOUR_NS // 1_000


def stamps_of(clock, true_ns, late_ns, phase_ns=0):
    times = [clock.read(device_us(t, phase_ns), t + late) for t, late in zip(true_ns, late_ns, strict=True)]
    assert all(isinstance(time, PacketTime) for time in times)
    return np.array([time.stamp_ns for time in times])


@pytest.mark.parametrize("mode", ["free", "utc"])
def test_exact_stamps_stay_exact_to_the_ns_through_the_hour(mode):
    start_ns = START_NS // HOUR_NS * HOUR_NS + HOUR_NS - 500 * SINGLE_PACKET_NS + 77
    true_ns = [start_ns + k * SINGLE_PACKET_NS for k in range(1_000)]
    clock = LidarClock(mode)
    assert stamps_of(clock, true_ns, [0] * 1_000).tolist() == true_ns
    assert clock.disagreements == 0


def test_a_free_clock_follows_the_fastest_packets_not_the_first():
    random = np.random.default_rng(3)
    true_ns = [START_NS + k * SINGLE_PACKET_NS for k in range(2_000)]
    late_ns = random.exponential(200_000, 2_000).astype(int).tolist()
    late_ns[0] = 5_000_000
    errors_ns = stamps_of(LidarClock(), true_ns, late_ns, phase_ns=987_654_321) - np.array(true_ns)
    assert errors_ns[0] == 5_000_000
    assert abs(errors_ns[100:]).max() < 50_000


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_a_free_clock_that_drifts_is_followed(drift):
    random = np.random.default_rng(4)
    true_ns = [START_NS + k * SINGLE_PACKET_NS for k in range(20_000)]
    late_ns = random.exponential(100_000, 20_000).astype(int)
    clock = LidarClock()
    errors_ns = []
    for k, t in enumerate(true_ns):
        time = clock.read(device_us(t + int(drift * k * SINGLE_PACKET_NS)), t + int(late_ns[k]))
        assert isinstance(time, PacketTime)
        errors_ns.append(time.stamp_ns - t)
    assert abs(np.array(errors_ns[100:])).max() < 120_000  # 26 s at 100 ppm would be 2.6 ms


def test_a_delayed_packet_keeps_its_own_time():
    true_ns = [START_NS + k * SINGLE_PACKET_NS for k in range(100)]
    late_ns = [0] * 50 + [300_000_000] + [0] * 49
    errors_ns = stamps_of(LidarClock(), true_ns, late_ns) - np.array(true_ns)
    assert abs(errors_ns).max() < 3_000


def test_a_small_step_of_the_hosts_clock_is_followed_within_a_second():
    true_ns = [START_NS + k * SINGLE_PACKET_NS for k in range(2_000)]
    errors_ns = stamps_of(LidarClock(), true_ns, [0] * 500 + [100_000_000] * 1_500) - np.array(true_ns)
    assert (errors_ns[500 + 754 :] == 100_000_000).all()


def test_a_gap_is_bridged_by_the_device_clock_and_old_offsets_are_dropped():
    clock = LidarClock()
    clock.read(device_us(START_NS), START_NS)
    after_ns = START_NS + 60_000_000_000
    assert clock.read(device_us(after_ns), after_ns + 3_000_000) == PacketTime(after_ns + 3_000_000, 60_000_000_000)
    assert clock.disagreements == 0


@pytest.mark.parametrize("jump_ns", [2_000_000_000, -2_000_000_000, 900_000_000_000])
def test_a_step_of_the_device_clock_resets_the_offset_and_is_counted(jump_ns):
    clock = LidarClock()
    clock.read(device_us(START_NS), START_NS)
    after_ns = START_NS + SINGLE_PACKET_NS
    time = clock.read(device_us(after_ns, jump_ns), after_ns)
    assert time == PacketTime(after_ns, 0)
    assert clock.disagreements == 1
    later_ns = after_ns + SINGLE_PACKET_NS
    assert clock.read(device_us(later_ns, jump_ns), later_ns).stamp_ns == later_ns


def test_a_small_backward_step_of_the_device_clock_does_not_stop_the_stream():
    clock = LidarClock()
    clock.read(device_us(START_NS), START_NS)
    after_ns = START_NS + SINGLE_PACKET_NS
    assert clock.read(device_us(after_ns, -200_000_000), after_ns) == PacketTime(after_ns, 0)
    assert clock.disagreements == 1


@pytest.mark.parametrize("mode", ["free", "utc"])
def test_repeated_and_overtaken_packets_are_out_of_order(mode):
    clock = LidarClock(mode)
    first, second = START_NS, START_NS + SINGLE_PACKET_NS
    clock.read(device_us(first), first)
    clock.read(device_us(second), second)
    assert clock.read(device_us(second), second + 90_000) is PacketRejectReason.ORDER
    assert clock.read(device_us(first), second + 90_000) is PacketRejectReason.ORDER


@pytest.mark.parametrize("late_ns", [400_000_000, -400_000_000])
def test_utc_uses_the_device_time_in_the_hour_nearest_to_the_host(late_ns):
    for true_ns in (START_NS // HOUR_NS * HOUR_NS + 1_000, START_NS // HOUR_NS * HOUR_NS - 1_000):
        time = LidarClock("utc").read(device_us(true_ns), true_ns + late_ns)
        assert time == PacketTime(true_ns, 0)


def test_utc_rejects_times_that_disagree_with_the_host():
    clock = LidarClock("utc", limit_ns=500_000_000)
    assert clock.read(device_us(START_NS), START_NS + 600_000_000) is PacketRejectReason.CLOCK
    assert clock.disagreements == 1


def test_the_gap_counts_device_time_through_the_hour():
    clock = LidarClock()
    clock.read(3_599_999_000, START_NS)
    assert clock.read(327, START_NS + 1_327_000) == PacketTime(START_NS + 1_327_000, 1_327_000)


def test_a_real_sensor_and_host_agree_to_their_network_jitter():
    records = list(captured_records("vlp16_strongest_gps_mrpt"))
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    late_us = np.array([1e-3 * (r.stamp_ns - lidar.decode(r).stamp_ns) for r in records])
    assert lidar.counters["clock disagreements"] == 0
    assert late_us.min() >= 0
    assert late_us.max() < 150
