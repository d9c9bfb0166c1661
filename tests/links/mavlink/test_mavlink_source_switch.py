"""Requests of the autopilot's source set: when, how often, refused, overridden by the pilot, and back to set 1."""

from __future__ import annotations

import dataclasses
import math
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink import Autopilot, source_switch
from links.mavlink.poses.agreement import MotionAgreement
from links.mavlink.poses.autopilot_estimate import AutopilotAttitude, AutopilotEstimate, AutopilotPosition
from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.odom_frame import odom_yaw_rad
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.profiles import best_values, required_parameters
from links.mavlink.source_switch import SET_EKF_SOURCE_SET, SourceSwitch
from links.mavlink.transport.framing import packed, parse_frame
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.rig.closed_loop import load_loop
from links.simulated.rig.pose_loop import PEER, VirtualConnection
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import load_scenario
from stages.geometry.frames import rotation_z
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose
from tests.links.mavlink.test_mavlink_live import listening

mavlink: Any = ardupilotmega
ROOT = Path(__file__).parents[3]
REQUIRED = required_parameters("ardupilot", "measured", 2)
ACCEPTED, DENIED = 0, 2
SIGMA_M = PoseLimits().position_sigma_m
POSITION, NO_POSITION = 0b1111, 0b10000111  # flags of EKF_STATUS_REPORT


class Flight:
    """An autopilot and poses in steps of 20 ms; the drone flies 1 m/s along x. Attributes change what it does."""

    def __init__(self, **parameters: float) -> None:
        self.texts: list[str] = []
        self.switch = SourceSwitch(2, True, REQUIRED, (1, 1), (1, 197), self.texts.append, SIGMA_M)
        self.values = best_values(REQUIRED) | parameters
        self.now_ns, self.step = HOST0, 0
        self.results: list[int | None] = []  # of the next requests; then ACCEPTED; None: no answer
        self.requested: list[int] = []
        self.poses = self.armed = True
        self.mode, self.ratio, self.flags = 5, 0.1, POSITION
        self.compass_ratio = 0.1
        self.gps: tuple[int, int] | None = (3, 800)  # fix type, h_acc [mm]; None: not sent
        self.yaw_error_rad, self.compass_rad = 0.0, 0.0
        self.turn_rad = 0.0  # of map against the autopilot's axes
        self.measured = True
        self.own_speed_mps = 1.0
        self.autopilot = AutopilotEstimate()
        self.frame: SentFrame | None = None
        self.shift_m = np.zeros(3)  # of the frame of the poses

    def fly(self, seconds: float) -> Flight:
        for _ in range(round(50 * seconds)):
            self.now_ns += 20 * MS
            self.step += 1
            self._receive()
            request = self.switch.due(self.now_ns)
            if request is not None:
                self._answer(request)
        return self

    def _receive(self) -> None:
        def give(message: Any) -> None:
            self.switch.on_message(message, self.now_ns)

        x_m = self.step * 0.02
        if self.step % 25 == 1:
            give(mavlink.MAVLink_heartbeat_message(2, 3, 128 if self.armed else 0, self.mode, 4, 3))
            give(mavlink.MAVLink_ekf_status_report_message(self.flags, 0.1, self.ratio, 0, self.compass_ratio, 0))
            if self.gps is not None:
                fix, h_acc = self.gps
                give(mavlink.MAVLink_gps_raw_int_message(0, fix, 0, 0, 0, 0, 0, 0, 0, 0, h_acc=h_acc))
        if self.flags == POSITION:
            v = self.own_speed_mps
            message = mavlink.MAVLink_local_position_ned_message(self.step * 20, 50 + v * x_m, 7, -30, v, 0, 0)
            self.autopilot.add(message, self.now_ns)
            give(message)
        if self.poses:
            pose = good_pose(
                self.now_ns,
                xyz_map_m=rotation_z(self.turn_rad) @ [x_m, 2.0, 10.0],
                R_map_drone=rotation_z(self.turn_rad + self.yaw_error_rad),
            )
            measured_ns = self.now_ns if self.measured else self.now_ns - 2_000 * MS
            pose = dataclasses.replace(pose, odom_yaw_rad=None, measured_ns=measured_ns)
            self.autopilot.attitude = AutopilotAttitude(0.0, 0.0, self.compass_rad, self.now_ns)
            own_yaw_rad = odom_yaw_rad(pose, self.autopilot)
            assert own_yaw_rad is not None
            if self.frame is None:
                assert pose.xyz_map_m is not None
                self.frame = SentFrame.through(own_yaw_rad, pose.xyz_map_m, np.array([50.0, -7.0, 30.0]) + self.shift_m)
            self.switch.on_sent(pose, self.frame, self.frame.yaw_rad - own_yaw_rad, self.autopilot, self.now_ns)

    def _answer(self, request: Any) -> None:
        if request.get_type() == "PARAM_REQUEST_READ":
            name = request.param_id.decode() if isinstance(request.param_id, bytes) else request.param_id
            if name in self.values:
                frame = packed(
                    mavlink.MAVLink_param_value_message(name.encode(), self.values[name], 9, 1, 0),
                    mavlink.MAVLink(None),
                )
                self.switch.on_message(parse_frame(frame), self.now_ns)
            return
        assert (request.get_type(), request.command) == ("COMMAND_LONG", SET_EKF_SOURCE_SET)
        self.requested.append(round(request.param1))
        result = self.results.pop(0) if self.results else ACCEPTED
        if result is not None:
            self.switch.on_message(mavlink.MAVLink_command_ack_message(SET_EKF_SOURCE_SET, result), self.now_ns)

    def say(self, text: str) -> None:
        frame = packed(mavlink.MAVLink_statustext_message(6, text.encode()), mavlink.MAVLink(None))
        self.switch.on_message(parse_frame(frame), self.now_ns)


def test_no_switch_is_requested_that_would_move_the_position_far():
    """As after a long drive, whose odometry has drifted against GPS."""
    flight = Flight()
    flight.shift_m = np.array([12.0, 0.0, 0.0])
    flight.fly(20.0)
    assert flight.requested == []
    assert flight.texts == ["no source switch: position would move 12 m"]
    assert "the position would move by 12 m" in str(flight.switch.status)
    flight.flags, flight.autopilot.position = NO_POSITION, None  # its GPS is lost: there is no position to move
    flight.fly(20.0)
    assert flight.requested == [2]


def test_a_step_near_the_limit_is_reported_once():
    flight = Flight()
    flight.shift_m = np.array([10.1, 0.0, 0.0])
    flight.fly(1.0)
    assert flight.frame is not None
    for x_m in (-0.2, 0.2, -0.2, 0.2):
        flight.frame = dataclasses.replace(flight.frame, offset_m=flight.frame.offset_m + np.array([x_m, 0.0, 0.0]))
        flight.fly(1.0)
    assert flight.texts == ["no source switch: position would move 10 m"]
    flight.frame = dataclasses.replace(flight.frame, offset_m=flight.frame.offset_m - np.array([3.0, 0.0, 0.0]))
    flight.fly(15.0)
    assert flight.requested == [2]


def test_the_set_is_requested_once_when_poses_are_sent_and_move_as_the_autopilot_does():
    flight = Flight()
    flight.fly(flight.switch.agreement.least_m - 0.5)  # at 1 m/s
    assert flight.requested == []
    flight.fly(20)
    assert flight.requested == [2]
    assert flight.switch.active == 2
    assert flight.texts == ["autopilot uses source set 2"]


def test_nothing_is_requested_unless_configured():
    flight = Flight()
    flight.switch = SourceSwitch(2, False, REQUIRED, (1, 1), (1, 197), flight.texts.append, SIGMA_M)
    assert flight.fly(20).requested == []


@pytest.mark.parametrize(
    "changes",
    [
        {"armed": False},
        {"mode": 3},  # Auto: its target is in global coordinates
        {"mode": 6},  # RTL
        {"ratio": 0.6},
        {"compass_ratio": 0.9},  # it would be kept, one of the two votes of the EKF failsafe
        {"measured": False},  # propagated without LiDAR
        {"own_speed_mps": 0.0},  # it hovers: the poses are of another object
        {"yaw_error_rad": math.radians(90)},
        {"compass_rad": math.radians(30)},
        {"poses": False},
    ],
    ids=str,
)
def test_the_set_is_not_requested_while_a_condition_does_not_hold(changes: dict[str, Any]):
    flight = Flight()
    for name, value in changes.items():
        setattr(flight, name, value)
    assert flight.fly(30).requested == []


def test_a_drone_that_hovers_gives_no_evidence_that_its_poses_are_right():
    agreement, autopilot, now_ns = MotionAgreement(SIGMA_M), AutopilotEstimate(), HOST0
    for _ in range(1500):
        now_ns += 20 * MS
        autopilot.position = AutopilotPosition(now_ns, np.array([1.0, 2.0, 3.0]), np.zeros(3))
        assert agreement.add(good_pose(now_ns), SentFrame(0.0, np.zeros(3)), autopilot) is None
    assert not agreement.agrees(now_ns)


def agreed_after(ends: list[dict[str, Any]]) -> bool:
    """Whether they agree after 6 s at 1 m/s, and then 20 ms with each of these changes of the pose."""
    agreement, autopilot = MotionAgreement(SIGMA_M), AutopilotEstimate()
    for step in range(300 + len(ends)):
        now_ns, xyz_m = HOST0 + step * 20 * MS, np.array([0.02 * step, 0.0, 10.0])
        autopilot.position = AutopilotPosition(now_ns, xyz_m, np.zeros(3))
        autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, now_ns)
        changes = ends[step - 300] if step >= 300 else {}
        pose = dataclasses.replace(good_pose(now_ns, xyz_map_m=xyz_m, R_map_drone=np.eye(3)), odom_yaw_rad=None)
        agreement.add(dataclasses.replace(pose, **changes), SentFrame(0.0, np.zeros(3)), autopilot)
    return agreement.agrees(now_ns)


def test_another_track_a_reset_or_a_difference_ends_the_agreement():
    assert agreed_after([{}])
    assert not agreed_after([{"track_id": 7}])
    assert not agreed_after([{"resets": 7}])
    far = good_pose(HOST0, xyz_map_m=np.array([30.0, 0.0, 10.0]), R_map_drone=np.eye(3)).estimate
    assert not agreed_after([{"estimate": far}])


def test_after_a_pause_of_the_poses_they_have_to_agree_again():
    flight = Flight()
    flight.mode = 3  # no switch yet
    flight.fly(10)
    assert flight.switch.agreement.agrees(flight.now_ns)
    flight.poses = False
    flight.fly(0.6)
    flight.poses = True
    flight.fly(0.1)
    assert not flight.switch.agreement.agrees(flight.now_ns)


def test_a_difference_is_reported_and_counted():
    flight = Flight()
    flight.own_speed_mps = 0.0
    flight.fly(10)
    assert flight.switch.agreement.disagreements >= 3
    assert flight.texts[0] == "pose and autopilot differ by 1.8 m"


def test_an_autopilot_without_a_position_has_nothing_to_compare_and_is_switched():
    flight = Flight(EK3_SRC1_POSXY=0.0)
    flight.flags = NO_POSITION
    assert flight.fly(10).requested == [2]


def test_an_autopilot_that_has_a_position_but_does_not_send_it_is_not_switched():
    flight = Flight()
    flight.flags = POSITION | 16
    assert flight.fly(20).requested == []


def test_wrong_or_missing_parameters_prevent_the_request_and_are_named():
    flight = Flight(EK3_SRC_OPTIONS=1.0)
    assert flight.fly(20).requested == []
    assert "EK3_SRC_OPTIONS is 1" in str(flight.switch.status)
    flight = Flight()
    del flight.values["VISO_TYPE"]
    assert flight.fly(30).requested == []
    assert "VISO_TYPE was not received" in str(flight.switch.status)


def test_a_denied_request_is_reported_and_not_repeated():
    flight = Flight()
    flight.results = [DENIED]
    flight.fly(30)
    assert flight.requested == [2]
    assert flight.texts == ["no source switch: rejected, MAV_RESULT 2"]
    assert flight.switch.status == "source set 2 is not requested: rejected, MAV_RESULT 2"
    flight.switch.on_boot()
    assert flight.fly(30).requested == [2, 2]


def test_a_request_without_acknowledgement_is_made_three_times():
    flight = Flight()
    flight.results = [None] * 10
    assert flight.fly(30).requested == [2, 2, 2]
    assert flight.texts == ["no source switch: not acknowledged"]


def test_an_acknowledgement_for_another_requester_is_not_ours():
    flight = Flight()
    flight.results = [None] * 10
    flight.fly(5.5)
    foreign = mavlink.MAVLink_command_ack_message(SET_EKF_SOURCE_SET, ACCEPTED, 0, 0, 255, 190)
    flight.switch.on_message(foreign, flight.now_ns)
    assert flight.switch.active is None


def test_set_1_is_requested_when_poses_end_and_grds_set_again_when_they_have_returned():
    flight = Flight().fly(10)
    flight.poses = False
    flight.results = [None, None]
    flight.fly(0.4)
    assert flight.requested == [2]
    flight.fly(3)
    assert flight.requested == [2, 1, 1, 1]
    assert flight.switch.active == 1
    flight.poses = True
    flight.fly(4)
    assert flight.requested[-1] == 1
    assert flight.fly(10).requested[-1] == 2


@pytest.mark.parametrize("gps", [(1, 0), (3, 8000)], ids=["no fix", "8 m"])
def test_set_1_is_not_requested_while_its_gps_is_unusable(gps: tuple[int, int]):
    """ArduPilot checks nothing at the command; on grd's set it flies on for 7 s."""
    flight = Flight().fly(10)
    flight.poses, flight.gps = False, gps
    flight.fly(3)
    assert flight.requested == [2]
    assert flight.texts[-1] == "GPS unusable: source set 1 is not requested"
    assert len(flight.texts) == 2
    flight.poses = True
    flight.fly(3)
    flight.poses = False
    flight.fly(1)
    assert len(flight.texts) == 3
    flight.gps = (3, 1500)
    assert flight.fly(1).requested == [2, 1]


def test_a_bad_gps_is_better_than_no_position_at_all():
    flight = Flight().fly(10)
    flight.poses, flight.gps = False, (3, 8000)
    assert flight.fly(3.9).requested == [2]
    assert flight.fly(1).requested == [2, 1]


def test_an_old_report_of_the_gps_counts_no_more():
    flight = Flight().fly(10)
    flight.gps = (1, 0)
    flight.fly(1)
    flight.gps, flight.poses = None, False
    assert flight.fly(1).requested == [2]
    assert flight.fly(2).requested == [2, 1]


@pytest.mark.parametrize("lost", [1, 3])
def test_set_1_is_requested_also_after_a_request_of_grds_set_whose_acknowledgement_was_lost(lost: int):
    flight = Flight()
    flight.say("Using EKF Source Set 1")
    flight.results = [None] * lost
    while len(flight.requested) < lost:
        flight.fly(0.1)
    flight.fly(0.0 if lost == 1 else 2.0)
    assert flight.switch.uses_grd is None
    flight.poses = False
    flight.fly(3)
    assert flight.requested == [2] * lost + [1]
    assert flight.switch.active == 1


def test_a_late_acknowledgement_makes_the_set_unknown():
    flight = Flight().fly(2)
    flight.switch.on_message(mavlink.MAVLink_command_ack_message(SET_EKF_SOURCE_SET, ACCEPTED), flight.now_ns)
    assert flight.switch.uses_grd is None


def test_a_command_of_another_station_is_not_overridden():
    flight = Flight().fly(10)
    foreign = mavlink.MAVLink_command_ack_message(SET_EKF_SOURCE_SET, ACCEPTED, 0, 0, 255, 190)
    flight.switch.on_message(foreign, flight.now_ns)
    assert flight.switch.uses_grd is None
    assert flight.fly(20).requested == [2]
    assert flight.texts[-1] == "no source switch: another station chose a set"
    flight.poses = False
    assert flight.fly(2).requested == [2, 1]  # it may be grd's that is in use


def test_after_a_silence_only_grds_set_is_still_known():
    """A selection may have been missed. That of grd's set is kept, so that its end is answered with set 1."""
    flight = Flight()
    for number, uses_grd in ((1, None), (2, True)):
        flight.say(f"Using EKF Source Set {number}")
        flight.switch.on_silence()
        assert flight.switch.uses_grd is uses_grd


def test_a_selection_of_set_1_in_flight_is_one_of_the_pilot_also_after_a_restart_of_grd():
    flight = Flight().fly(3)
    flight.say("Using EKF Source Set 1")
    assert flight.fly(20).requested == []
    assert "the pilot selected set 1" in str(flight.switch.status)


def test_the_only_set_is_that_of_grd():
    assert SourceSwitch(1, False, REQUIRED, (1, 1), (1, 197), print, SIGMA_M).uses_grd is True


def test_a_ratio_of_the_compass_that_prevents_the_switch_is_named():
    flight = Flight()
    flight.compass_ratio = 0.9
    flight.fly(20)
    assert "the EKF's test ratio of the compass is 0.9" in str(flight.switch.status)


@pytest.mark.parametrize("gps", [None, (3, 0)], ids=["not sent", "accuracy not reported"])
def test_set_1_is_requested_where_nothing_is_known_of_its_gps(gps: tuple[int, int] | None):
    flight = Flight()
    flight.gps = gps
    flight.fly(10)
    flight.poses = False
    assert flight.fly(2).requested == [2, 1]


def test_the_first_position_of_the_switch_after_a_boot_is_no_selection_of_the_pilot():
    flight = Flight()
    assert flight.switch.uses_grd is None
    flight.say("Using EKF Source Set 1")
    assert flight.switch.uses_grd is False
    assert flight.fly(20).requested == [2]
    assert flight.switch.uses_grd is True


def test_without_switch_source_the_selection_of_the_pilot_is_known():
    flight = Flight()
    flight.switch = SourceSwitch(2, False, REQUIRED, (1, 1), (1, 197), flight.texts.append, SIGMA_M)
    for number, uses_grd in ((1, False), (2, True), (3, False)):
        flight.say(f"Using EKF Source Set {number}")
        assert flight.switch.uses_grd is uses_grd
        assert flight.switch.status is None
    flight.switch.on_boot()
    assert flight.switch.uses_grd is None


@pytest.mark.parametrize("source", [0.0, 6.0])
def test_set_1_is_not_requested_if_it_has_no_position_of_another_source(source: float):
    flight = Flight().fly(10)
    flight.switch._values["EK3_SRC1_POSXY"] = source
    flight.poses = False
    assert flight.fly(5).requested == [2]


def test_after_the_pilot_has_selected_another_set_nothing_is_requested():
    flight = Flight().fly(10)
    flight.say("Using EKF Source Set 1")
    flight.fly(30)
    assert flight.requested == [2]
    assert flight.switch.status == "source set 2 is not requested: the pilot selected set 1"


def test_a_set_that_the_pilot_selected_for_grd_also_falls_back():
    flight = Flight()
    flight.mode = 3
    flight.fly(3).say("Using EKF Source Set 2")
    flight.fly(3)
    flight.poses = False
    assert flight.fly(2).requested == [1]


def test_it_needs_ardupilot_and_another_set_than_the_first():
    for wrong in ({"profile": "px4"}, {"source_set": 1}):
        with pytest.raises(ValidationError, match="switch_source: needs profile ardupilot and source_set 2 or 3"):
            Autopilot(switch_source=True, **wrong)


def test_a_reopened_link_knows_the_set_in_use_and_what_the_pilot_selected_until_the_autopilot_boots():
    link = Autopilot(switch_source=True)
    first = link.open_session(VirtualConnection(), lambda: HOST0, threaded=False)
    text = mavlink.MAVLink_statustext_message(6, b"Using EKF Source Set 3")
    frame = packed(text, mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    assert len(list(first.receive(frame, PEER, HOST0))) == 1
    first.close()
    second = link.open_session(VirtualConnection(), lambda: HOST0, threaded=False)
    assert second.switch.active == 3
    assert second.switch.status == "source set 2 is not requested: the pilot selected set 3"
    for boot_ms in (60_000, 1_000):
        attitude = mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0)
        list(second.receive(packed(attitude, mavlink.MAVLink(None, srcSystem=1, srcComponent=1)), PEER, HOST0))
    assert second.switch.active is None
    assert second.switch.status is None


def test_over_a_socket_the_request_is_made_and_its_acknowledgement_read(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(source_switch, "MIN_SENDING_NS", 500 * MS)
    monkeypatch.setattr(source_switch, "PARAMETER_PERIOD_NS", 20 * MS)
    values = best_values(REQUIRED)
    sender, requested = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), []
    with listening(switch_source=True) as listener, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        link_address = "127.0.0.1", listener.link.port
        peer.setblocking(False)

        def send(message: Any) -> None:
            peer.sendto(packed(message, sender), link_address)

        def step() -> bool:
            send(mavlink.MAVLink_heartbeat_message(2, 3, 128, 5, 4, 3))
            send(mavlink.MAVLink_ekf_status_report_message(NO_POSITION, 0, 0, 0, 0, 0))
            while True:
                try:
                    message = parse_frame(peer.recv(512))
                except BlockingIOError:
                    break
                if message.get_type() == "PARAM_REQUEST_READ":
                    name = message.param_id
                    send(mavlink.MAVLink_param_value_message(name.encode(), values[name], 9, 1, 0))
                elif message.get_type() == "COMMAND_LONG" and message.command == SET_EKF_SOURCE_SET:
                    requested.append(message.param1)
                    send(mavlink.MAVLink_command_ack_message(SET_EKF_SOURCE_SET, ACCEPTED, 0, 0, 1, 197))
            session = listener.link._session
            return session is not None and session.switch.active == 2

        listener.send_poses(step)
    assert requested == [2.0]
    assert listener.link.counters["source sets requested"] == 1


def flown(config: Path, name: str, stack_settings: dict[str, Any], gap_s: tuple[float, float]) -> FlightStack:
    """A flight of a scenario until the end of a gap of the LiDAR."""
    scenario = load_scenario(ROOT / f"configs/scenarios/flight/{name}.yaml")
    assert scenario.autopilot is not None
    autopilot = scenario.autopilot.model_dump()
    autopilot["flight_stack"] |= stack_settings
    scenario = scenario.changed(duration_s=gap_s[1], autopilot=autopilot, lidar_gaps_s=(gap_s,))
    simulation = Simulation(scenario, loop=load_loop(config, scenario.rig_yaml(), "test", scenario.closed_loop))
    for _ in simulation.records():
        pass
    assert simulation.flight is not None
    return simulation.flight.stack


@pytest.mark.slow
def test_a_flight_is_switched_to_grd_and_back_to_gps_when_the_lidar_ends(tmp_path: Path):
    config = tmp_path / "switch.yaml"
    include = ROOT / "configs/sim_flight_fixes.yaml"
    config.write_text(
        f"include: {include}\nlinks: {{autopilot: {{config: {{switch_source: true}}}}}}\n", encoding="utf-8"
    )
    stack = flown(config, "hover_fixes", {"plan": [{"do": "path", "for_s": 60}]}, (21.0, 27.0))
    assert [str(event) for event in stack.events] == ["plan: path", "source set 2", "source set 1"]
    assert not stack.quadrotor.crashed


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0])
def test_the_yaw_of_map_does_not_matter(turn_deg: float):
    flight = Flight()
    flight.turn_rad = math.radians(turn_deg)
    assert flight.fly(10).requested == [2]


def test_after_a_yaw_reset_of_the_ekf_a_set_is_requested_only_while_the_velocity_in_its_axes_is_nearly_right():
    flight = Flight().fly(1)
    flight.compass_rad = math.radians(90)
    assert flight.fly(20).requested == []  # 1 m/s, wrong by 1.4 m/s
    flight = Flight().fly(1)
    flight.compass_rad = math.radians(50)
    assert flight.fly(10).requested == [2]  # 0.8 m/s
    flight.poses, flight.own_speed_mps = False, 2.0
    assert flight.fly(5).requested == [2]
    assert flight.texts[1:] == ["too fast for source set 1: slow down"]
    flight.own_speed_mps = 0.5
    assert flight.fly(1).requested == [2, 1]


@pytest.mark.slow
def test_a_flight_whose_gps_has_ended_stays_on_grds_set_in_a_gap_of_the_lidar():
    config = ROOT / "configs/sim_flight_switch_fixes.yaml"
    plan = [{"do": "path", "for_s": 20}, {"do": "square", "for_s": 30, "side_m": 8.0}]
    settings = {"plan": plan, "source_sets": ["gps", "external_no_velocity"], "gps_until_s": 32.0}
    stack = flown(config, "hover_fixes", settings, (34.0, 36.5))
    assert [str(event) for event in stack.events] == ["plan: path", "plan: square", "source set 2"]
    assert not stack.quadrotor.crashed


def test_a_flight_that_follows_the_vehicle_at_speed_is_switched_to_gps_when_the_lidar_ends():
    config = ROOT / "configs/sim_flight_switch_fixes.yaml"
    square = {"do": "square", "for_s": 11, "side_m": 8.0}
    plan = [{"do": "path", "for_s": 20}, square, {"do": "follow", "for_s": 20}]
    stack = flown(config, "follow_fixes", {"plan": plan, "source_sets": ["gps", "external_no_velocity"]}, (34.0, 40.0))
    assert [str(event) for event in stack.events] == [
        "plan: path",
        "plan: square",
        "source set 2",
        "plan: follow",
        "source set 1",
    ]
    assert not stack.quadrotor.crashed
