"""Live listening, on real loopback sockets."""

import threading
import time

import pytest
from hand_built import DUAL, ONE_PACKET_MS, SINGLE_PACKET_NS, packet
from pydantic import ValidationError

from flow.link import LinkError
from links.clock import host_time
from links.lidar import Lidar, packet_format
from tests.links.ports import free_port, send

WIRE_NS = 101_760


@pytest.fixture
def port():
    return free_port()


def test_packets_arrive_in_order_as_records_that_decode(port):
    lidar = Lidar(port=port, slice_ms=ONE_PACKET_MS)
    sent = [packet(azimuth=100 * k, time_us=1_327 * k) for k in range(5)]
    with lidar.listen() as records:
        before_ns = host_time.now_ns()
        send(port, *sent)
        received = [next(records) for _ in sent]
        after_ns = host_time.now_ns()
    assert [r.data for r in received] == sent
    assert [r.sequence for r in received] == [0, 1, 2, 3, 4]
    assert all(r.topic == "/lidar/packets" and before_ns <= r.arrival_ns <= after_ns for r in received)
    assert all(r.stamp_ns == r.arrival_ns - SINGLE_PACKET_NS - WIRE_NS for r in received)
    assert all(lidar.decode(r) is not None for r in received)


def test_a_packets_first_pulse_is_its_firing_time_before_its_arrival():
    assert packet_format("VLP-16").first_pulse_ns(10_000_000, packet()) == 10_000_000 - SINGLE_PACKET_NS - WIRE_NS
    assert (
        packet_format("VLP-16").first_pulse_ns(10_000_000, packet(mode=DUAL))
        == 10_000_000 - SINGLE_PACKET_NS // 2 - WIRE_NS
    )
    assert packet_format("VLP-16").first_pulse_ns(10_000_000, b"other") == 10_000_000


def test_packets_from_other_senders_are_ignored_and_counted(port):
    lidar = Lidar(port=port, sender="127.0.0.1")
    with lidar.listen() as records:
        send(port, packet(azimuth=1), packet(azimuth=2), host="127.0.0.2")
        send(port, packet(azimuth=3))
        assert next(records).data == packet(azimuth=3)
    assert lidar.counters["from other senders"] == 2


def test_a_timeout_is_an_error_that_names_what_to_check(port):
    lidar = Lidar(port=port, timeout_s=0.05)
    with (
        lidar.listen() as records,
        pytest.raises(LinkError, match=rf"no packet on UDP {port} for 0.05 s: is the LiDAR powered, and is this host"),
    ):
        next(records)


def test_foreign_packets_do_not_prevent_the_timeout(port):
    lidar = Lidar(port=port, sender="127.0.0.3", timeout_s=0.05)
    with lidar.listen() as records:
        send(port, packet(), packet(), host="127.0.0.2")
        with pytest.raises(LinkError, match=r"no packet from 127.0.0.3 .* 2 from others \(last 127.0.0.2\).*`sender`"):
            next(records)


def test_a_port_in_use_is_an_error_that_names_it(port):
    with (
        Lidar(port=port).listen(),
        pytest.raises(LinkError, match=rf"cannot listen on UDP 127.0.0.1:{port}: Address already in use.*another grd"),
        Lidar(port=port).listen(),
    ):
        pass


def test_an_address_of_another_machine_is_an_error_that_names_it(port):
    lidar = Lidar(port=port, bind="203.0.113.7", sender="203.0.113.8")
    with pytest.raises(LinkError, match=r"Set `bind` to an address of this host"), lidar.listen():
        pass


def test_leaving_the_context_ends_a_waiting_listener_and_frees_the_port(port):
    lidar = Lidar(port=port, slice_ms=ONE_PACKET_MS)
    received, ended = [], threading.Event()

    def read(records):
        for record in records:
            received.append(record)
        ended.set()  # not reached when the iterator raises

    with lidar.listen() as records:
        reader = threading.Thread(target=read, args=(records,))
        reader.start()
        send(port, packet())
        while not received:
            time.sleep(0.001)
    reader.join(timeout=5)
    assert ended.is_set()
    assert len(received) == 1
    with Lidar(port=port).listen():
        pass


def test_listening_beyond_loopback_needs_the_lidars_address():
    with pytest.raises(ValidationError, match=r"sender: set the LiDAR's address .* when binding to 0.0.0.0"):
        Lidar(bind="0.0.0.0")
    assert str(Lidar(bind="0.0.0.0", sender="192.168.1.201").settings.sender) == "192.168.1.201"


@pytest.mark.parametrize(
    "setting", [{"port": 0}, {"bind": "lidar"}, {"clock": "gps"}, {"timeout_s": 0}, {"clock_limit_s": -1}, {"typo": 1}]
)
def test_impossible_settings_are_errors(setting):
    with pytest.raises(ValidationError):
        Lidar(**setting)
