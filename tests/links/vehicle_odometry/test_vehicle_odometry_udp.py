"""The vehicle's odometry live, on real loopback sockets."""

from __future__ import annotations

import json
import threading
import time

import pytest
from pydantic import ValidationError

from flow.link import LinkError
from links import host_time
from links.vehicle_odometry import VehicleOdometry
from links.vehicle_odometry.udp import age_s
from tests.links import ports

POSE = {"xyz_m": [1.0, 2.0, 3.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "covariance": None}


@pytest.fixture
def port():
    return ports.free_port()


def send(port, *poses, host="127.0.0.1"):
    ports.send(port, *(json.dumps(pose).encode() for pose in poses), host=host)


def test_a_pose_arrives_stamped_by_its_age_and_decodes(port):
    odometry = VehicleOdometry(port=port)
    with odometry.listen() as records:
        before_ns = host_time.now_ns()
        send(port, POSE | {"age_s": 0.25}, POSE)
        aged, plain = next(records), next(records)
        after_ns = host_time.now_ns()
    assert before_ns <= aged.arrival_ns <= plain.arrival_ns <= after_ns
    assert (aged.arrival_ns - aged.stamp_ns, plain.arrival_ns - plain.stamp_ns) == (250_000_000, 0)
    motion = odometry.decode(aged)
    assert motion.stamp_ns == aged.stamp_ns
    assert motion.xyz_map_m.tolist() == [1.0, 2.0, 3.0]


def test_a_pose_that_is_read_late_did_not_arrive_late(port):
    """The kernel begins to stamp a moment after it was asked to; where the wall clock was set it is tried again, too."""
    with VehicleOdometry(port=port).listen() as records:
        for _ in range(5):
            send(port, POSE)
            sent_ns = host_time.now_ns()
            time.sleep(0.3)
            late_ns = next(records).arrival_ns - sent_ns
            if late_ns < 200_000_000:
                break
        assert late_ns < 200_000_000


def test_others_are_ignored_and_counted(port):
    odometry = VehicleOdometry(port=port, sender="127.0.0.1")
    with odometry.listen() as records:
        send(port, POSE, POSE, host="127.0.0.2")
        send(port, POSE | {"age_s": 0.5})
        assert next(records).data == json.dumps(POSE | {"age_s": 0.5}).encode()
    assert odometry.counters["from other senders"] == 2


@pytest.mark.parametrize(
    "data",
    [
        b'{"age_s": -1}',
        b'{"age_s": 1.2}',
        b'{"age_s": 1%s}' % (b"0" * 400),
        b'{"age_s": 2}',
        b'{"age_s": NaN}',
        b'{"age_s": "x"}',
        b'{"age_s": []}',
    ],
)
def test_an_age_that_cannot_be_true_or_is_too_great_is_none(data):
    assert age_s(data) is None


@pytest.mark.parametrize("data", [b"", b"[]", b"7", b"\xff", b"{}"])
def test_what_says_no_age_is_new_and_decoding_looks_at_the_rest(data):
    assert age_s(data) == 0.0


def test_a_pose_that_says_it_is_old_is_left_out_and_counted(port):
    odometry = VehicleOdometry(port=port)
    with odometry.listen() as records:
        send(port, POSE | {"age_s": 1.5}, POSE)
        assert next(records).data == json.dumps(POSE).encode()
    assert odometry.counters["too old, or of no age"] == 1


def test_leaving_the_context_ends_a_waiting_listener(port):
    ended = threading.Event()

    def read(records):
        for _ in records:
            pass
        ended.set()

    with VehicleOdometry(port=port).listen() as records:
        threading.Thread(target=read, args=(records,), daemon=True).start()
    assert ended.wait(60)


def test_what_cannot_be_opened_is_an_error_that_says_what_to_check(port):
    with pytest.raises(LinkError, match="give `port` to hear"):
        VehicleOdometry().listen()
    with (
        VehicleOdometry(port=port).listen(),
        pytest.raises(LinkError, match=rf"cannot listen on UDP 127.0.0.1:{port}.*another grd"),
        VehicleOdometry(port=port).listen(),
    ):
        pass


def test_beyond_loopback_the_sender_is_named():
    with pytest.raises(ValidationError, match="sender: say who tells"):
        VehicleOdometry(bind="0.0.0.0", port=5000)
