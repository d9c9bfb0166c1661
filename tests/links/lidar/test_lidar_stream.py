"""A stream of packets: lost, repeated, damaged, foreign, and random bytes."""

import random

import numpy as np
import pytest
from hand_built import (
    DUAL,
    HDL32E,
    HOUR_NS,
    ONE_PACKET_MS,
    PUCK_HI_RES,
    SINGLE_PACKET_NS,
    STRONGEST,
    captured,
    captured_records,
    exact_records,
    packet,
    record,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from flow.graph import load_graph
from flow.link import LinkError
from flow.message import array_fields, check_arrays
from flow.replay import replay
from links.lidar import Lidar
from links.lidar.reject_reason import PacketRejectReason
from stages.geometry.rig_lidar import RigLidar

SWEEP = """\
stages:
  sweep: {use: stages.sweep.Sweep, config: {mount: {turns: false}}, inputs: {firings: lidar.lidar_firings}}
links:
  lidar: {use: links.lidar.Lidar, config: {slice_ms: 0.1}}
"""


def lost_in(records):
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    lost = [lidar.decode(r).lost_packets for r in records]
    assert lidar.counters["lost"] == sum(lost)
    return lost


def rejected(lidar, reason):
    return lidar.counters.get(f"rejected: {reason.value}", 0)


@pytest.mark.parametrize("start_ns", [0, HOUR_NS - 20 * SINGLE_PACKET_NS])
def test_lost_packets_are_counted_at_the_gap(start_ns):
    records = exact_records(40, start_ns)
    assert lost_in(records) == [0] * 40
    assert lost_in(records[:10] + records[13:19] + records[20:]) == [0] * 10 + [3] + [0] * 5 + [1] + [0] * 19


def test_dual_return_packets_come_twice_as_often():
    records = exact_records(20, interval_ns=SINGLE_PACKET_NS // 2, mode=DUAL)
    assert lost_in(records[:5] + records[6:]) == [0] * 5 + [1] + [0] * 13


def test_a_change_of_return_mode_loses_nothing():
    single = exact_records(5)
    dual = exact_records(5, start_ns=5 * SINGLE_PACKET_NS, interval_ns=SINGLE_PACKET_NS // 2, mode=DUAL)
    again = exact_records(5, start_ns=5 * SINGLE_PACKET_NS + 5 * SINGLE_PACKET_NS // 2)
    assert sum(lost_in(single + dual + again)) == 0


def test_losses_are_counted_by_the_sensors_clock_not_by_late_arrival():
    records = exact_records(40)
    assert sum(lost_in(records[:20] + [record(r.data, r.stamp_ns + 30_000_000) for r in records[20:]])) == 0


@pytest.mark.parametrize("capture", ["vlp16_strongest_einride", "vlp16_strongest_gps_mrpt"])
def test_a_real_stream_loses_nothing_until_packets_are_removed(capture):
    records = list(captured_records(capture))
    assert sum(lost_in(records)) == 0
    assert sum(lost_in(records[:100] + records[107:])) == 7


def test_repeated_and_overtaken_packets_are_ignored_and_counted():
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    a, b, c, d = exact_records(4)
    messages = [lidar.decode(r) for r in (a, c, b, c, d)]
    assert [message is not None for message in messages] == [True, True, False, False, True]
    assert [messages[k].lost_packets for k in (0, 1, 4)] == [0, 1, 0]
    assert rejected(lidar, PacketRejectReason.ORDER) == 2


def decoded(records, packets, packet_ns=SINGLE_PACKET_NS):
    lidar = Lidar(slice_ms=packets * packet_ns * 1e-6)
    return [lidar.decode(r) for r in records]


def packets_of(messages):
    return [0 if message is None else message.pulse_stamp_ns.size // 384 for message in messages]


@pytest.mark.parametrize("mode", [STRONGEST, DUAL])
def test_several_packets_in_a_message_equal_the_single_packets_concatenated(mode):
    interval_ns = SINGLE_PACKET_NS // (2 if mode == DUAL else 1)
    ranges = np.random.default_rng(1).integers(0, 30_000, (12, 32))
    records = exact_records(9, interval_ns=interval_ns, mode=mode, ranges=ranges)
    single, three = (decoded(records, n, interval_ns) for n in (1, 3))
    assert [message is not None for message in three] == 3 * [False, False, True]
    for k, group in enumerate(three[2::3]):
        check_arrays(group)
        assert group.stamp_ns == single[3 * k].stamp_ns
        for name, _, shape in array_fields(type(group)):
            if "n" in shape.dims:
                parts = [getattr(one, name) for one in single[3 * k : 3 * k + 3]]
                np.testing.assert_array_equal(getattr(group, name), np.concatenate(parts), err_msg=name)


@pytest.mark.parametrize(("slice_ms", "packets"), [(0.1, 1), (1.9, 1), (2.1, 2), (10.0, 8)])
def test_a_message_holds_the_packets_whose_duration_is_nearest_to_a_slice(slice_ms, packets):
    lidar = Lidar(slice_ms=slice_ms)
    assert packets_of(lidar.decode(r) for r in exact_records(packets)) == [0] * (packets - 1) + [packets]


def test_a_gap_ends_a_message_and_the_next_one_holds_the_number_of_lost_packets():
    records = exact_records(12)
    messages = decoded(records[:2] + records[5:11], 4)
    assert packets_of(messages) == [0, 0, 2, 0, 0, 4, 0, 0]
    assert [message.lost_packets for message in messages if message] == [0, 3]


def test_a_rejected_packet_ends_a_message_and_keeps_the_packets_before_it():
    records = exact_records(6)
    with_bad = [*records[:2], record(packet(step=3_000, time_us=2_654), 2_654_208), *records[3:]]
    messages = decoded(with_bad, 3)
    assert packets_of(messages) == [0, 0, 0, 2, 0, 3]
    assert [message.lost_packets for message in messages if message] == [0, 1]


def damaged(**change):
    data = bytearray(packet(time_us=1_327))
    for at, value in change.values():
        data[at : at + len(value)] = value
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", PacketRejectReason.LENGTH),
        (packet()[:-1], PacketRejectReason.LENGTH),
        (bytes(512), PacketRejectReason.POSITION),
        (damaged(flag=(700, b"\xff\xdd")), PacketRejectReason.FLAG),
        (damaged(azimuth=(602, (36_000).to_bytes(2, "little"))), PacketRejectReason.AZIMUTH),
        (damaged(azimuth=(602, (9_000).to_bytes(2, "little"))), PacketRejectReason.AZIMUTH),
        (damaged(mode=(1204, b"\x36")), PacketRejectReason.RETURN_MODE),
        (damaged(product=(1205, b"\x00")), PacketRejectReason.MODEL),
        (damaged(time=(1200, (3_600_000_000).to_bytes(4, "little"))), PacketRejectReason.TIMESTAMP),
    ],
)
def test_a_bad_packet_in_a_good_stream_is_ignored_and_counted_as_lost(data, reason):
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    first, _, third = exact_records(3)
    assert lidar.decode(first) is not None
    assert lidar.decode(record(data, SINGLE_PACKET_NS)) is None
    assert rejected(lidar, reason) == 1
    assert lidar.decode(third).lost_packets == 1
    assert lidar.counters["decoded"] == 2


def test_dual_return_blocks_of_one_pulse_share_their_azimuth():
    data = bytearray(packet(mode=DUAL))
    data[102] += 1
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    assert lidar.decode(record(bytes(data))) is None
    assert rejected(lidar, PacketRejectReason.AZIMUTH) == 1


@pytest.mark.parametrize(
    ("product", "name"), [(HDL32E, "HDL-32E"), (PUCK_HI_RES, "Puck Hi-Res"), (0x28, "VLP-32C"), (0xA1, "VLS-128")]
)
def test_another_model_is_rejected_by_name_at_its_first_packet(product, name):
    with pytest.raises(LinkError, match=rf"Velodyne {name}.*the rig's LiDAR is a VLP-16"):
        Lidar(slice_ms=ONE_PACKET_MS).decode(record(packet(product=product)))


def test_packets_of_another_maker_are_named_at_the_first_one():
    unit = RigLidar(model="XT16")
    with pytest.raises(LinkError, match=r"these packets come from a VLP-16, the rig's LiDAR is a XT16: set rig.lidar"):
        Lidar(slice_ms=ONE_PACKET_MS, unit=unit).decode(record(packet()))


def test_an_hdl64_is_recognised_by_its_lower_blocks():
    data = bytearray(packet(product=0x07))
    for block in range(1, 12, 2):
        data[100 * block + 1] = 0xDD
    with pytest.raises(LinkError, match="HDL-64E"):
        Lidar(slice_ms=ONE_PACKET_MS).decode(record(bytes(data)))


def test_a_real_hdl32_capture_is_rejected_by_name():
    with pytest.raises(LinkError, match=r"HDL-32E \(product id 0x21\)"):
        Lidar(slice_ms=ONE_PACKET_MS).decode(record(captured("hdl32_mrpt_WRONG_MODEL")[0][1]))


def test_a_hundred_consecutive_bad_packets_are_an_error_with_the_reasons():
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    lidar.decode(exact_records(1)[0])
    for _ in range(60):
        assert lidar.decode(record(bytes(1206))) is None
    for _ in range(39):
        assert lidar.decode(record(bytes(100))) is None
    with pytest.raises(
        LinkError, match=r"100 consecutive packets.*60 not the model's product id, 40 of another length"
    ):
        lidar.decode(record(bytes(100)))


def test_a_recording_with_a_burst_of_bad_packets_is_replayed_to_its_end(tmp_path):
    (tmp_path / "x.yaml").write_text(SWEEP)
    good = exact_records(4)
    report = replay(load_graph(tmp_path / "x.yaml"), [*good[:2], *[record(bytes(1206))] * 250, *good[2:]])
    assert report.messages["lidar.lidar_firings"] == 4
    (event,) = report.events
    assert (event.node, event.count) == ("lidar", 2)
    assert "100 consecutive packets are invalid" in event.text


def test_one_good_packet_resets_the_count_of_bad_ones():
    lidar = Lidar(slice_ms=ONE_PACKET_MS)
    good = exact_records(2)
    for r in (good[0], good[1]):
        for _ in range(99):
            assert lidar.decode(record(bytes(1206))) is None
        assert lidar.decode(r) is not None


valid = packet(np.arange(384).reshape(12, 32) * 170, azimuth=35_900, time_us=1_000_000)
mutations = st.lists(st.tuples(st.integers(0, 1205), st.integers(0, 255)), max_size=8)


def mutated(changes, mode):
    data = bytearray(valid)
    data[1204] = mode
    for at, value in changes:
        data[at] = value
    return bytes(data)


anything = st.one_of(
    st.binary(max_size=1500),
    st.binary(min_size=1206, max_size=1206),
    st.builds(mutated, mutations, st.sampled_from([0x37, 0x38, 0x39])),
)


@given(st.lists(st.tuples(anything, st.integers(-(2**62), 2**62)), max_size=6), st.sampled_from(["free", "utc"]))
@settings(max_examples=300, deadline=None)
def test_no_bytes_make_decode_raise_or_return_non_finite_values(packets, clock):
    lidar = Lidar(clock=clock, slice_ms=ONE_PACKET_MS)
    for data, stamp_ns in packets:
        try:
            firings = lidar.decode(record(data, stamp_ns))
        except LinkError:
            continue
        if firings is not None:
            check_arrays(firings)
            assert np.isfinite(firings.xyz_lidar_m).all()
            assert np.isfinite(firings.azimuth_rad).all()
            assert ((firings.azimuth_rad >= 0) & (firings.azimuth_rad < np.float32(2 * np.pi))).all()
            assert firings.lost_packets >= 0


def test_the_same_stream_gives_the_same_messages_twice():
    shuffled = exact_records(200)
    random.Random(5).shuffle(shuffled)

    def stamps():
        lidar = Lidar(slice_ms=ONE_PACKET_MS)
        return [firings and (firings.stamp_ns, firings.lost_packets) for firings in map(lidar.decode, shuffled)]

    assert stamps() == stamps()
