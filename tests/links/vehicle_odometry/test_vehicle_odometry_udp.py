"""Live vehicle odometry on loopback sockets."""

from __future__ import annotations

import json
import threading
import time

import pytest
from pydantic import ValidationError

from flow.link import LinkError
from links.clock import host_time
from links.udp import age_s
from links.vehicle_odometry import VehicleOdometry
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


def test_a_pose_that_is_read_late_has_its_true_arrival(port):
    """The kernel starts to stamp with a delay, hence several attempts; also for a step of the wall clock."""
    with VehicleOdometry(port=port).listen() as records:
        for _ in range(5):
            send(port, POSE)
            sent_ns = host_time.now_ns()
            time.sleep(0.3)
            late_ns = next(records).arrival_ns - sent_ns
            if late_ns < 200_000_000:
                break
        assert late_ns < 200_000_000


def test_other_senders_are_ignored_and_counted(port):
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
def test_an_invalid_or_too_large_age_is_none(data):
    assert age_s(data) is None


@pytest.mark.parametrize("data", [b"", b"[]", b"7", b"\xff", b"{}"])
def test_a_datagram_without_age_has_age_zero(data):
    assert age_s(data) == 0.0


@pytest.mark.parametrize(("data", "age"), [(b"{}", 0.1), (b'{"age_s": 0.02}', 0.02), (b'{"age_s": -0.001}', 0.0)])
def test_a_datagram_without_age_has_the_latency_and_one_ahead_of_this_clock_is_new(data, age):
    assert age_s(data, latency_s=0.1) == age


def test_the_latency_of_the_settings_is_in_the_stamp(port):
    with VehicleOdometry(port=port, latency_s=0.1).listen() as records:
        send(port, POSE)
        pose = next(records)
    assert pose.arrival_ns - pose.stamp_ns == 100_000_000


def test_an_old_pose_is_skipped_and_counted(port):
    odometry = VehicleOdometry(port=port)
    with odometry.listen() as records:
        send(port, POSE | {"age_s": 1.5}, POSE)
        assert next(records).data == json.dumps(POSE).encode()
    assert odometry.counters["age_s invalid or too large"] == 1


def test_leaving_the_context_ends_a_waiting_listener(port):
    ended = threading.Event()

    def read(records):
        for _ in records:
            pass
        ended.set()

    with VehicleOdometry(port=port).listen() as records:
        threading.Thread(target=read, args=(records,), daemon=True).start()
    assert ended.wait(60)


def test_a_port_that_cannot_be_opened_is_an_error_that_names_what_to_check(port):
    with pytest.raises(LinkError, match="set `port` to receive"), VehicleOdometry().listen():
        pass
    with (
        VehicleOdometry(port=port).listen(),
        pytest.raises(LinkError, match=rf"cannot listen on UDP 127.0.0.1:{port}.*another grd"),
        VehicleOdometry(port=port).listen(),
    ):
        pass


def test_beyond_loopback_the_sender_is_required():
    with pytest.raises(ValidationError, match="sender: set the sender of the vehicle's odometry"):
        VehicleOdometry(bind="0.0.0.0", port=5000)
