"""Importing captures: every kind of file header and link type, skipped and rejected data, real captures."""

import struct
from pathlib import Path

import pytest
import yaml
from captures import ethernet, fragments, ipv4, pcap, times_ns, udp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flow.link import LinkError, Record
from links.importing import ImportReport, import_file
from links.importing.imported_file import DEFAULT_RIG
from links.recording import RecordingReader
from stages.geometry.frames import LidarMount

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "lidar"
RECORDINGS = Path(__file__).resolve().parents[3] / "recordings"


def data_packet(number: int, product: int = 0x22) -> bytes:
    """A Velodyne data packet as the importer sees it: length, flags of blocks, return mode and product id."""
    return (b"\xff\xee" + bytes([number]) * 98) * 12 + bytes([number]) * 4 + bytes([0x37, product])


RIG = "version: 1\nlidar: {model: VLP-16}\n"
PACKETS = [data_packet(i) for i in range(4)]


def run(tmp_path: Path, content: bytes, **settings) -> tuple[ImportReport, list[Record]]:
    path = tmp_path / "drive.pcap"
    path.write_bytes(content)
    report = import_file(path, overwrite=True, **settings)
    with RecordingReader(report.path) as reader:
        assert reader.warnings == []
        return report, list(reader.records())


# ---- file headers and link types


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nanoseconds", [False, True])
def test_both_byte_orders_and_both_resolutions(tmp_path: Path, order: str, nanoseconds: bool):
    frames = [ethernet(udp(p)) for p in PACKETS]
    report, records = run(tmp_path, pcap(frames, order=order, nanoseconds=nanoseconds))
    assert [r.data for r in records] == PACKETS
    times = times_ns(4, 1 if nanoseconds else 1000)
    before_ns = 24 * 55_296 + 101_760  # firing, then 1272 bytes on a 100 Mbit/s wire: the stamp is the first pulse's
    assert [(r.arrival_ns, r.stamp_ns) for r in records] == [(t, t - before_ns) for t in times]
    assert report.path == tmp_path / "drive.mcap"
    assert (report.topics, report.skipped, report.warnings) == ({"/lidar/packets": 4}, {}, [])


@pytest.mark.parametrize(
    ("link_type", "head"),
    [
        (101, b""),
        (12, b""),
        (14, b""),
        (0, struct.pack("<I", 2)),
        (0, struct.pack(">I", 2)),
        (108, struct.pack(">I", 2)),
        (113, bytes(14) + b"\x08\x00"),
        (276, b"\x08\x00" + bytes(18)),
        (1, bytes(12) + b"\x08\x00"),
        (1 | 0x1400_0000, bytes(12) + b"\x08\x00"),  # upper bits: length of the frame check sequence
    ],
)
def test_each_link_type_gives_the_same_packets(tmp_path: Path, link_type: int, head: bytes):
    _, records = run(tmp_path, pcap([head + udp(p) for p in PACKETS], link_type=link_type))
    assert [r.data for r in records] == PACKETS


def test_vlan_tags_and_ip_options_are_skipped(tmp_path: Path):
    tagged = ethernet(udp(PACKETS[0]), vlans=(0x88A8, 0x8100))
    datagram = struct.pack(">HHHH", 2368, 2368, 8 + 1206, 0) + PACKETS[1]
    with_options = ethernet(ipv4(datagram, options=bytes(8)))
    padded = ethernet(udp(PACKETS[2])) + bytes(6)  # Ethernet padding after the IP packet
    _, records = run(tmp_path, pcap([tagged, with_options, padded]))
    assert [r.data for r in records] == PACKETS[:3]


def test_an_unknown_link_type_and_pcapng_are_rejected_with_advice(tmp_path: Path):
    with pytest.raises(LinkError, match="link type 127 is not supported: capture on an Ethernet"):
        run(tmp_path, pcap([b"x"], link_type=127))
    with pytest.raises(LinkError, match="is a pcapng capture: convert it with `editcap -F pcap ") as error:
        run(tmp_path, b"\x0a\x0d\x0d\x0a" + bytes(100))
    assert f"{tmp_path / 'drive.pcap'} {tmp_path / 'drive-classic.pcap'}`" in str(error.value)  # never onto itself


# ---- what is taken and what is passed over


def test_position_packets_have_their_own_topic(tmp_path: Path):
    report, records = run(tmp_path, pcap([ethernet(udp(PACKETS[0])), ethernet(udp(bytes(512), port=8308))]))
    assert report.topics == {"/lidar/packets": 1, "/lidar/position": 1}
    assert [(r.topic, len(r.data)) for r in records] == [("/lidar/packets", 1206), ("/lidar/position", 512)]


def test_other_packets_are_counted_by_reason(tmp_path: Path):
    frames = [
        ethernet(udp(PACKETS[0])),
        ethernet(udp(b"dns", port=53)),
        ethernet(udp(b"dns", port=53)),
        ethernet(udp(PACKETS[1][:800])),  # the right port, the wrong length
        ethernet(bytes(40), ethertype=0x0806),
        ethernet(ipv4(bytes(20), protocol=6)),
        ethernet(ipv4(bytes(800), fragment=0x2000)),
        ethernet(ipv4(bytes(430), fragment=101)),
        ethernet(ipv4(b"abc")),
        ethernet(udp(PACKETS[2]))[:-4],
        ethernet(b"\x65" + bytes(30)),
    ]
    report, records = run(tmp_path, pcap(frames))
    assert len(records) == 1
    assert report.skipped == {
        "on UDP port 53": 2,
        "IPv4 fragment of an incomplete datagram": 2,
        "damaged UDP header": 2,
        "on UDP port 2368": 1,
        "not IPv4": 1,
        "not UDP": 1,
        "damaged IPv4 header": 1,
    }


def test_fragments_are_put_together_in_any_order_and_each_datagram_once(tmp_path: Path):
    """Of datagrams that are interleaved, with a repeated fragment, and with one that is missing."""
    a, b, c, d = (fragments(packet, number, most=400) for number, packet in enumerate(PACKETS))
    assert [len(parts) for parts in (a, b, c, d)] == [4] * 4
    frames = [a[0], b[2], a[1], b[0], a[1], a[2], b[3], a[3], *c[:2], c[3], b[1], *reversed(d)]
    report, records = run(tmp_path, pcap(frames))
    assert [r.data for r in records] == [PACKETS[0], PACKETS[1], PACKETS[3]]
    assert [r.arrival_ns for r in records] == [times_ns(len(frames), 1000)[k] for k in (7, 11, 15)]
    assert report.skipped == {"IPv4 fragment of an incomplete datagram": 3}


def test_incomplete_datagrams_are_dropped_the_oldest_first(tmp_path: Path):
    first, *others = (fragments(PACKETS[0], number, most=800) for number in range(70))
    frames = [*(parts[0] for parts in (first, *others)), first[1], others[-1][1], ethernet(udp(PACKETS[1]))]
    report, records = run(tmp_path, pcap(frames))
    assert [r.data for r in records] == PACKETS[:2]
    assert report.skipped == {"IPv4 fragment of an incomplete datagram": 70}


def test_a_packet_cut_by_the_snapshot_length_is_counted_as_that(tmp_path: Path):
    whole, cut = ethernet(udp(PACKETS[0])), ethernet(udp(PACKETS[1]))
    content = pcap([whole]) + struct.pack("<IIII", 1_700_000_000, 0, 96, len(cut)) + cut[:96]
    report, _ = run(tmp_path, content)
    assert report.skipped == {"cut short by the capture's snapshot length": 1}


def test_one_of_two_lidars_is_imported_and_can_be_chosen(tmp_path: Path):
    first, second = (192, 168, 1, 201), (192, 168, 1, 202)
    frames = [ethernet(udp(PACKETS[i], sender=(first, second)[i % 2])) for i in range(4)]
    report, records = run(tmp_path, pcap(frames))
    assert [r.data for r in records] == PACKETS[::2]
    assert report.skipped == {"from another sender, 192.168.1.202": 2}
    _, records = run(tmp_path, pcap(frames), sender="192.168.1.202")
    assert [r.data for r in records] == PACKETS[1::2]


def test_another_port_is_suggested_and_accepted(tmp_path: Path):
    content = pcap([ethernet(udp(p, port=2369)) for p in PACKETS])
    with pytest.raises(
        LinkError, match=r"no VLP-16 packet \(1206 bytes\) on UDP port 2368; 4 on port 2369: try --port"
    ):
        run(tmp_path, content)
    _, records = run(tmp_path, content, port=2369)
    assert len(records) == 4


def test_a_capture_without_a_lidar_is_an_error_with_its_content(tmp_path: Path):
    with pytest.raises(LinkError, match=r"no LiDAR packet on UDP port 2368; 2 packets on UDP port 53"):
        run(tmp_path, pcap([ethernet(udp(b"dns", port=53))] * 2))
    assert not (tmp_path / "drive.mcap").exists()


@pytest.mark.parametrize(
    ("product", "name"), [(0x21, "Velodyne HDL-32E"), (0x28, "Velodyne VLP-32C"), (0x99, "an unknown model")]
)
def test_another_model_is_rejected_by_name_and_leaves_no_file(tmp_path: Path, product: int, name: str):
    content = pcap([ethernet(udp(PACKETS[0])), ethernet(udp(data_packet(1, product)))])
    with pytest.raises(LinkError, match=f"the packet at byte 1288 is from {name}.*, not a VLP-16"):
        run(tmp_path, content)
    assert not (tmp_path / "drive.mcap").exists()


def test_packets_of_another_length_than_the_rigs_models_are_named(tmp_path: Path):
    content = pcap([ethernet(udp(p)) for p in PACKETS])
    with pytest.raises(
        LinkError, match=r"4 packets on UDP port 2368 are from a VLP-16; those of a XT16 have 568 bytes: give"
    ):
        run(tmp_path, content, rig_yaml="lidar: {model: XT16, mount: {turns: false}}")
    assert not (tmp_path / "drive.mcap").exists()


# ---- what is attached


def test_a_given_rig_is_attached_and_the_default_one_is_marked_as_a_guess(tmp_path: Path):
    content = pcap([ethernet(udp(PACKETS[0]))])
    report, _ = run(tmp_path, content)
    with RecordingReader(report.path) as reader:
        assert reader.rig_yaml is not None
        assert "The true mount is unknown" in reader.rig_yaml
        assert reader.metadata == {"imported_from": "drive.pcap"}
        known = {"model": "VLP-16", "sender": "192.168.1.201"}
        assert reader.channels == {"/lidar/packets": {**known, "port": "2368"}}
    report, _ = run(tmp_path, content, rig_yaml=RIG)
    with RecordingReader(report.path) as reader:
        assert reader.rig_yaml == RIG


def test_the_default_rig_is_a_valid_mount_that_does_not_turn(tmp_path: Path):
    rig = yaml.safe_load(DEFAULT_RIG.format(model="XT32"))
    mount = LidarMount.model_validate(rig["lidar"]["mount"])
    assert set(rig) == {"version", "lidar", "drone"}
    assert not mount.turns
    assert mount.T_vehicle_turntable.xyz_m == (0.0, 0.0, 1.8)
    assert mount.T_turntable_lidar.xyz_m == (0.0, 0.0, 0.0)  # the depth image has its origin at the lidar


def test_neither_the_source_nor_an_existing_recording_is_overwritten(tmp_path: Path):
    path, other = tmp_path / "drive.pcap", tmp_path / "drive.mcap"
    path.write_bytes(pcap([ethernet(udp(PACKETS[0]))]))
    other.write_text("precious")
    with pytest.raises(LinkError, match="exists already"):
        import_file(path)
    with pytest.raises(LinkError, match="is the file to import"):
        import_file(path, path, overwrite=True)
    assert other.read_text() == "precious"


def test_progress_increases_from_start_to_end(tmp_path: Path):
    seen: list[tuple[int, int]] = []
    content = pcap([ethernet(udp(PACKETS[i % 4])) for i in range(2500)])
    run(tmp_path, content, progress=lambda done, total: seen.append((done, total)))
    assert len(seen) >= 3
    assert seen == sorted(seen)
    assert seen[-1] == (len(content), len(content))


# ---- damage


def test_a_cut_capture_gives_its_whole_packets_and_names_the_byte(tmp_path: Path):
    content = pcap([ethernet(udp(p)) for p in PACKETS])
    one = 16 + 1248
    for cut, whole, text in [
        (24 + 2 * one + 100, 2, f"cut off at byte {24 + 2 * one + 100}, in the packet at {24 + 2 * one}"),
        (24 + 3 * one + 5, 3, f"cut off at byte {24 + 3 * one}, in a packet header"),
        (24 + 3 * one, 3, None),
    ]:
        report, records = run(tmp_path, content[:cut])
        assert [r.data for r in records] == PACKETS[:whole]
        assert report.warnings == ([] if text is None else [f"{tmp_path / 'drive.pcap'}: {text}"])


def test_a_garbage_packet_length_ends_the_import_with_its_byte(tmp_path: Path):
    content = bytearray(pcap([ethernet(udp(p)) for p in PACKETS]))
    offset = 24 + 2 * (16 + 1248)
    content[offset + 8 : offset + 12] = b"\xff\xff\xff\x7f"
    report, records = run(tmp_path, bytes(content))
    assert len(records) == 2
    assert f"the packet header at byte {offset} is damaged" in report.warnings[0]


@pytest.mark.parametrize("size", [0, 3, 10, 24])
def test_a_capture_cut_in_its_header_is_an_error(tmp_path: Path, size: int):
    with pytest.raises(LinkError):
        run(tmp_path, pcap([ethernet(udp(PACKETS[0]))])[:size])


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 24 + 4 * 1264 - 1), st.integers(0, 255)), min_size=1, max_size=6))
def test_flipped_bytes_raise_only_link_errors(tmp_path: Path, flips: list[tuple[int, int]]):
    content = bytearray(pcap([ethernet(udp(p)) for p in PACKETS]))
    for offset, value in flips:
        content[offset] = value
    try:
        _, records = run(tmp_path, bytes(content))
    except LinkError:
        return
    assert len(records) <= 4
    assert all(len(r.data) == 1206 for r in records)


# ---- real captures


def test_the_real_captures_are_imported_completely(tmp_path: Path):
    if not SHARED.exists():
        pytest.skip("needs ../shared/data/lidar")
    report = import_file(SHARED / "vlp16_strongest_einride.pcap", tmp_path / "a.mcap")
    assert report.topics == {"/lidar/packets": 1000}
    report = import_file(SHARED / "vlp16_strongest_gps_mrpt.pcap", tmp_path / "b.mcap")
    assert report.topics == {"/lidar/packets": 293, "/lidar/position": 57}
    with RecordingReader(report.path) as reader:
        assert [r.data.count(b"$GPRMC") for r in reader.records({"/lidar/position"})] == [1] * 57
    with pytest.raises(LinkError, match=r"is from Velodyne HDL-32E .*, not a VLP-16"):
        import_file(SHARED / "hdl32_mrpt_WRONG_MODEL.pcap", tmp_path / "c.mcap", rig_yaml=RIG)
    assert not (tmp_path / "c.mcap").exists()
    report = import_file(SHARED / "hdl32_mrpt_WRONG_MODEL.pcap", tmp_path / "c.mcap")
    with RecordingReader(report.path) as reader:
        assert yaml.safe_load(reader.rig_yaml or "")["lidar"]["model"] == "HDL-32E"
        assert reader.channels["/lidar/packets"]["model"] == "HDL-32E"


@pytest.mark.parametrize(
    ("recording", "capture"),
    [("einride_vlp16", "vlp16_strongest_einride"), ("mrpt_vlp16_gps", "vlp16_strongest_gps_mrpt")],
)
def test_the_committed_recordings_equal_the_imported_captures(tmp_path: Path, recording: str, capture: str):
    if not SHARED.exists():
        pytest.skip("needs ../shared/data/lidar")
    import_file(SHARED / f"{capture}.pcap", tmp_path / "again.mcap")
    with (
        RecordingReader(RECORDINGS / f"{recording}.mcap") as committed,
        RecordingReader(tmp_path / "again.mcap") as again,
    ):
        assert (committed.finished, committed.warnings) == (True, [])
        assert list(committed.records()) == list(again.records())
        assert committed.rig_yaml == again.rig_yaml
        assert (committed.channels, committed.metadata) == (again.channels, again.metadata)
