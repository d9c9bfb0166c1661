"""A restart of grd knows that poses were sent before."""

from __future__ import annotations

import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.clock import host_time
from links.clock.host_boot import HostBoot, host_boot
from links.mavlink import Autopilot
from links.mavlink.poses.sent_state import SentState
from links.mavlink.source_switch import SourceSwitch
from links.mavlink.transport.framing import packed, parse_frame
from stages.geometry.frames import rotation_z
from stages.messages import DroneAttitude, EarlierOdomFrame
from tests.links.mavlink.mavlink_poses import good_pose
from tests.links.mavlink.test_mavlink_live import Listener, listening

mavlink: Any = ardupilotmega
S = 1_000_000_000


def test_the_newest_pose_is_kept(tmp_path: Path):
    file = tmp_path / "new" / "sent.json"
    state = SentState(file, 5 * S)
    assert state.take_earlier() is None
    state.write()
    assert not file.exists()  # nothing was sent
    for i in range(4):
        state.on_sent(bytes([i]), (5 + i) * S)
        state.write()
    assert SentState(file, 10 * S).take_earlier() == (8 * S, b"\x03", None)
    assert SentState(file, 7 * S).take_earlier() == (7 * S, b"\x03", None)  # not from the future


@pytest.mark.parametrize("step_s", [57_600, -57_600])
def test_the_time_of_a_pose_is_known_after_the_wall_clock_was_set(tmp_path: Path, step_s: int):
    """The host booted 1000 s before; its clock was wrong until a network was at hand."""
    file, now_ns = tmp_path / "sent.json", 100_000 * S
    state = SentState(file, now_ns, HostBoot("a", now_ns - 1000 * S))
    state.on_sent(b"x", now_ns)
    state.write()
    then_ns = now_ns + (step_s + 2) * S  # 2 s later
    earlier = SentState(file, then_ns, HostBoot("a", then_ns - 1002 * S)).take_earlier()
    assert earlier == (then_ns - 2 * S, b"x", None)


def test_a_pose_of_an_earlier_boot_of_the_host_was_sent_before_it(tmp_path: Path):
    file = tmp_path / "sent.json"
    state = SentState(file, 5000 * S, HostBoot("a", 10 * S))
    state.on_sent(b"x", 5000 * S)
    state.write()
    set_back = SentState(file, 4000 * S, HostBoot("b", 3900 * S)).take_earlier()
    assert set_back == (3900 * S, b"x", None)
    later = SentState(file, 9000 * S, HostBoot("b", 8000 * S)).take_earlier()
    assert later == (5000 * S, b"x", None)


def test_the_boot_of_this_host_is_the_same_for_two_processes(tmp_path: Path):
    now_ns = host_time.now_ns()
    first, second = host_boot(now_ns), host_boot(now_ns + 57_600 * S)
    assert first is not None
    assert second is not None
    assert first.id == second.id
    assert second.at_ns - first.at_ns == pytest.approx(57_600 * S, abs=S)
    assert host_boot(now_ns, tmp_path / "none") is None


def test_it_is_written_ten_times_a_second(tmp_path: Path):
    state = SentState(tmp_path / "sent.json", 0)
    for i in range(1, 100):
        state.on_sent(bytes([i]), i * S // 50)
        state.write()
    assert SentState(tmp_path / "sent.json", 10 * S).take_earlier() == (96 * S // 50, bytes([96]), None)


def test_a_damaged_file_counts_as_a_pose_sent_now_and_is_reported(tmp_path: Path):
    file = tmp_path / "sent.json"
    file.write_text("{")
    state = SentState(file, 5 * S)
    earlier = state.take_earlier()
    assert earlier is not None
    assert earlier[0] == 5 * S
    assert state.take_earlier() is None
    assert "delete it" in (state.status or "")


def test_a_file_that_cannot_be_written_is_reported(tmp_path: Path):
    (tmp_path / "file").touch()
    state = SentState(tmp_path / "file" / "sent.json", 5 * S)
    state.on_sent(b"x", 6 * S)
    state.write()
    assert "A restart would not know" in (state.status or "")


def test_a_disk_that_stalls_stops_neither_poses_nor_what_is_due(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    answers, due = threading.Event(), list[int]()
    monkeypatch.setattr("links.mavlink.poses.sent_state.os.replace", lambda *_: answers.wait(30.0))
    monkeypatch.setattr("links.mavlink.poses.sent_state.STALLED_S", 0.2)
    monkeypatch.setattr(SourceSwitch, "due", lambda _, now_ns: due.append(now_ns))
    drone = Drone(uptime_s=60.0)
    try:
        with listening(state_file=str(tmp_path / "sent.json")) as listener:
            drone.send(listener, 30, poses=True)
            before, sent = len(due), listener.link.counters["sent: ODOMETRY"]
            drone.send(listener, 60, poses=True)
            assert "the disk does not answer" in (listener.link.status or "")
            assert listener.link.counters["sent: ODOMETRY"] > sent
            assert len(due) > before + 3
            answers.set()
            listener.wait(lambda: "does not answer" not in (listener.link.status or ""))
    finally:
        answers.set()


class Drone:
    """Sends attitudes of an autopilot that booted `uptime_s` ago."""

    def __init__(self, uptime_s: float) -> None:
        self._booted_ns = host_time.now_ns() - round(1e9 * uptime_s)
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def send(self, listener: Listener, count: int, poses: bool) -> None:
        before, pause = len(listener.messages), threading.Event()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            for _ in range(count):
                boot_ms = (host_time.now_ns() - self._booted_ns) // 1_000_000
                message = mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
                position = mavlink.MAVLink_local_position_ned_message(boot_ms, 4, 2, -30, 0, 0, 0)
                for each in (position, message):
                    udp.sendto(packed(each, self._mav), ("127.0.0.1", listener.link.port))
                pause.wait(0.01)
                if poses:
                    learnt_before_the_switch_rad = -1.0
                    pose = good_pose(
                        host_time.now_ns(), R_map_drone=rotation_z(0.5), odom_yaw_rad=learnt_before_the_switch_rad
                    )
                    listener.link.on_pose(pose)
        listener.wait(lambda: len(listener.messages) >= before + 2 * count)


@pytest.mark.parametrize(("rebooted", "independent"), [(False, False), (True, True)])
def test_after_a_restart_the_estimate_is_independent_only_if_the_autopilot_has_rebooted(
    tmp_path: Path, rebooted: bool, independent: bool
):
    state_file, drone = str(tmp_path / "sent.json"), Drone(uptime_s=60.0)
    with listening(state_file=state_file) as listener:
        drone.send(listener, 30, poses=True)
    if rebooted:
        threading.Event().wait(0.6)
        drone = Drone(uptime_s=0.0)
    with listening(state_file=state_file) as listener:
        drone.send(listener, 10, poses=False)
        listener.link.on_pose(good_pose(0))  # too old: not sent
        sent = list(listener.link.sent())
    live = [message.independent for message in listener.messages if isinstance(message, DroneAttitude)]
    assert live == [independent] * 10
    replayed = Autopilot()
    messages = [replayed.decode(r) for r in sorted([*listener.records, *sent], key=lambda r: r.arrival_ns)]
    assert [message.independent for message in messages if isinstance(message, DroneAttitude)] == live


@pytest.mark.parametrize("file", [None, "sent.json"])
def test_a_fuse_stage_that_restarts_is_told_the_axes_of_the_newest_pose(tmp_path: Path, file: str | None):
    """With a state file and without."""
    state_file, drone = None if file is None else str(tmp_path / file), Drone(uptime_s=60.0)
    with listening(state_file=state_file) as listener:
        assert listener.link.upstream_restarted("pose") is None, "nothing was sent"
        drone.send(listener, 30, poses=True)
        assert "axes" in (listener.link.upstream_restarted("pose") or "")
        drone.send(listener, 5, poses=False)
    found = [message for message in listener.messages if isinstance(message, EarlierOdomFrame)]
    assert len(found) == 1
    assert found[0].yaw_map_odom_rad == pytest.approx(0.8, abs=0.02)
    assert abs(host_time.now_ns() - found[0].stamp_ns) < 30 * S
    assert listener.link.upstream_restarted("pose") is None, "it is closed"


def test_the_frame_of_the_autopilot_is_known_after_a_restart_live_and_in_replay(tmp_path: Path):
    """The body's yaw is 0.5 in `map` and -0.3 by the autopilot; it is at (101, 2, 10) in `map` and at (4, -2, 30)."""
    state_file, drone = str(tmp_path / "sent.json"), Drone(uptime_s=60.0)
    with listening(state_file=state_file) as listener:
        assert not [m for m in listener.messages if isinstance(m, EarlierOdomFrame)]
        drone.send(listener, 30, poses=True)
    with listening(state_file=state_file) as listener:
        drone.send(listener, 10, poses=False)
    found = [message for message in listener.messages if isinstance(message, EarlierOdomFrame)]
    assert len(found) == 1
    yaw_rad = found[0].yaw_map_odom_rad
    assert yaw_rad == pytest.approx(0.8, abs=0.02)
    np.testing.assert_allclose(found[0].xyz_map_m + rotation_z(yaw_rad) @ [4, -2, 30], [101, 2, 10], atol=0.1)
    assert found[0].sigma_rad == pytest.approx(0.02, abs=0.002)
    texts = [parse_frame(r.data).text for r in listener.link.sent() if parse_frame(r.data).get_type() == "STATUSTEXT"]
    assert "grd: restarted 0 s after its last pose" in texts
    replayed = Autopilot()
    messages = [replayed.decode(record) for record in listener.records]
    again = [message for message in messages if isinstance(message, EarlierOdomFrame)]
    assert [(m.stamp_ns, m.yaw_map_odom_rad) for m in again] == [(found[0].stamp_ns, yaw_rad)]


def test_a_link_that_is_reopened_does_not_report_its_own_run(tmp_path: Path):
    drone = Drone(uptime_s=60.0)
    with listening(state_file=str(tmp_path / "sent.json")) as listener:
        drone.send(listener, 30, poses=True)
        link = listener.link
    with link.listen() as records:
        again = Listener(link, records)
        drone.send(again, 10, poses=False)
    again.thread.join(5)
    assert len(again.messages) >= 10
    assert not any(isinstance(message, EarlierOdomFrame) for message in again.messages)
    assert not any(m.independent for m in again.messages if isinstance(m, DroneAttitude))


def test_an_echo_of_our_own_frames_is_no_earlier_run():
    link, mav = Autopilot(), mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    heartbeat = bytes(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3).pack(mav))
    assert link.decode(Record("/autopilot/rx", 0, 0, heartbeat)) is None
    assert link.counters.rejected["echo of our own"] == 1
