"""Preflight checks of the LiDAR on packets made by hand."""

from __future__ import annotations

import math

import pytest

from flow.link import Record
from links.lidar import Lidar, packet_format
from links.lidar.checks import clock_drift_ppm, lidar_checks
from links.preflight.check_result import Level
from links.simulated.sensors.lidar_packets import encode_position
from tests.links.preflight.observed import BEGIN_NS, by_name, levels, observe
from tests.links.preflight.preflight_peers import packet

FORM = packet_format("VLP-16")
PACKET_NS = FORM.packet_ns("strongest")


def packets(count, *, skip=(), mode="strongest", drift=0.0, step_ns=PACKET_NS):
    records = []
    for k in range(count):
        if k not in skip:
            at_ns = BEGIN_NS + k * step_ns
            data = packet(at_ns - round(drift * k * step_ns), mode)
            records.append(Record("/lidar/packets", at_ns, FORM.first_pulse_ns(at_ns, data), data))
    return records


def test_a_lidar_that_sends_all_its_packets_passes():
    found = levels(lidar_checks(observe(Lidar(), packets(800))))
    assert found == {"rate": "ok", "losses": "ok", "return mode": "ok", "clock": "ok"}


def test_a_dual_return_lidar_is_expected_to_send_twice_as_often():
    dual_ns = FORM.packet_ns("dual")
    assert levels(lidar_checks(observe(Lidar(), packets(800, mode="dual", step_ns=dual_ns))))["rate"] == "ok"
    slow = by_name(lidar_checks(observe(Lidar(), packets(800, mode="dual"))))
    assert slow["rate"].level is Level.FAIL
    assert "expected 1507" in slow["rate"].sentence


def test_an_absent_lidar_reports_the_status_of_its_link():
    status = "no packet on UDP 2368 for 2 s: is the LiDAR powered, and is this host on its subnet?"
    (result,) = lidar_checks(observe(Lidar(), [], status=status))
    assert (result.level, result.sentence) == (Level.FAIL, status)
    (result,) = lidar_checks(observe(Lidar(), [], live=False))
    assert "the recording holds nothing on /lidar/packets" in result.sentence


def test_packets_of_another_device_are_reported_as_rejected():
    noise = [Record("/lidar/packets", BEGIN_NS + k * PACKET_NS, BEGIN_NS + k * PACKET_NS, b"x" * 9) for k in range(50)]
    (result,) = lidar_checks(observe(Lidar(), noise))
    assert result.level is Level.FAIL
    assert "50 packets arrived" in result.sentence


@pytest.mark.parametrize(("lost", "level"), [(0, "ok"), (3, "warning"), (40, "fail")])
def test_lost_packets_are_rated_by_their_share(lost, level):
    found = by_name(lidar_checks(observe(Lidar(), packets(800, skip=range(100, 100 + lost)))))["losses"]
    assert found.level.value == level
    assert f"{lost} of 800 packets lost" in found.sentence


def test_foreign_packets_two_lidars_and_a_pulled_cable_are_reported():
    assert (
        levels(lidar_checks(observe(Lidar(), packets(800), counters={"from other senders": 7})))["sender"] == "warning"
    )
    found = by_name(lidar_checks(observe(Lidar(), packets(800, step_ns=PACKET_NS // 2))))["rate"]
    assert "do two LiDARs send" in found.sentence
    late = observe(Lidar(), packets(800), end_ns=BEGIN_NS + 5_000_000_000)
    assert by_name(lidar_checks(late))["rate"].level is Level.FAIL
    mixed = observe(Lidar(), packets(400) + packets(800, mode="last")[400:])
    assert by_name(lidar_checks(mixed))["return mode"].level is Level.FAIL
    assert levels(lidar_checks(observe(Lidar(), packets(400, mode="last"))))["return mode"] == "warning"


def test_the_drift_of_the_sensor_clock_is_reported_in_ppm():
    steady = [(k * 10_000_000, k * 10_000_000 % 3_600_000_000_000) for k in range(300)]
    assert clock_drift_ppm(steady) == 0
    assert math.isnan(clock_drift_ppm(steady[:100]))
    slow = [(host, round(host * (1 - 1e-3))) for host, _ in steady]
    assert clock_drift_ppm(slow) == pytest.approx(1000, rel=1e-3)
    over_the_hour = [(host, (host + 3_599_000_000_000) % 3_600_000_000_000) for host, _ in steady]
    assert clock_drift_ppm(over_the_hour) == 0
    assert levels(lidar_checks(observe(Lidar(), packets(2400, drift=1e-3))))["clock"] == "warning"


def test_utc_needs_a_locked_pps_and_free_does_not():
    position = Record("/lidar/position", BEGIN_NS, BEGIN_NS, encode_position(BEGIN_NS))
    free = Lidar(position_port=8308)
    utc = Lidar(clock="utc", position_port=8308, clock_limit_s=1800)
    assert levels(lidar_checks(observe(utc, packets(100))))["PPS"] == "fail"
    assert levels(lidar_checks(observe(free, packets(100))))["PPS"] == "warning"

    def with_position(link, data):
        source = observe(link, packets(100))
        source.observation.add(Record(position.topic, position.arrival_ns, position.stamp_ns, data))
        return by_name(lidar_checks(source))["PPS"]

    assert with_position(utc, position.data).level is Level.OK
    unlocked = bytearray(position.data)
    unlocked[202] = 1
    assert with_position(utc, bytes(unlocked)).level is Level.FAIL
    assert with_position(free, bytes(unlocked)).level is Level.OK
