"""Position packets: GPS time and whether the sensor's clock is locked to it."""

import threading
import time
from datetime import UTC, datetime

import pytest
import velodyne_decoder
from hand_built import ONE_PACKET_MS, captured, packet, record

from flow.link import LinkError
from links.lidar import Lidar
from links.lidar.position import Pps, parse_position
from tests.links.ports import free_ports, send

GPRMC = "$GPRMC,081802.50,A,3649.7478558,N,00224.4542928,W,0.034,212.5,210116,0.0,E,A*2B"


def position(nmea=GPRMC, time_us=1_082_500_000, pps=2):
    return bytes(198) + time_us.to_bytes(4, "little") + bytes([pps, 0, 0, 0]) + nmea.encode().ljust(306, b"\0")


def test_time_pps_and_sentence_are_read_at_the_datasheets_offsets():
    read = parse_position(position(GPRMC + "\r\n"))
    assert (read.timestamp_us, read.pps, read.nmea) == (1_082_500_000, Pps.LOCKED, GPRMC)
    assert read.gps_utc == datetime(2016, 1, 21, 8, 18, 2, 500_000, tzinfo=UTC)
    assert read.gps_valid


@pytest.mark.parametrize(("pps", "state"), list(enumerate(Pps)))
def test_every_pps_state_is_named(pps, state):
    assert parse_position(position(pps=pps)).pps is state


@pytest.mark.parametrize(
    "nmea", ["", "$GPRMC", GPRMC[:40], GPRMC.replace("A", "V", 1), GPRMC.replace("*2B", "*zz"), "$GPGGA,1*00"]
)
def test_a_missing_or_damaged_sentence_gives_no_time(nmea):
    read = parse_position(position(nmea))
    assert read.nmea == nmea
    assert read.gps_utc is None
    assert not read.gps_valid


@pytest.mark.parametrize(
    ("data", "expected_text"),
    [(bytes(1206), "512 bytes"), (position(pps=9), "PPS"), (position(time_us=2**32 - 1), "time")],
)
def test_a_payload_that_is_no_position_packet_is_an_error(data, expected_text):
    with pytest.raises(LinkError, match=expected_text):
        parse_position(data)


def test_all_real_position_packets_are_read_as_velodyne_decoder_reads_them():
    packets = [data for _, data in captured("vlp16_strongest_gps_mrpt") if len(data) == 512]
    assert len(packets) == 57
    for data in packets:
        ours, theirs = parse_position(data), velodyne_decoder.TelemetryPacket(data)
        assert ours.timestamp_us == theirs.usec_since_toh
        assert ours.pps.name == theirs.pps_status.name == "LOCKED"
        assert ours.gps_utc is not None
        assert ours.gps_utc.replace(tzinfo=None) == theirs.nmea_time
        assert ours.gps_valid
        # A locked clock: the sensor's microseconds of the hour continue the sentence's minutes and seconds.
        assert 0 <= 1e-6 * ours.timestamp_us - (60 * ours.gps_utc.minute + ours.gps_utc.second) < 1.5


def test_the_data_topic_ignores_and_counts_position_packets():
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    messages = [lidar.decode(record(data, stamp_ns)) for stamp_ns, data in captured("vlp16_strongest_gps_mrpt")]
    assert sum(message is not None for message in messages) == lidar.counters["decoded"] == 293
    assert sum(count for name, count in lidar.counters.items() if "position packet" in name) == 57
    assert lidar.counters["lost"] == 0


@pytest.fixture
def ports():
    return free_ports(2)


def test_live_position_packets_are_recorded_separately_and_their_state_is_counted(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1], sender="127.0.0.1")
    with lidar.listen() as records:
        assert "PPS locked" not in lidar.counters  # nothing is known yet
        send(ports[1], position(pps=1), host="127.0.0.2")  # from another sender
        send(ports[1], position(pps=0))
        assert next(records).data == position(pps=0)
        assert (lidar.counters["PPS absent"], lidar.counters["PPS locked"]) == (1, 0)
        send(ports[1], position())
        found = next(records)
        assert (found.topic, found.data, found.stamp_ns) == ("/lidar/position", position(), found.arrival_ns)
        send(ports[0], packet())
        assert next(records).topic == "/lidar/packets"
        send(ports[1], position(pps=1), b"no position packet")
        next(records), next(records)
    counters = lidar.counters
    assert (counters["PPS absent"], counters["PPS locked"], counters["PPS synchronizing"]) == (0, 0, 1)
    assert (counters["position packets"], counters["position packets damaged"]) == (3, 1)
    assert (counters["PPS locks lost"], counters["GPS time valid"], counters["from other senders"]) == (1, 1, 1)


def test_a_timeout_on_the_data_port_is_an_error_and_on_the_position_port_it_is_not(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1], timeout_s=0.1)
    with lidar.listen() as records:
        send(ports[1], position())
        assert next(records).topic == "/lidar/position"
        with pytest.raises(LinkError, match=rf"no packet on UDP {ports[0]} for 0.1 s"):
            next(records)


def test_with_clock_utc_no_data_packet_is_accepted_before_the_sensor_is_locked(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc")
    with lidar.listen() as records:
        send(ports[0], packet(azimuth=1))
        send(ports[1], position(pps=1))
        assert next(records).topic == "/lidar/position"  # recorded all the same
        send(ports[1], position(GPRMC.replace("A", "V", 1)))  # a pulse without the time
        assert next(records).topic == "/lidar/position"
        send(ports[1], position())
        assert next(records).topic == "/lidar/position"
        send(ports[0], packet(azimuth=2))
        assert next(records).data == packet(azimuth=2)


@pytest.mark.parametrize(
    ("position_packets", "expected_text"),
    [((), "no position packet has arrived"), ((position(pps=3),), "its PPS is error, its GPS time is valid")],
)
def test_with_clock_utc_a_sensor_that_is_not_locked_is_an_error_with_the_reason(ports, position_packets, expected_text):
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc", timeout_s=0.5)
    with lidar.listen() as records:
        send(ports[1], *position_packets)
        for _ in position_packets:
            next(records)
        stop = threading.Event()
        sending = threading.Thread(
            target=lambda: [send(ports[0], packet()) for _ in iter(lambda: stop.wait(0.01), True)]
        )
        sending.start()
        try:
            with pytest.raises(LinkError, match=f"not locked to UTC: {expected_text}.*clock: free"):
                next(records)
        finally:
            stop.set()
            sending.join()


@pytest.mark.parametrize(
    ("lost", "expected_text"),
    [
        (position(pps=0), "its PPS is absent, its GPS time is valid"),
        (position(GPRMC.replace("A", "V", 1)), "its PPS is locked, its GPS time is not valid"),
    ],
)
def test_with_clock_utc_a_lost_lock_is_reported_until_it_returns_and_packets_are_still_accepted(
    ports, lost, expected_text
):
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc")
    statuses = []
    with lidar.listen() as records:
        for data in (lost, position(), lost, position(pps=1), position(pps=7), position()):  # the 7 is damaged
            statuses.append(lidar.status)
            send(ports[1], data)
            assert next(records).data == data
            if lidar.counters.get("PPS locks lost"):
                send(ports[0], packet())
                assert next(records).data == packet()
        statuses.append(lidar.status)
    before, not_yet, locked, lost_now, still_lost, after_damaged, locked_again = statuses
    assert (before, not_yet, locked, locked_again) == (None,) * 4, "a lock that never existed is another error, later"
    assert expected_text in lost_now
    assert "GPS antenna" in lost_now
    assert "set clock: free" in lost_now
    assert "PPS is synchronizing" in still_lost
    assert after_damaged == still_lost


def test_with_clock_utc_the_end_of_position_packets_is_reported(ports, monkeypatch):
    monkeypatch.setattr("links.lidar.lidar.POSITION_TIMEOUT_S", 0.15)
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc", timeout_s=0.15)
    with lidar.listen() as records:
        send(ports[1], position())
        next(records)
        end_s = time.monotonic() + 10.0
        while lidar.status is None and time.monotonic() < end_s:
            send(ports[0], packet())
            next(records)
        assert "no position packet arrives" in lidar.status
        send(ports[1], position())
        next(records)
        assert lidar.status is None
        send(ports[1], position(pps=0))
        next(records)
        assert lidar.status is not None
    assert lidar.status is None, "not listening any more"


def test_with_a_free_clock_a_lost_lock_is_not_reported(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1])
    with lidar.listen() as records:
        for data in (position(), position(pps=0)):
            send(ports[1], data)
            next(records)
        assert lidar.counters["PPS locks lost"] == 1
        assert lidar.status is None


def test_clock_utc_without_position_packets_is_rejected_live(ports):
    with pytest.raises(LinkError, match=r"set position_port: 8308.*or clock: free"), Lidar(clock="utc").listen():
        pass
