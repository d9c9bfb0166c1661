"""Each check of a preflight by records made by hand: good, bad, absent."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from flow.graph import load_graph
from flow.link import Record
from links.camera import Camera
from links.dynamixel import Servo
from links.preflight.camera import camera_checks
from links.preflight.lidar import clock_drift_ppm, lidar_checks
from links.preflight.preflight import odometry_check, rig_readout_ms, rig_size_px
from links.preflight.servo import servo_checks
from links.preflight.verdict import Level
from links.recording import CompressedImage, encode_compressed_image
from links.simulated.sensors.vlp16_packets import encode_position
from links.vehicle_odometry import VehicleOdometry
from links.velodyne import Lidar, vlp16
from tests.links.preflight.preflight_peers import hear, packet

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
BEGIN_NS = 1_748_773_230_000_000_000
PACKET_NS = vlp16.packet_ns(vlp16.STRONGEST)


def packets(count, *, skip=(), mode="strongest", drift=0.0, step_ns=PACKET_NS):
    records = []
    for k in range(count):
        if k not in skip:
            at_ns = BEGIN_NS + k * step_ns
            data = packet(at_ns - round(drift * k * step_ns), mode)
            records.append(Record("/lidar/packets", at_ns, vlp16.first_pulse_ns(at_ns, data), data))
    return records


def by_name(verdicts):
    return {v.name.removeprefix("it "): v for v in verdicts}


def levels(verdicts):
    return {name: v.level.value for name, v in by_name(verdicts).items()}


def test_a_lidar_that_sends_all_its_packets_is_good():
    found = levels(lidar_checks(hear(Lidar(), packets(800))))
    assert found == {"rate": "ok", "losses": "ok", "return mode": "ok", "clock": "ok"}


def test_a_dual_return_lidar_is_expected_to_send_twice_as_often():
    dual_ns = vlp16.packet_ns(vlp16.DUAL)
    assert levels(lidar_checks(hear(Lidar(), packets(800, mode="dual", step_ns=dual_ns))))["rate"] == "ok"
    slow = by_name(lidar_checks(hear(Lidar(), packets(800, mode="dual"))))
    assert slow["rate"].level is Level.FAIL
    assert "1507 are sent" in slow["rate"].sentence


def test_an_absent_lidar_says_what_its_link_says():
    told = "no packet on UDP 2368 for 2 s: is the lidar powered, and is this host on its subnet?"
    (verdict,) = lidar_checks(hear(Lidar(), [], status=told))
    assert (verdict.level, verdict.sentence) == (Level.FAIL, told)
    (verdict,) = lidar_checks(hear(Lidar(), [], live=False))
    assert "the recording holds nothing on /lidar/packets" in verdict.sentence


def test_packets_that_are_no_lidars_are_named_as_refused():
    noise = [Record("/lidar/packets", BEGIN_NS + k * PACKET_NS, BEGIN_NS + k * PACKET_NS, b"x" * 9) for k in range(50)]
    (verdict,) = lidar_checks(hear(Lidar(), noise))
    assert verdict.level is Level.FAIL
    assert "50 packets came" in verdict.sentence


@pytest.mark.parametrize(("lost", "level"), [(0, "ok"), (3, "warning"), (40, "fail")])
def test_lost_packets_are_judged_by_their_share(lost, level):
    found = by_name(lidar_checks(hear(Lidar(), packets(800, skip=range(100, 100 + lost)))))["losses"]
    assert found.level.value == level
    assert f"{lost} of 800 packets lost" in found.sentence


def test_foreign_packets_two_lidars_and_a_cable_pulled_are_noticed():
    assert levels(lidar_checks(hear(Lidar(), packets(800), counters={"from other senders": 7})))["sender"] == "warning"
    found = by_name(lidar_checks(hear(Lidar(), packets(800, step_ns=PACKET_NS // 2))))["rate"]
    assert "do two lidars send" in found.sentence
    late = hear(Lidar(), packets(800), end_ns=BEGIN_NS + 5_000_000_000)
    assert by_name(lidar_checks(late))["rate"].level is Level.FAIL
    mixed = hear(Lidar(), packets(400) + packets(800, mode="last")[400:])
    assert by_name(lidar_checks(mixed))["return mode"].level is Level.FAIL
    assert levels(lidar_checks(hear(Lidar(), packets(400, mode="last"))))["return mode"] == "warning"


def test_a_clock_that_runs_away_is_told_in_millionths():
    steady = [(k * 10_000_000, k * 10_000_000 % 3_600_000_000_000) for k in range(300)]
    assert clock_drift_ppm(steady) == 0
    assert math.isnan(clock_drift_ppm(steady[:100]))
    slow = [(host, round(host * (1 - 1e-3))) for host, _ in steady]
    assert clock_drift_ppm(slow) == pytest.approx(1000, rel=1e-3)
    over_the_hour = [(host, (host + 3_599_000_000_000) % 3_600_000_000_000) for host, _ in steady]
    assert clock_drift_ppm(over_the_hour) == 0
    assert levels(lidar_checks(hear(Lidar(), packets(2400, drift=1e-3))))["clock"] == "warning"


def test_utc_needs_a_locked_pps_and_free_does_not():
    position = Record("/lidar/position", BEGIN_NS, BEGIN_NS, encode_position(BEGIN_NS))
    free = Lidar(position_port=8308)
    utc = Lidar(clock="utc", position_port=8308, clock_limit_s=1800)
    assert levels(lidar_checks(hear(utc, packets(100))))["PPS"] == "fail"
    assert levels(lidar_checks(hear(free, packets(100))))["PPS"] == "warning"

    def with_position(link, data):
        heard = hear(link, packets(100))
        heard.seen.take(Record(position.topic, position.arrival_ns, position.stamp_ns, data))
        return by_name(lidar_checks(heard))["PPS"]

    assert with_position(utc, position.data).level is Level.OK
    unlocked = bytearray(position.data)
    unlocked[202] = 1
    assert with_position(utc, bytes(unlocked)).level is Level.FAIL
    assert with_position(free, bytes(unlocked)).level is Level.OK


def states(count=500, *, position_deg=90.0, error=0, step_ns=4_000_000):
    data = {"position_rad": math.radians(position_deg), "velocity_radps": 0.0, "goal_rad": 0.0, "error": error}
    at_ns = [BEGIN_NS + k * step_ns for k in range(count)]
    return [Record("/servo/state", at, at - 500_000, json.dumps(data).encode()) for at in at_ns]


HEALTH = {"reads": 500, "connected": 1, "voltage_mv": 12_000, "temperature_c": 35}


def test_a_healthy_servo_is_good():
    found = levels(servo_checks(hear(Servo(), states(), counters=HEALTH)))
    assert found == {"answers": "ok", "position": "ok", "errors": "ok", "exchanges": "ok", "supply": "ok"}


@pytest.mark.parametrize(
    ("records", "counters", "check", "words"),
    [
        (states(step_ns=50_000_000), {}, "answers", "20 a second"),
        (states(position_deg=200.0), {}, "position", "outside limits_deg 0 to 180"),
        (states(error=0x20), {}, "errors", "overload in 500 of 500"),
        (states(), {"connected": 0}, "exchanges", "does not hold"),
        (states(), {"voltage_mv": 9_000}, "supply", "9.0 V"),
        (states(), {"temperature_c": 79}, "supply", "79 deg C"),
    ],
)
def test_a_servo_that_is_not_fit_to_fly_is_no_go(records, counters, check, words):
    found = by_name(servo_checks(hear(Servo(), records, counters=HEALTH | counters)))[check]
    assert found.level is Level.FAIL
    assert words in found.sentence


def test_a_servo_that_fell_silent_is_no_go_and_damaged_answers_are_to_look_at():
    heard = hear(Servo(), states(), counters=HEALTH, end_ns=BEGIN_NS + 5_000_000_000)
    assert "fell silent for 3.0 s" in by_name(servo_checks(heard))["answers"].sentence
    damaged = hear(Servo(), states(), counters=HEALTH | {"damaged": 20})
    assert by_name(servo_checks(damaged))["exchanges"].level is Level.WARNING
    slow = hear(Servo(), states(step_ns=8_000_000), counters=HEALTH)
    assert by_name(servo_checks(slow))["answers"].level is Level.WARNING


def test_an_absent_servo_says_what_its_link_says():
    (verdict,) = servo_checks(hear(Servo(), [], status="/dev/ttyUSB0: the servo does not answer"))
    assert (verdict.level, verdict.sentence) == (Level.FAIL, "/dev/ttyUSB0: the servo does not answer")
    (verdict,) = servo_checks(hear(Servo(), [Record("/servo/state", 1, 1, b"{}")]))
    assert "1 records came that hold no state" in verdict.sentence


def pictures(size=64, step_ns=50_000_000, count=40):
    jpeg = cv2.imencode(".jpg", np.zeros((size, size), np.uint8))[1].tobytes()
    at_ns = [BEGIN_NS + k * step_ns for k in range(count)]
    return [
        Record("/camera/drone", at, at, encode_compressed_image(CompressedImage(at, "camera_drone", jpeg)))
        for at in at_ns
    ]


def test_a_camera_is_judged_by_its_rate_and_the_rigs_size():
    link = Camera(topic="/camera/drone")
    good = by_name(camera_checks(hear(link, pictures()), (64, 64), 0.0))
    assert {v.level for v in good.values()} == {Level.OK}
    assert "20.0 a second" in good["frames"].sentence
    other = by_name(camera_checks(hear(link, pictures(size=80)), (64, 64), 0.0))["size"]
    assert other.level is Level.FAIL
    assert "80 x 80, but the lens is calibrated for 64 x 64" in other.sentence
    assert levels(camera_checks(hear(link, pictures()), None, 0.0))["size"] == "warning"
    assert levels(camera_checks(hear(link, pictures(step_ns=100_000_000)), (64, 64), 0.0))["frames"] == "warning"
    assert levels(camera_checks(hear(link, pictures(step_ns=2_000_000_000)), (64, 64), 0.0))["frames"] == "fail"


def test_how_long_a_cameras_rows_take_is_asked_for_where_neither_rig_nor_link_says_it():
    link = Camera(topic="/camera/drone")
    silent = by_name(camera_checks(hear(link, pictures()), (64, 64), rig_readout_ms({}, link)))["readout"]
    assert silent.level is Level.WARNING
    assert "set cameras.drone.readout_ms" in silent.sentence
    rig = {"cameras": {"drone": {"readout_ms": 0}, "vehicle": {"readout_ms": 12.5}}}
    assert rig_readout_ms(rig, link) == 0
    assert rig_readout_ms(rig, Camera(topic="/camera/vehicle")) == 12.5
    assert rig_readout_ms({}, Camera(topic="/camera/vehicle", readout_ms=8)) == 8
    told = by_name(camera_checks(hear(link, pictures()), (64, 64), 8.0))["readout"]
    assert (told.level, told.sentence) == (Level.OK, "8 ms from the first row to the last")
    at_once = by_name(camera_checks(hear(link, pictures()), (64, 64), 0.0))["readout"]
    assert (at_once.level, at_once.sentence) == (Level.OK, "all rows at once")


@pytest.mark.parametrize("source", ["/dev/video0", "rtsp://192.168.1.9/live", "http://127.0.0.1:8091/"])
def test_how_old_a_live_cameras_pictures_are_is_asked_for_where_nothing_is_set(source):
    def checked(live=True, **settings):
        link = Camera(topic="/camera/drone", **settings)
        return by_name(camera_checks(hear(link, pictures(), live=live), (64, 64), 0.0))

    unset = checked(source=source)["latency"]
    assert unset.level is Level.WARNING
    assert "film a clock on this host's screen, and set it.latency_s" in unset.sentence
    told = checked(source=source, latency_s=0.06)["latency"]
    assert (told.level, told.sentence) == (Level.OK, "60 ms from a picture's exposure to its arrival")
    assert "latency" not in checked(source=source, live=False)  # a recording's stamps are what they are
    assert "latency" not in checked(source="film.mp4")  # a file's are its own


def test_the_field_configuration_leaves_its_cameras_latency_to_be_set():
    nodes = load_graph(CONFIGS / "field.yaml").nodes
    for name in ("camera_vehicle", "camera_drone"):
        assert nodes[name].config["latency_s"] == 0
        assert levels(camera_checks(hear(nodes[name].build(), pictures()), (64, 64), 0.0))["latency"] == "warning"


def test_a_camera_and_an_odometry_that_fell_silent_are_no_go():
    """Their rate, from the first record to the last, is that of a healthy one."""
    later_ns = BEGIN_NS + 5_000_000_000
    found = by_name(camera_checks(hear(Camera(topic="/camera/drone"), pictures(), end_ns=later_ns), (64, 64), 0.0))
    assert found["frames"].level is Level.FAIL
    assert "then none came for 3.1 s" in found["frames"].sentence
    slow = hear(Camera(topic="/camera/drone"), pictures(step_ns=800_000_000, count=7), end_ns=later_ns + 800_000_000)
    assert by_name(camera_checks(slow, (64, 64), 0.0))["frames"].level is not Level.OK
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()
    poses = [Record("/vehicle/odometry", BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000, pose) for k in range(40)]
    there = VehicleOdometry(port=14600)
    died = odometry_check(hear(there, poses, end_ns=later_ns), there)
    assert died.level is Level.FAIL
    assert "is its sender still running?" in died.sentence


def test_a_camera_without_pictures_is_no_go():
    link = Camera(topic="/camera/drone")
    (verdict,) = camera_checks(hear(link, [], status="there is no /dev/video9"), (64, 64), 0.0)
    assert (verdict.level, verdict.sentence) == (Level.FAIL, "there is no /dev/video9")
    (verdict,) = camera_checks(hear(link, [Record("/camera/drone", 1, 1, b"no picture")]), (64, 64), 0.0)
    assert "1 records came that hold no picture" in verdict.sentence


def test_the_rigs_size_is_the_links_own_or_that_of_the_camera_of_its_name():
    rig = {"cameras": {"drone": {"size_px": [640, 480]}, "vehicle": {"size_px": 720}}}
    assert rig_size_px(rig, Camera(topic="/camera/drone")) == (640, 480)
    assert rig_size_px(rig, Camera(topic="/camera/vehicle")) == (720, 720)
    assert rig_size_px(rig, Camera(topic="/camera/vehicle", size_px=64)) == (64, 64)
    assert rig_size_px({}, Camera(topic="/camera/vehicle")) is None


def test_the_vehicles_odometry_may_be_missing_where_it_has_no_port():
    pose = json.dumps({"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}).encode()
    poses = [Record("/vehicle/odometry", BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000, pose) for k in range(40)]
    old = [Record(r.topic, r.arrival_ns + 300_000_000, r.stamp_ns, r.data) for r in poses]
    there, none = VehicleOdometry(port=14600), VehicleOdometry()
    assert odometry_check(hear(none, []), none).level is Level.WARNING
    assert odometry_check(hear(there, []), there).level is Level.FAIL
    assert odometry_check(hear(there, poses), there).level is Level.OK
    assert odometry_check(hear(there, old), there).level is Level.WARNING
    noise = [Record("/vehicle/odometry", r.arrival_ns, r.stamp_ns, b"{}") for r in poses]
    assert odometry_check(hear(VehicleOdometry(port=14600), noise), there).level is Level.FAIL
