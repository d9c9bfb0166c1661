"""Whether the autopilot's estimate is independent of sent poses: by time, over reboots, live and in replay."""

from __future__ import annotations

import socket
import threading
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.clock import host_time
from links.mavlink import Autopilot
from links.mavlink.poses.independence import Independence
from tests.links.mavlink.mavlink_poses import good_pose
from tests.links.mavlink.test_mavlink_live import listening

mavlink: Any = ardupilotmega
HOST0, MS = 1_748_773_230_000_000_000, 1_000_000
POSE = mavlink.MAVLink_odometry_message(
    0, 20, 12, 1.0, 2.0, 3.0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0.0] * 21, [0.0] * 21, 0, 0, 0
)


class Flight:
    """Frames of an autopilot that booted at HOST0, and ours, in a link."""

    def __init__(self) -> None:
        self.link = Autopilot()
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._own = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
        self.booted_ms = 0

    def attitude(self, at_ms: int) -> bool | None:
        """Whether an attitude received then is independent; None: it was rejected."""
        message = mavlink.MAVLink_attitude_message(at_ms - self.booted_ms, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        at_ns = HOST0 + at_ms * MS
        decoded = self.link.decode(Record("/autopilot/rx", at_ns, at_ns, frame))
        return None if decoded is None else decoded.independent

    def send(self, at_ms: int, message: Any = POSE) -> None:
        """A frame of ours in the recording."""
        at_ns = HOST0 + at_ms * MS
        assert self.link.decode(Record("/autopilot/tx", at_ns, at_ns, bytes(message.pack(self._own)))) is None


def landing_target() -> Any:
    return mavlink.MAVLink_landing_target_message(0, 0, 12, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 5.0, [1, 0, 0, 0], 3, 1)


def vision_position_estimate() -> Any:
    return mavlink.MAVLink_vision_position_estimate_message(0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0)


def test_an_estimate_is_independent_until_the_first_pose_is_sent():
    flight = Flight()
    assert flight.attitude(1000) is True
    flight.send(1100)
    assert flight.attitude(1200) is False
    assert flight.attitude(60_000) is False


def test_what_was_received_before_the_pose_was_sent_is_independent_whenever_it_is_decoded():
    flight = Flight()
    flight.send(1100)
    assert flight.attitude(1050) is True
    assert flight.attitude(1150) is False


@pytest.mark.parametrize(
    ("message", "independent"),
    [
        (landing_target(), True),
        (mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), True),
        (vision_position_estimate(), False),
        (POSE, False),
    ],
)
def test_only_poses_for_an_ekf_count(message: Any, independent: bool):
    flight = Flight()
    flight.attitude(1000)
    flight.send(1100, message)
    assert flight.attitude(1200) is independent


def test_after_a_reboot_it_is_independent_again_until_the_next_pose():
    flight = Flight()
    flight.attitude(60_000)
    flight.send(60_100)
    assert flight.attitude(60_200) is False
    flight.booted_ms = 62_000
    answers = [flight.attitude(63_000 + 20 * i) for i in range(8)]
    assert answers == [None] * 4 + [True] * 4  # the clock needs five frames to accept a reboot
    flight.send(64_000)
    assert flight.attitude(64_020) is False


@pytest.mark.parametrize("sent_ms", [61_900, 62_500, 63_010])
def test_a_pose_sent_after_the_boot_or_just_before_it_counts(sent_ms: int):
    flight = Flight()
    flight.attitude(60_000)
    flight.send(sent_ms)
    flight.booted_ms = 62_000
    answers = [flight.attitude(63_000 + 20 * i) for i in range(8)]
    assert answers[4:] == [False] * 4


def test_a_jump_of_its_clock_that_is_no_boot_does_not_make_it_independent():
    flight = Flight()
    flight.attitude(60_000)
    flight.send(60_100)
    flight.booted_ms = -100_000  # its time continues from a later value
    answers = [flight.attitude(61_000 + 20 * i) for i in range(8)]
    assert answers[4:] == [False] * 4


def test_poses_sent_to_a_silent_autopilot_count_once_it_sends():
    independence = Independence()
    for i in range(100_000):
        independence.on_sent("ODOMETRY", i)
    independence.on_clock(0, 0)
    assert independence.at(0) is True
    assert independence.at(100_001) is False


def test_live_and_replay_mark_the_same_messages():
    with listening() as listener, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        mav, pause = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), threading.Event()
        for i in range(200):
            message = mavlink.MAVLink_attitude_message(1000 + 5 * i, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
            mav.seq = i
            udp.sendto(bytes(message.pack(mav)), ("127.0.0.1", listener.link.port))
            pause.wait(0.005)
            if i > 60:
                listener.link.on_pose(good_pose(host_time.now_ns()))
        listener.wait(lambda: len(listener.messages) == 200)
        sent = list(listener.link.sent())
    live = [message.independent for message in listener.messages if message is not None]
    assert 40 < live.index(False) < 80
    assert True not in live[live.index(False) :]
    replayed, records = Autopilot(), sorted([*listener.records, *sent], key=lambda record: record.arrival_ns)
    messages = [replayed.decode(record) for record in records]
    assert [message.independent for message in messages if message is not None] == live
