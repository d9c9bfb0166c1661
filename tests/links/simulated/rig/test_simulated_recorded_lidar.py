"""A live rig with the LiDAR packets of a recording: sent unchanged, while the servo moves as it was recorded."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

from flow.link import LinkError
from links.dynamixel import Servo
from links.lidar import Lidar
from links.recording import RecordingReader
from stages.messages import ServoGoal
from tests.links.ports import free_ports
from tests.links.simulated.rig.test_simulated_live_rig import SCENARIO as LIVE_SMALL

pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")

from links.simulated.rig.live_process import RealTimeRig
from links.simulated.rig.live_rig import LiveRigSettings
from links.simulated.rig.recorded_lidar import RecordedLidar, RecordedServo
from links.simulated.rig.run import simulate_into
from links.simulated.rig.scenario import load_scenario
from links.simulated.sensors.servo import ServoSettings

PATIENCE_S = 120.0
SCENARIO = LIVE_SMALL.replace("duration_s: 60.0", "duration_s: 4.0\nscript: [{do: sweep, times: 2}]")


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "small.yaml").write_text(SCENARIO)
    simulate_into(folder / "small.mcap", load_scenario(folder / "small.yaml"))
    return folder


def recorded(flight, topic):
    with RecordingReader(flight / "small.mcap") as reader:
        return list(reader.records([topic]))


def test_packets_are_sent_unchanged_and_the_servo_moves_as_recorded(flight, tmp_path):
    lidar_port, odometry_port = free_ports(2)
    settings = LiveRigSettings(
        scenario=flight / "small.yaml",
        packets=flight / "small.mcap",
        servo=tmp_path / "servo",
        lidar_port=lidar_port,
        odometry_port=odometry_port,
    )
    rig, ready = RealTimeRig(settings, tmp_path), threading.Event()
    sending = threading.Thread(target=rig.run, args=(ready,), daemon=True)
    lidar = Lidar(port=lidar_port, timeout_s=60, slice_ms=0.1)
    servo = Servo(port=str(tmp_path / "servo"), start_timeout_s=60)
    with lidar.listen() as packets:
        sending.start()
        assert ready.wait(PATIENCE_S)
        received = [next(packets) for _ in range(100)]
        with servo.listen() as states:
            servo.on_goal(ServoGoal(stamp_ns=0, position_rad=0.1, speed_radps=5.0))
            readings = [servo.decode(next(states)) for _ in range(60)]
            ahead_ns = rig.simulation.ahead_ns
    rig.stop.set()
    sending.join(PATIENCE_S)
    sent = {record.data for record in recorded(flight, "/lidar/packets")}
    assert {record.data for record in received} <= sent
    states = recorded(flight, "/servo/state")
    stamps_ns = np.array([record.stamp_ns for record in states]) + ahead_ns
    position_rad = np.array([json.loads(record.data)["position_rad"] for record in states])
    expected_rad = np.interp([state.stamp_ns for state in readings], stamps_ns, position_rad)
    np.testing.assert_allclose([state.position_rad for state in readings], expected_rad, atol=0.02)
    assert position_rad.max() > 1.0
    assert (tmp_path / "truth.mcap").is_file()


def test_records_of_skipped_time_are_lost(flight):
    lidar = RecordedLidar(flight / "small.mcap", load_scenario(flight / "small.yaml"))
    packets = recorded(flight, "/lidar/packets")
    stamps_ns = [record.stamp_ns for record in packets]
    first, later = lidar.records(stamps_ns[0], stamps_ns[3]), lidar.records(stamps_ns[10], stamps_ns[12])
    assert [r.stamp_ns for r in first if r.topic == "/lidar/packets"] == stamps_ns[:3]
    assert [r.stamp_ns for r in later if r.topic == "/lidar/packets"] == stamps_ns[10:12]


def test_the_servo_stays_at_its_last_recorded_position():
    servo = RecordedServo(ServoSettings(), np.array([0.5, 0.6]))
    servo.command(2.0, 1.0)
    servo.step(1e-3)
    assert (servo.position_rad, servo.velocity_radps) == (0.6, pytest.approx(100.0))
    servo.step(1e-3)
    assert (servo.position_rad, servo.velocity_radps) == (0.6, 0.0)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"duration_s": 9.0}, r"is of another flight: duration_s is 4 in it, 9 now; record this one: grd simulate"),
        ({"seed": 5}, r"is of another flight: seed is 1 in it, 5 now"),
        ({"lidar_gaps_s": ((1.0, 2.0),)}, r"is of another flight: lidar_gaps_s is a list of 0 in it, a list of 1 now"),
    ],
)
def test_another_flight_is_refused(flight, change, error):
    with pytest.raises(LinkError, match=error):
        RecordedLidar(flight / "small.mcap", load_scenario(flight / "small.yaml").changed(**change))


def test_a_recording_without_lidar_is_refused(flight, tmp_path):
    scenario = load_scenario(flight / "small.yaml").changed(fix_sensor={})
    simulate_into(tmp_path / "fixes.mcap", scenario)
    with pytest.raises(LinkError, match=r"fixes.mcap has nothing on /lidar/packets: record the flight with its LiDAR"):
        RecordedLidar(tmp_path / "fixes.mcap", scenario)
