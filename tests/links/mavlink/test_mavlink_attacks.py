"""What somebody who can send to the link, or write its files, can do: nothing raises, takes long, or reveals the key."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink import Autopilot
from links.mavlink.autopilot_session import AutopilotSession
from links.mavlink.poses.sent_state import SentState
from links.mavlink.transport import framing
from links.mavlink.transport.framing import FrameSplitter, packed
from links.simulated.rig.pose_loop import PEER, VirtualConnection
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose

mavlink: Any = ardupilotmega
SECRET = bytes(range(200, 232))
HANDLED = (0, 22, 24, 27, 30, 32, 49, 77, 105, 111, 193, 230, 253, 331)  # message ids that the session or decoder reads


@pytest.mark.parametrize("garbage", [b"\xfe", b"\xfd\xff\x00\x00\x01\x01\x01\x1e\x00\x00", b"\xfe\xf8\x01\x01\x01\x1e"])
@pytest.mark.parametrize("whole", [True, False])
def test_garbage_that_looks_like_frames_costs_a_bounded_number_of_checksums(
    garbage: bytes, whole: bool, monkeypatch: pytest.MonkeyPatch
):
    checked: list[int] = []
    parse = framing.parse_frame
    monkeypatch.setattr(framing, "parse_frame", lambda data: checked.append(1) or parse(data))
    splitter, mav = FrameSplitter(), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    data = (garbage * 2048)[:2048]
    split = splitter.datagram if whole else splitter.stream
    assert split(data) == []
    assert len(checked) <= framing.MAX_DAMAGED + 1
    good = packed(mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0), mav)
    assert [frame for frame, _ in split(good)] == [good]
    assert splitter.stray_bytes == len(data)


def session_of(link: Autopilot, now_ns: list[int]) -> AutopilotSession:
    return link.open_session(VirtualConnection(), lambda: now_ns[0], threaded=False)


def test_messages_with_any_content_and_a_correct_checksum_never_raise(tmp_path: Path):
    rng, now_ns = random.Random(7), [HOST0]
    origin = {"latitude_deg": 1, "longitude_deg": 2, "altitude_m": 3}
    link = Autopilot(switch_source=True, global_origin=origin, state_file=tmp_path / "sent.json")
    session = session_of(link, now_ns)
    for i in range(4000):
        now_ns[0] += 10 * MS
        kind = HANDLED[i % len(HANDLED)]
        crc_extra, size = mavlink.mavlink_map[kind].crc_extra, mavlink.mavlink_map[kind].unpacker.size
        payload = rng.choice([rng.randbytes(size), b"\xff" * size, b"\x00\x00\x80\x7f" * (size // 4 + 1)])[:size]
        body = bytes([len(payload), 0, 0, i % 256, 1, 1, kind & 255, kind >> 8, 0]) + payload
        checksum = mavlink.x25crc(body + bytes([crc_extra])).crc
        for record in session.receive(b"\xfd" + body + checksum.to_bytes(2, "little"), PEER, now_ns[0]):
            link.decode(record)
        link.on_pose(good_pose(now_ns[0]))
        session.tick()
        assert session.status is None or isinstance(session.status, str)
    assert session.counts["received"] == 4000
    session.close()


def test_a_key_in_the_settings_is_rejected_because_recordings_contain_settings():
    for key in (SECRET.hex(), f" 0x{SECRET.hex().upper()}"):
        with pytest.raises(ValidationError, match="must be the path of a key file, not the key"):
            Autopilot(signing_key=key)


def test_the_key_is_in_no_record_counter_status_or_text_of_the_link(tmp_path: Path):
    key_file, now_ns = tmp_path / "key", [HOST0]
    key_file.write_bytes(SECRET)
    key_file.chmod(0o600)
    link = Autopilot(signing_key=key_file, state_file=tmp_path / "sent.json")
    from links.mavlink.transport.signing import Signer

    link._signer = Signer(key_file, HOST0)
    session = session_of(link, now_ns)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    received = [
        record
        for frame in (packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mav) for _ in range(5))
        for record in session.receive(frame, PEER, HOST0)
    ]
    session.tick()
    seen = [record.data for record in (*received, *session.sent())]
    seen += [f"{link.counters} {session.status} {link.settings!r} {link._signer!r}".encode()]
    seen += [path.read_bytes() for path in tmp_path.iterdir() if path != key_file]
    assert session.counts["not signed with our key"] == 5
    assert not any(SECRET[:8] in data or SECRET[:8].hex().encode() in data for data in seen)
    session.close()


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "7",
        '{"sent_ns": Infinity, "frame": ""}',
        '{"sent_ns": 1, "frame": "zz"}',
        '{"sent_ns": 1, "frame": "", "odom": 3}',
    ],
)
def test_a_state_file_with_any_content_is_reported(content: str, tmp_path: Path):
    file = tmp_path / "sent.json"
    file.write_text(content, encoding="ascii")
    state = SentState(file, 5 * MS)
    assert "delete it" in str(state.status)
    earlier = state.take_earlier()
    assert earlier is not None
    assert earlier[0] == 5 * MS


def test_a_time_before_1970_in_the_state_file_becomes_a_valid_one(tmp_path: Path):
    file = tmp_path / "sent.json"
    file.write_text(json.dumps({"sent_ns": -5, "frame": ""}), encoding="ascii")
    assert SentState(file, 5).take_earlier() == (0, b"", None)
    assert os.listdir(tmp_path) == ["sent.json"]
