"""Position packets: GPS time and whether the sensor's clock is locked to it."""

import threading
import time
from datetime import UTC, datetime

import pytest
import velodyne_decoder
from hand_built import captured, packet, record

from flow.link import LinkError
from links.velodyne import Lidar
from links.velodyne.position import Pps, parse_position
from tests.links.ports import free_ports, send

GPRMC = "$GPRMC,081802.50,A,3649.7478558,N,00224.4542928,W,0.034,212.5,210116,0.0,E,A*2B"


def position(nmea=GPRMC, time_us=1_082_500_000, pps=2):
    return bytes(198) + time_us.to_bytes(4, "little") + bytes([pps, 0, 0, 0]) + nmea.encode().ljust(306, b"\0")


def test_time_pps_and_sentence_stand_where_the_datasheet_says():
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
    ("data", "words"), [(bytes(1206), "512 bytes"), (position(pps=9), "PPS"), (position(time_us=2**32 - 1), "time")]
)
def test_what_is_no_position_packet_is_an_error(data, words):
    with pytest.raises(LinkError, match=words):
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
    lidar = Lidar()
    answers = [lidar.decode(record(data, stamp_ns)) for stamp_ns, data in captured("vlp16_strongest_gps_mrpt")]
    assert sum(answer is not None for answer in answers) == lidar.counters["decoded"] == 293
    assert sum(count for name, count in lidar.counters.items() if "position packet" in name) == 57
    assert lidar.counters["lost"] == 0


@pytest.fixture
def ports():
    return free_ports(2)


def test_live_position_packets_are_records_of_their_own_and_their_state_is_counted(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1], sender="127.0.0.1")
    with lidar.listen() as records:
        assert "PPS locked" not in lidar.counters  # nothing is known yet
        send(ports[1], position(pps=1), host="127.0.0.2")  # somebody else's
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


def test_silence_on_the_position_port_alone_is_no_error_and_on_the_data_port_it_is(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1], timeout_s=0.1)
    with lidar.listen() as records:
        send(ports[1], position())
        assert next(records).topic == "/lidar/position"
        with pytest.raises(LinkError, match=rf"no packet on UDP {ports[0]} for 0.1 s"):
            next(records)


def test_with_clock_utc_no_pulse_counts_before_the_sensor_is_locked(ports):
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
    ("told", "words"),
    [((), "no position packet has come"), ((position(pps=3),), "its PPS is error, its GPS knows the time")],
)
def test_with_clock_utc_a_sensor_that_is_not_locked_is_an_error_that_says_why(ports, told, words):
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc", timeout_s=0.5)
    with lidar.listen() as records:
        send(ports[1], *told)
        for _ in told:
            next(records)
        stop = threading.Event()
        sending = threading.Thread(
            target=lambda: [send(ports[0], packet()) for _ in iter(lambda: stop.wait(0.01), True)]
        )
        sending.start()
        try:
            with pytest.raises(LinkError, match=f"not locked to UTC: {words}.*clock: free"):
                next(records)
        finally:
            stop.set()
            sending.join()


@pytest.mark.parametrize(
    ("lost", "words"),
    [
        (position(pps=0), "its PPS is absent, its GPS knows the time"),
        (position(GPRMC.replace("A", "V", 1)), "its PPS is locked, its GPS does not know the time"),
    ],
)
def test_with_clock_utc_a_lock_that_is_lost_is_said_until_it_is_back_and_the_packets_are_taken_on(ports, lost, words):
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc")
    said = []
    with lidar.listen() as records:
        for told in (lost, position(), lost, position(pps=1), position(pps=7), position()):  # the 7 is damaged
            said.append(lidar.status)
            send(ports[1], told)
            assert next(records).data == told
            if lidar.counters.get("PPS locks lost"):
                send(ports[0], packet())
                assert next(records).data == packet()
        said.append(lidar.status)
    before, not_yet, locked, lost_now, still, unheard, again = said
    assert (before, not_yet, locked, again) == (None,) * 4, "a lock that never was is an error of its own, later"
    assert words in lost_now
    assert "GPS antenna" in lost_now
    assert "set clock: free" in lost_now
    assert "PPS is synchronizing" in still
    assert unheard == still


def test_with_clock_utc_position_packets_that_end_are_said(ports, monkeypatch):
    monkeypatch.setattr("links.velodyne.lidar.POSITION_SILENT_S", 0.15)
    lidar = Lidar(port=ports[0], position_port=ports[1], clock="utc", timeout_s=0.15)
    with lidar.listen() as records:
        send(ports[1], position())
        next(records)
        end_s = time.monotonic() + 10.0
        while lidar.status is None and time.monotonic() < end_s:
            send(ports[0], packet())
            next(records)
        assert "no position packet comes any more" in lidar.status
        send(ports[1], position())
        next(records)
        assert lidar.status is None
        send(ports[1], position(pps=0))
        next(records)
        assert lidar.status is not None
    assert lidar.status is None, "nobody listens any more"


def test_with_a_free_clock_a_lost_lock_is_no_failure(ports):
    lidar = Lidar(port=ports[0], position_port=ports[1])
    with lidar.listen() as records:
        for told in (position(), position(pps=0)):
            send(ports[1], told)
            next(records)
        assert lidar.counters["PPS locks lost"] == 1
        assert lidar.status is None


def test_clock_utc_without_position_packets_is_refused_live(ports):
    with pytest.raises(LinkError, match=r"set position_port: 8308.*or clock: free"), Lidar(clock="utc").listen():
        pass
