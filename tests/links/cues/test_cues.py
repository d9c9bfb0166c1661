"""The link of cues: JSON and NMEA datagrams, senders, and everything that is no cue."""

from __future__ import annotations

import json
import math
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from flow.link import LinkError, Record
from links.cues import Cues
from links.cues.cues import MAX_REASONS
from links.cues.parsing import CueParser
from stages.messages import DroneGnss, UwbRange, VehicleGnss
from tests.flow.live_toys import PATIENCE_S, Memory, graph_of, run_live
from tests.links import ports

STAMP_NS = 1_748_773_230_000_000_000
PLACE = {"latitude_deg": 35.66, "longitude_deg": 139.7, "altitude_m": 40.0}


def sentence(body: str) -> bytes:
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode()


GGA = sentence("GNGGA,123519,4807.038,N,01131.000,W,1,08,0.9,545.4,M,46.9,M,,")
GGA_6 = sentence("GNGGA,123519,4807.038,N,01131.000,W,6,08,0.9,545.4,M,46.9,M,,")  # dead reckoning


def parse(content: object):
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    found, rejected = CueParser().parse(STAMP_NS, data)
    if rejected:
        raise ValueError(rejected[0])
    return found


def test_each_cue_is_read():
    (vehicle,) = parse({"vehicle_gnss": PLACE | {"sigma_m": 1.5, "heading_deg": 80.0, "heading_sigma_deg": 2.0}})
    assert isinstance(vehicle, VehicleGnss)
    assert math.degrees(vehicle.latitude_rad) == pytest.approx(35.66)
    assert (vehicle.sigma_m, vehicle.sigma_up_m) == (1.5, None)
    assert math.degrees(vehicle.yaw_enu_rad) == pytest.approx(10.0)  # a heading of 80 deg is 10 deg north of east
    assert math.degrees(vehicle.yaw_sigma_rad) == pytest.approx(2.0)
    (drone,) = parse({"drone_gnss": PLACE, "age_s": 0.1})
    assert isinstance(drone, DroneGnss)
    assert math.degrees(drone.longitude_rad) == pytest.approx(139.7)
    (uwb,) = parse({"uwb_range": {"range_m": 17.25}})
    assert isinstance(uwb, UwbRange)
    assert (uwb.range_m, uwb.sigma_m) == (17.25, None)


def test_nmea_gives_position_and_the_heading_of_the_last_second():
    parser = CueParser()
    assert parser.parse(STAMP_NS, sentence("GNHDT,274.07,T")) == ([], [])
    (gnss,), _ = parser.parse(STAMP_NS + 500_000_000, GGA)
    assert isinstance(gnss, VehicleGnss)
    assert math.degrees(gnss.latitude_rad) == pytest.approx(48 + 7.038 / 60)
    assert math.degrees(gnss.longitude_rad) == pytest.approx(-(11 + 31.0 / 60))
    assert gnss.altitude_m == 545.4
    assert math.degrees(gnss.yaw_enu_rad) == pytest.approx(360 + 90 - 274.07)
    (later,), _ = parser.parse(STAMP_NS + 1_500_000_000, GGA)
    assert later.yaw_enu_rad is None


def test_nmea_without_a_fix_and_other_sentences_are_no_cue():
    assert parse(sentence("GNGGA,123519,,,,,0,,,,,,,,")) == []
    assert parse(sentence("GNVTG,054.7,T,,M,005.5,N,010.2,K")) == []


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "neither JSON nor NMEA"),
        (b"\xff\xfe", "neither JSON nor NMEA"),
        (b"[" * 1500, "neither JSON nor NMEA"),
        (b" " * 3000, "longer"),
        ([1, 2], "no JSON object"),
        ({"other": 1}, "unknown field 'other'"),
        ({"age_s": 0.1}, "no cue"),
        ({"vehicle_gnss": PLACE | {"heading": 80}}, "unknown field 'heading'"),
        ({"drone_gnss": PLACE | {"heading_deg": 80}}, "unknown field 'heading_deg'"),
        ({"vehicle_gnss": PLACE | {"heading_deg": 80, "heading_sigma_deg": 0}}, "heading_sigma_deg is 0"),
        ({"vehicle_gnss": 5}, "latitude_deg"),
        ({"vehicle_gnss": PLACE | {"latitude_deg": 91}}, "latitude_deg is 91: not within -90 to 90"),
        ({"vehicle_gnss": PLACE | {"altitude_m": None}}, "altitude_m"),
        ({"vehicle_gnss": PLACE | {"sigma_m": -1}}, "not within"),
        ({"vehicle_gnss": PLACE | {"heading_deg": "80"}}, "heading_deg"),
        (b'{"uwb_range": {"range_m": NaN}}', "not within"),
        (b'{"uwb_range": {"range_m": 1e999}}', "not within"),
        (b'{"uwb_range": {"range_m": 1' + 400 * b"0" + b"}}", "not within"),
        ({"uwb_range": {"range_m": True}}, "range_m"),
        ({"uwb_range": {"range_m": 2000}}, "not within"),
        (GGA.replace(b"545.4", b"545.5"), "checksum"),
        (sentence("GNGGA,123519,4807.038,N"), "cut off"),
        (sentence("GNGGA,123519,4807.038,X,01131.000,W,1,08,0.9,545.4,M,46.9,M,,"), "hemisphere"),
        (sentence("GNGGA,123519,nan,N,01131.000,W,1,08,0.9,545.4,M,46.9,M,,"), "not within"),
        (sentence("GNHDT,x,T"), "without a number"),
        (sentence("GNHDT"), "cut off"),
        (sentence("GNHDT,400,T"), "the heading is 400.0: not within 0 to 360"),
        (GGA_6, "quality '6'"),
    ],
)
def test_what_is_no_cue_is_rejected_with_a_reason(content, reason):
    with pytest.raises(ValueError, match=reason):
        parse(content)


@given(st.binary(max_size=200) | st.binary(max_size=60).map(lambda tail: b"$GNGGA," + tail))
def test_no_bytes_raise_anything_but_are_counted(data):
    cues = Cues()
    found = list(cues.decode(Record("/cues", STAMP_NS, STAMP_NS, data)))
    assert len(found) + sum(cues.counters.rejected.values()) <= 1 + data.count(b"\n")


def test_each_sentence_of_a_datagram_is_accepted_or_rejected_on_its_own():
    parser = CueParser()
    parser.parse(STAMP_NS, sentence("GNHDT,274.07,T"))
    (gnss,), rejected = parser.parse(STAMP_NS, b"\r\n" + sentence("GNHDT,,T") + GGA + b"\r\n")
    assert isinstance(gnss, VehicleGnss)
    assert gnss.yaw_enu_rad is None  # the receiver has no heading any more
    assert rejected == []
    found, rejected = parser.parse(STAMP_NS, GGA.replace(b"545.4", b"545.5") + GGA)
    assert (len(found), rejected) == (1, ["NMEA with a wrong checksum"])


def test_the_number_of_reasons_that_are_counted_is_limited():
    cues = Cues()
    for k in range(100):
        list(cues.decode(Record("/cues", STAMP_NS, STAMP_NS, json.dumps({f"field {k}": 1}).encode())))
    assert len(cues.counters.rejected) == MAX_REASONS + 1
    assert sum(cues.counters.rejected.values()) == 100


def test_a_cue_arrives_by_udp_stamped_by_its_age_and_others_senders_are_ignored():
    port = ports.free_port()
    cues = Cues(port=port, sender="127.0.0.1")
    with cues.listen() as records:
        ports.send(port, b'{"uwb_range": {"range_m": 5}}', host="127.0.0.2")
        ports.send(port, json.dumps({"uwb_range": {"range_m": 7}, "age_s": 0.25}).encode(), host="127.0.0.1")
        ports.send(port, GGA, host="127.0.0.1")
        ranged, nmea = next(records), next(records)
    assert ranged.arrival_ns - ranged.stamp_ns == 250_000_000
    assert [cue.range_m for cue in cues.decode(ranged)] == [7.0]
    assert len(list(cues.decode(nmea))) == 1
    assert [record.topic for record in (ranged, nmea)] == list(cues.replay_topics)
    assert cues.counters["from other senders"] == 1


def test_a_live_run_has_the_cues_of_json_and_of_nmea(tmp_path):
    port, memory = ports.free_port(), Memory()
    text = f"""\
stages:
  ticker: {{use: tests.flow.live_toys.Ticker, thread: one, inputs: {{tick: clock.tick}}}}
links:
  clock: {{use: links.clock.Clock, thread: one}}
  cues: {{use: links.cues.Cues, thread: one, config: {{port: {port}}}}}
"""
    live = run_live(graph_of(tmp_path, text), [memory])
    deadline_s = time.monotonic() + PATIENCE_S
    while len({type(message) for _, _, message in memory._seen}) < 4 and time.monotonic() < deadline_s:
        ports.send(port, b'{"uwb_range": {"range_m": 5}}')
        ports.send(port, GGA)
        time.sleep(0.02)
    live.stop()
    names = {output for output, _, _ in memory._seen}
    assert names == {"clock.tick", "ticker.number", "cues.uwb_range", "cues.vehicle_gnss"}


def test_beyond_loopback_a_sender_is_required():
    with pytest.raises(ValidationError, match="sender"):
        Cues(port=1234, bind="0.0.0.0")
    Cues(port=1234, bind="0.0.0.0", sender="192.168.1.9")


def test_without_a_port_there_are_no_live_cues():
    with pytest.raises(LinkError, match="set `port`"), Cues().listen():
        pass
