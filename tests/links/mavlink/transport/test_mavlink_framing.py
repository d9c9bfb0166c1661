"""Frames from datagrams and byte streams with arbitrary other bytes."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.transport.framing import FrameSplitter, packed

mavlink: Any = ardupilotmega


def frames(count: int = 5, v1: bool = False) -> list[bytes]:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    out: list[bytes] = []
    for i in range(count):
        message = mavlink.MAVLink_attitude_message(1000 + i, 0.1 * i, 0.2, 0.3, 1.0, 2.0, 3.0)
        if v1:
            mav.seq = i
            out.append(bytes(message.pack(mav, force_mavlink1=True)))
        else:
            out.append(packed(message, mav))
    return out


def split(splitter: FrameSplitter, data: bytes, chunk: int) -> list[bytes]:
    found: list[bytes] = []
    for at in range(0, len(data), chunk):
        found += [frame for frame, _ in splitter.stream(data[at : at + chunk])]
    return found


@pytest.mark.parametrize("v1", [False, True])
@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_a_stream_gives_its_frames_for_any_chunk_size(v1: bool, chunk: int):
    sent, splitter = frames(v1=v1), FrameSplitter()
    assert split(splitter, b"".join(sent), chunk) == sent
    assert splitter.stray_bytes == 0


def test_noise_between_frames_is_counted_and_loses_none():
    sent, splitter = frames(), FrameSplitter()
    noise = b"\x00\x11login: \r\n"
    assert split(splitter, noise + noise.join(sent) + noise, 13) == sent
    assert splitter.stray_bytes == 6 * len(noise)


def test_noise_that_looks_like_a_header_does_not_lose_the_next_frames():
    sent, splitter = frames(20), FrameSplitter()
    data = b"".join([sent[0], b"\xfd\xff\x00\x00", *sent[1:]])
    assert split(splitter, data, 50) == sent
    assert splitter.stray_bytes == 4


def test_a_damaged_frame_loses_only_itself():
    sent = frames(20)
    damaged = bytearray(sent[3])
    damaged[12] ^= 0x40
    splitter = FrameSplitter()
    assert split(splitter, b"".join([*sent[:3], bytes(damaged), *sent[4:]]), 64) == sent[:3] + sent[4:]
    assert splitter.stray_bytes == len(damaged)


def test_each_datagram_is_split_on_its_own():
    one, two, splitter = *frames(2), FrameSplitter()
    assert splitter.datagram(one[:20]) == []
    assert [frame for frame, _ in splitter.datagram(two + one)] == [two, one]
    assert splitter.stray_bytes == 20


def test_a_message_outside_the_dialect_is_a_frame_if_another_follows_or_the_data_ends():
    one, two, splitter = *frames(2), FrameSplitter()
    private = bytearray(one)
    private[7:10] = b"\xf0\xff\x00"
    assert [frame for frame, _ in splitter.datagram(bytes(private) + two)] == [bytes(private), two]
    splitter = FrameSplitter()
    assert [frame for frame, _ in splitter.datagram(bytes(private) + b"\x00" + two)] == [two]


@given(st.lists(st.one_of(st.binary(max_size=60), st.sampled_from(frames(4)), st.sampled_from(frames(4, v1=True)))))
@settings(max_examples=150, deadline=None)
def test_no_bytes_raise_and_every_byte_is_in_a_frame_or_counted(parts: list[bytes]):
    data, splitter = b"".join(parts), FrameSplitter()
    found = splitter.datagram(data)
    assert sum(len(frame) for frame, _ in found) + splitter.stray_bytes == len(data)
    stream = FrameSplitter()
    split(stream, data, 17)
    assert stream.stray_bytes <= len(data)


@given(st.binary(max_size=3000))
@settings(max_examples=50, deadline=None)
def test_at_most_one_frame_of_a_stream_is_kept(data: bytes):
    splitter = FrameSplitter()
    found = split(splitter, data, 100)
    assert len(data) - sum(map(len, found)) - splitter.stray_bytes <= 280
