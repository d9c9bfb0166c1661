"""Decoders of the other models: every point against independent decoders, and refused packets."""

from __future__ import annotations

import json
import math
import socket
import sqlite3
import struct
import subprocess
from collections.abc import Iterator
from os import environ
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import velodyne_decoder
from hand_built import ONE_PACKET_MS, captured, packet, record
from scipy.spatial import cKDTree

from flow.counters import Counters
from flow.graph import load_graph
from flow.link import LinkError, Record
from links.importing.pcap import PcapReport, read_datagrams
from links.lidar import Lidar, hesai_beams, ouster_beams, recognised_model
from links.lidar.checks import LidarObservation, lidar_checks
from links.lidar.reject_reason import PacketRejectReason
from links.preflight.check_result import Level
from links.preflight.observations import ObservedSource
from links.simulated.rig.scenario import RigLidar as ScenarioLidar
from links.simulated.sensors.lidar_packets import PacketEncoder
from stages.aim.beams import Rotor
from stages.geometry.lidar_models import LIDAR_MODELS, lidar_profile
from stages.geometry.rig_lidar import RigLidar
from stages.kernels.lidar import packets as layout
from stages.messages import LidarFirings
from tests.links.ports import free_port

ROOT = Path(__file__).resolve().parents[3]
OTHER = Path(__file__).resolve().parents[4] / "shared" / "data" / "lidar_other"
OUSTER_SDK = environ.get("GRD_OUSTER_SDK_PYTHON")  # python of an environment with ouster-sdk, whose pins exclude ours
START_NS = 1_748_773_230_000_000_000
ORACLES = {"VLP-16": "VLP16", "Puck Hi-Res": "PuckHiRes", "VLP-32C": "VLP32C", "HDL-32E": "HDL32E"}
NEAR_M = 1e-4


def hesai_records(name: str) -> Iterator[Record]:
    """The packets of a ROS 2 bag of pandar_msgs/PandarScan: stamp, 1500 bytes and size of each packet."""
    path = OTHER / f"hesai_{name}.db3"
    if not path.exists():
        pytest.skip(f"{path.name} is missing (../shared/data/lidar_other)")
    for (data,) in sqlite3.connect(path).execute("select data from messages order by timestamp"):
        at = data.find(b"\xee\xff\x06\x01") - 8
        for _ in range(struct.unpack("<I", data[at - 4 : at])[0]):
            seconds, nanoseconds = struct.unpack("<iI", data[at : at + 8])
            size = struct.unpack("<I", data[at + 1508 : at + 1512])[0]
            stamp_ns = seconds * 10**9 + nanoseconds
            yield Record("/lidar/packets", stamp_ns, stamp_ns, bytes(data[at + 8 : at + 8 + size]))
            at += 1512


def points_of(lidar: Lidar, records: Iterator[Record]) -> np.ndarray:
    clouds = [firings.xyz_lidar_m[firings.range_m > 0] for r in records if (firings := lidar.decode(r)) is not None]
    return np.concatenate(clouds)


@pytest.mark.parametrize(("name", "points"), [("xt16", 26_287), ("xt32", 63_021)])
def test_every_point_of_a_hesai_scan_is_that_of_an_independent_decoder(name, points):
    records = hesai_records(name)
    factory = "".join(f"{k + 1},{w},{a}\n" for k, (w, a) in enumerate(zip(*XT32_FACTORY, strict=True)))
    beams = hesai_beams("Channel,Elevation,Azimuth\n" + factory, "factory.csv")[1] if name == "xt32" else None
    lidar = Lidar(slice_ms=ONE_PACKET_MS, unit=RigLidar(model=name.upper(), beams=beams))
    ours = points_of(lidar, records)
    cloud = next(OTHER.glob(f"hesai_{name}_*.pcd")).read_bytes()
    theirs = np.frombuffer(cloud[cloud.index(b"DATA binary\n") + 12 :], "<f4").reshape(-1, 3)
    assert len(theirs) == points
    assert cKDTree(ours).query(theirs)[0].max() < NEAR_M
    assert (lidar.counters["lost"], lidar.counters.rejected) == (0, {})


def test_a_hesai_packet_has_its_model_and_the_wrong_profile_is_refused():
    first = next(hesai_records("xt16"))
    assert recognised_model(first.data) == "XT16"
    for wrong, named in (("XT32", "Hesai with 16 lasers"), ("VLP-16", "XT16")):
        lidar = Lidar(slice_ms=ONE_PACKET_MS, unit=RigLidar(model=wrong))
        with pytest.raises(LinkError, match=rf"come from a {named}.*the rig's LiDAR is a {wrong}"):
            lidar.decode(first)
        assert lidar.counters.rejected in ({PacketRejectReason.LENGTH.value: 1}, {PacketRejectReason.MODEL.value: 1})


@pytest.mark.parametrize("model", ["Puck Hi-Res", "VLP-32C", "HDL-32E"])
def test_a_velodyne_points_where_velodyne_decoder_does(model):
    """Theirs points x forward (our y), rounds azimuths to 0.01 deg."""
    product = lidar_profile(model).product_id
    assert product is not None
    if model == "HDL-32E":
        data = captured("hdl32_mrpt_WRONG_MODEL")[3][1]
    else:
        ranges = np.random.default_rng(3).integers(500, 20_000, (12, 32))
        data = packet(ranges, azimuth=4_321, product=product)
    firings = Lidar(slice_ms=ONE_PACKET_MS, unit=RigLidar(model=model)).decode(record(data))
    assert firings is not None
    oracle = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(min_range=0.0, max_range=300.0))
    theirs = oracle.decode(velodyne_decoder.PacketVector([velodyne_decoder.VelodynePacket(0.0, data)]))
    theirs = np.asarray(theirs[1] if isinstance(theirs, tuple) else theirs)
    hit = firings.range_m > 0
    assert len(theirs) == hit.sum()
    ours = firings.xyz_lidar_m[hit].astype(np.float64)
    expected = np.column_stack([-theirs[:, 1], theirs[:, 0], theirs[:, 2]]).astype(np.float64)
    range_m = np.linalg.norm(expected, axis=1)
    assert np.linalg.norm(ours - expected, axis=1).max() < 2e-4 * range_m.max() + 1e-4  # 0.01 deg at that range
    assert np.abs(ours[:, 2] - expected[:, 2]).max() < 1e-4


@pytest.mark.skipif(OUSTER_SDK is None, reason="set GRD_OUSTER_SDK_PYTHON to a python with ouster-sdk")
@pytest.mark.parametrize("name", ["OS-1-32-G_v2.1.1_1024x10", "OS-0-32-U1_v2.2.0_1024x10"])
def test_every_point_of_an_ouster_is_that_of_ouster_sdk(name, tmp_path):
    assert OUSTER_SDK is not None
    capture, metadata = OTHER / f"{name}.pcap", OTHER / f"{name}.json"
    script = Path(__file__).with_name("ouster_sdk_points.py")
    subprocess.run([OUSTER_SDK, script, capture, metadata, tmp_path / "points.npz"], check=True, capture_output=True)
    theirs = np.load(tmp_path / "points.npz")
    firings = list(ouster_firings(name))
    xyz, range_m, kind = (
        np.concatenate([getattr(f, field) for f in firings]) for field in ("xyz_lidar_m", "range_m", "return_kind")
    )
    ours = xyz[range_m > 0]
    assert len(theirs["xyz_m"]) > 20_000
    # the second return of a pulse whose first is empty is one of kind 0 here; equal returns are one row
    assert cKDTree(ours).query(theirs["xyz_m"])[0].max() < NEAR_M
    assert cKDTree(theirs["xyz_m"]).query(ours)[0].max() < NEAR_M
    assert set(kind.tolist()) == ({0, 1} if "OS-0" in name else {0})


def ouster_firings(name: str, **change) -> Iterator[LidarFirings]:
    capture = OTHER / f"{name}.pcap"
    if not capture.exists():
        pytest.skip(f"{capture.name} is missing (../shared/data/lidar_other)")
    model, beams = ouster_beams((OTHER / f"{name}.json").read_text(), name)
    lidar = Lidar(slice_ms=ONE_PACKET_MS, unit=RigLidar(model=model, beams=beams.model_copy(update=change)))
    with capture.open("rb") as stream:
        for datagram in read_datagrams(stream, capture, PcapReport()):
            firings = lidar.decode(record(datagram.payload, datagram.time_ns))
            if firings is not None:
                yield firings


def test_columns_of_an_ouster_keep_their_own_times():
    firings = next(iter(ouster_firings("OS-1-32-G_v2.1.1_1024x10")))
    columns = firings.pulse_stamp_ns.reshape(16, 32)
    assert (columns == columns[:, :1]).all()
    assert np.diff(columns[:, 0]).mean() == pytest.approx(1e8 / 1024, rel=0.01)


@pytest.mark.parametrize("name", ["OS-1-32-G_v2.1.1_1024x10", "OS-0-32-U1_v2.2.0_1024x10"])
def test_the_first_pulse_of_an_ousters_packet_is_that_of_its_first_valid_column(name: str):
    """As at the edge of an azimuth window: the time of the sensor is that of the same column."""
    model, beams = ouster_beams((OTHER / f"{name}.json").read_text(), name)
    form: Any = Lidar(unit=RigLidar(model=model, beams=beams)).form
    with (OTHER / f"{name}.pcap").open("rb") as stream:
        whole = next(d.payload for d in read_datagrams(stream, OTHER, PcapReport()) if form.is_data(d.payload))
    edge, at_ns = bytearray(whole), 10**12
    for column in range(5):
        head = form.entries.packet_head_bytes + column * int(form.layout[layout.BLOCK_BYTES])
        edge[head + int(form.layout[layout.STATUS_IN_BLOCK])] &= 0xFE
    later_ns = form.first_pulse_ns(at_ns, bytes(edge)) - form.first_pulse_ns(at_ns, whole)
    later_us = form.timestamp_us(bytes(edge)) - form.timestamp_us(whole)
    assert later_ns == pytest.approx(5 * 1e9 / 10 / 1024, abs=2)
    assert later_us == pytest.approx(1e-3 * later_ns, abs=10)


def test_packets_of_another_ouster_are_refused_by_its_serial_number():
    with pytest.raises(LinkError, match="serial number 992137000142, while the rig's beams are those of 7"):
        list(ouster_firings("OS-0-32-U1_v2.2.0_1024x10", serial=7))


def test_an_ouster_without_beams_and_beams_of_another_sensor_are_errors():
    with pytest.raises(ValueError, match="each OS1-32 has its own"):
        RigLidar(model="OS1-32")
    beams = ScenarioLidar.model_validate({"model": "OS0-64"}).beams
    with pytest.raises(ValueError, match="the OS1-32 has 32 lasers, not 64"):
        RigLidar(model="OS1-32", beams=beams)
    for text, says in (
        (json.dumps({"prod_line": "OS-1"}), "it has no 'beam_altitude_angles'"),
        ("[]", "it is no JSON object"),
        ('{"prod_line": ', "Expecting value"),
    ):
        with pytest.raises(LinkError, match=f"not the metadata of an Ouster sensor: {says}"):
            ouster_beams(text, "x.json")
    with pytest.raises(LinkError, match="not the angle correction file"):
        hesai_beams("Channel,Elevation,Azimuth\n1,abc,0\n", "x.csv")


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ("", "it has 0 channels; supported are XT16 and XT32"),
        ("1,5,0\n2,6,0\n", "it has 2 channels; supported are XT16 and XT32"),
        ("".join(f"{n},nan,0\n" for n in range(1, 17)), "elevation_deg.0: Input should be a finite number"),
    ],
)
def test_a_correction_file_with_a_wrong_number_of_channels_or_no_angles_is_refused(rows, reason):
    with pytest.raises(LinkError) as error:
        hesai_beams("Channel,Elevation,Azimuth\n" + rows, "x.csv")
    assert str(error.value) == f"x.csv: not the angle correction file of a Hesai XT: {reason}"


@pytest.mark.parametrize("mode", ["strongest", "dual"])
@pytest.mark.parametrize("model", LIDAR_MODELS)
def test_the_decoder_reads_what_the_simulated_sensor_sends(model, mode):
    unit = ScenarioLidar.model_validate({"model": model})
    if mode == "dual" and unit.beams is not None:
        dual = unit.beams.model_copy(update={"packets": "RNG19_RFL8_SIG16_NIR16_DUAL"})
        unit = unit.model_copy(update={"beams": dual})
    encoder, profile, rng = PacketEncoder(unit, mode), lidar_profile(model), np.random.default_rng(5)
    shape = (encoder.returns, encoder.sequences, profile.lasers)
    range_m = np.sort(rng.integers(200, 12_000, shape) * 0.004, axis=0)
    shade = rng.integers(1, 256, shape).astype(np.uint8)
    turn = math.tau / 1024
    azimuth = math.pi / 2 + turn * np.arange(encoder.sequences)
    firings = Lidar(slice_ms=ONE_PACKET_MS, unit=unit).decode(
        record(encoder.encode(START_NS, azimuth, range_m, shade), START_NS)
    )
    assert firings is not None
    first = firings.return_kind == 0
    np.testing.assert_allclose(firings.range_m[first], range_m[0].ravel(), atol=1e-5)
    np.testing.assert_array_equal(firings.laser[first], np.tile(np.arange(profile.lasers), encoder.sequences))
    np.testing.assert_array_equal(firings.reflectivity[first], shade[0].ravel())
    expected_ns = encoder.sequence_offsets_ns(1)[:, None] + np.array(profile.firing_ns)
    np.testing.assert_array_equal(firings.pulse_stamp_ns[first] - START_NS, expected_ns.ravel())
    offset = np.tile(unit.azimuth_offset_rad, encoder.sequences)
    turned = expected_ns.ravel() if profile.turns_while_firing else np.repeat(expected_ns[:, 0], profile.lasers)
    beam = math.pi / 2 + offset + turn * turned / encoder.sequence_ns
    error = np.abs((firings.azimuth_rad[first] - beam + math.pi) % math.tau - math.pi)
    assert error.max() < math.radians(0.02)
    if mode == "dual":
        second, differs = firings.return_kind == 1, range_m[1] != range_m[0]
        np.testing.assert_allclose(firings.range_m[second], range_m[1][differs], atol=1e-5)
        np.testing.assert_array_equal(firings.reflectivity[second], shade[1][differs])


def simulated_records(unit: RigLidar, packets: int) -> list[Record]:
    """Packets of a room in which every pulse returns from 10 m."""
    encoder, profile = PacketEncoder(unit, "strongest"), lidar_profile(unit.model)
    shape = (1, encoder.sequences, profile.lasers)
    records = []
    for k in range(packets):
        first_ns = START_NS + k * encoder.packet_ns
        azimuth = math.pi / 2 + math.tau / 1024 * (k * encoder.sequences + np.arange(encoder.sequences))
        data = encoder.encode(first_ns, azimuth % math.tau, np.full(shape, 10.0), np.full(shape, 50, np.uint8))
        arrival_ns = first_ns + encoder.packet_ns + 300_000
        records.append(Record("/lidar/packets", arrival_ns, first_ns, data, k))
    return records


@pytest.mark.parametrize("model", ["VLP-32C", "HDL-32E", "XT16", "XT32", "OS0-128", "OS1-64"])
def test_preflight_expects_the_packet_rate_of_the_model(model):
    lidar = Lidar(slice_ms=ONE_PACKET_MS, unit=ScenarioLidar.model_validate({"model": model}))
    observation = LidarObservation("/lidar/packets", lidar.form)
    records = simulated_records(lidar.settings.unit, 300)
    for each in records:
        observation.add(each)
        lidar.decode(each)
    end_ns = records[-1].arrival_ns
    source = ObservedSource("lidar", lidar, observation, Counters.of(lidar.counters), None, end_ns, live=False)
    results = {result.name: result for result in lidar_checks(source)}
    assert results["lidar rate"].level is Level.OK, results
    assert results["lidar return mode"].sentence == "strongest"
    assert results["lidar losses"].sentence == "0 of 300 packets lost"


@pytest.mark.parametrize("model", ["XT32", "OS1-128"])
def test_packets_of_the_model_arrive_live_over_udp(model):
    port = free_port()
    lidar = Lidar(slice_ms=ONE_PACKET_MS, unit=ScenarioLidar.model_validate({"model": model}), port=port)
    sent = simulated_records(lidar.settings.unit, 3)
    with lidar.listen() as records, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        for each in sent:
            udp.sendto(each.data, ("127.0.0.1", port))
        received = [next(records) for _ in sent]
    assert [each.data for each in received] == [each.data for each in sent]
    duration_ns = lidar.form.duration_ns(sent[0].data)
    assert all(duration_ns < each.arrival_ns - each.stamp_ns < duration_ns + 400_000 for each in received)


@pytest.mark.parametrize("model", LIDAR_MODELS)
def test_the_rotors_rate_is_right_although_lasers_point_aside(model):
    unit = ScenarioLidar.model_validate({"model": model})
    lidar, rotor = Lidar(slice_ms=ONE_PACKET_MS, unit=unit), Rotor(unit.azimuth_offset_rad, unit.azimuth_delay_ns)
    for each in simulated_records(unit, 20):
        firings = lidar.decode(each)
        assert firings is not None
        rotor.update(firings)
    expected = math.tau / 1024 / (PacketEncoder(unit, "strongest").sequence_ns * 1e-9)
    assert rotor.rate_radps == pytest.approx(expected, rel=0.03)  # a packet's azimuths are whole 0.01 deg


@pytest.mark.parametrize("rig", sorted(path.name for path in (ROOT / "configs" / "rigs").glob("*.yaml")))
def test_each_rig_file_fits_the_configuration_of_the_vehicle(rig, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text(f"include: [{ROOT}/configs/field.yaml, {ROOT}/configs/rigs/{rig}]\n")
    lidar = load_graph(config).nodes["lidar"].build()
    assert isinstance(lidar, Lidar)
    aim = load_graph(config).nodes["aim"].build()
    assert aim.settings.unit == lidar.settings.unit


# Angle correction file of the XT32 in the capture: elevations, azimuths.
XT32_FACTORY = [
    [float(word) for word in line.split()]
    for line in """
14.972363 13.952372 12.938632 11.931141 10.926151 9.922410 8.917419 7.917429 6.919938 5.919947 4.922456 3.924965 2.929974 1.936233 0.944992 -0.0475 -1.039991 -2.036232 -3.028723 -4.024964 -5.019955 -6.016196 -7.013687 -8.013678 -9.011169 -10.011159 -11.00615 -12.003641 -12.996131 -13.997372 -15.004862 -16.023602
0.082385 0.076529 0.07824 0.076267 0.064337 0.059942 0.049319 0.044992 0.034446 0.027658 0.020896 0.014147 0.008668 -0.000548 -0.007248 -0.015201 -0.025654 -0.031126 -0.037837 -0.045822 -0.061312 -0.06557 -0.068599 -0.076658 -0.088476 -0.09158 -0.098438 -0.092837 -0.102247 -0.104231 -0.118783 -0.129679
""".strip().splitlines()
]
