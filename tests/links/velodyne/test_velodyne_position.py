"""Position packets: GPS time and whether the sensor's clock is locked to it."""

from datetime import UTC, datetime

import pytest
import velodyne_decoder
from hand_built import captured, record

from flow.link import LinkError
from links.velodyne import Lidar
from links.velodyne.position import Pps, parse_position

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
