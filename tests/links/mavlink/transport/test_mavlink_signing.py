"""Signing: pymavlink accepts our signatures, forgeries and replays are rejected, time stamps always increase."""

from __future__ import annotations

import errno
import itertools
import logging
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import LinkError
from links.mavlink.transport.framing import packed
from links.mavlink.transport.signing import AHEAD_TICKS, RETRY_S, Signer, ticks_of
from tests.links.mavlink.mavlink_poses import HOST0, MS

mavlink: Any = ardupilotmega
SECRET = bytes(range(32))
HEARTBEAT = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "mavlink.key"
    path.write_bytes(SECRET)
    path.chmod(0o600)
    return path


def signed(signer: Signer, now_ns: int = HOST0, system: int = 1, component: int = 1) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    signer.sign_for(mav, now_ns)
    return packed(HEARTBEAT, mav)


def signed_for_minutes(signer: Signer) -> list[int]:
    """Time stamps of one frame per second for 200 s, written as a session does."""
    times = list[int]()
    for second in range(200):
        times.append(ticks(signed(signer, HOST0 + second * 1000 * MS)))
        signer.write_timestamp()
    return times


def ticks(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def other_key(tmp_path: Path) -> Path:
    path = tmp_path / "other.key"
    path.write_text("ab" * 32 + "\n")
    path.chmod(0o600)
    return path


def test_pymavlink_accepts_our_signature_only_with_the_key(key_file: Path):
    frame = signed(Signer(key_file, HOST0))
    for secret, accepted in ((SECRET, True), (b"x" * 32, False)):
        receiver = mavlink.MAVLink(None)
        receiver.signing.secret_key = secret
        receiver.signing.timestamp = ticks_of(HOST0)
        if accepted:
            assert receiver.decode(bytearray(frame)).get_signed()
        else:
            with pytest.raises(mavlink.MAVError):
                receiver.decode(bytearray(frame))


def test_a_frame_signed_by_pymavlink_is_accepted_once(key_file: Path):
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    sender.signing.secret_key, sender.signing.sign_outgoing = SECRET, True
    sender.signing.timestamp = ticks_of(HOST0)
    first, second = packed(HEARTBEAT, sender), packed(HEARTBEAT, sender)
    signer = Signer(key_file, HOST0)
    assert signer.verify(first)
    assert not signer.verify(first)  # replayed
    assert signer.verify(second)
    assert not signer.verify(first)  # older


def test_unsigned_changed_and_foreign_frames_are_rejected(key_file: Path, tmp_path: Path):
    own, foreign = Signer(key_file, HOST0), Signer(other_key(tmp_path), HOST0)
    assert not own.verify(signed(foreign))
    assert not own.verify(packed(HEARTBEAT, mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
    frame = signed(Signer(key_file, HOST0))
    for at in range(len(frame)):
        changed = bytearray(frame)
        changed[at] ^= 1
        assert not own.verify(bytes(changed))
    assert own.verify(frame)


def test_a_forged_frame_with_a_future_time_does_not_block_the_true_sender(key_file: Path, tmp_path: Path):
    own, forger = Signer(key_file, HOST0), Signer(other_key(tmp_path), HOST0)
    assert not own.verify(signed(forger, HOST0 + 10**9 * MS))
    assert own.verify(signed(Signer(key_file, HOST0)))


def test_a_new_sender_may_be_a_minute_behind_and_no_more(key_file: Path):
    own = Signer(key_file, HOST0)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    sender.signing.secret_key, sender.signing.sign_outgoing = SECRET, True
    sender.signing.timestamp = ticks_of(HOST0) - AHEAD_TICKS
    assert not own.verify(packed(HEARTBEAT, sender))
    assert own.verify(packed(HEARTBEAT, sender))


def test_times_follow_the_clock_and_increase_although_it_stops_or_steps_back(key_file: Path):
    signer = Signer(key_file, HOST0)
    times = [ticks(signed(signer, at)) for at in (HOST0, HOST0, HOST0 - 10**6 * MS, HOST0 + 5000 * MS)]
    assert all(b > a for a, b in itertools.pairwise(times))
    assert times[-1] == ticks_of(HOST0 + 5000 * MS)


@pytest.mark.parametrize("closed", [True, False])
def test_after_a_restart_with_a_wrong_clock_no_time_is_used_again(key_file: Path, closed: bool):
    signer = Signer(key_file, HOST0)
    last = max(signed_for_minutes(signer))
    if closed:  # otherwise it was killed
        signer.close()
    restarted = Signer(key_file, HOST0 - 10**9 * MS)
    first = ticks(signed(restarted, HOST0 - 10**9 * MS))
    assert last < first
    assert first <= last + (2 if closed else AHEAD_TICKS + 1)


def full_disk(descriptor: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_reported_and_counted_and_times_still_increase(key_file: Path, monkeypatch: pytest.MonkeyPatch):
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.transport.signing.time.monotonic", lambda: now_s)
    signer = Signer(key_file, HOST0)
    with monkeypatch.context() as full:
        full.setattr("links.mavlink.transport.signing.os.fsync", full_disk)
        times = signed_for_minutes(signer)
        assert signer.unwritten == 1  # not tried each time
        assert "cannot be written: No space left on device" in (signer.status or "")
        signer.close()
        times += [ticks(signed(signer, HOST0)) for _ in range(3)]  # the link is reopened, with the clock set back
        assert all(b > a for a, b in itertools.pairwise(times))
    now_s += RETRY_S
    signer.write_timestamp()
    assert signer.status is None
    assert ticks(signed(Signer(key_file, HOST0))) > times[-1]


def test_a_slow_and_failing_disk_does_not_block_signing(key_file: Path, monkeypatch: pytest.MonkeyPatch):
    signer = Signer(key_file, HOST0)
    writing, release = threading.Event(), threading.Event()

    def slow(descriptor: int) -> None:
        writing.set()
        if not release.wait(20):
            pytest.fail("signing waited for the disk")
        full_disk(descriptor)

    monkeypatch.setattr("links.mavlink.transport.signing.os.fsync", slow)
    late_ns = HOST0 + 61_000 * MS  # all reserved times are used
    times = [ticks(signed(signer, late_ns))]  # signing does not write
    assert not writing.is_set()
    with ThreadPoolExecutor(1) as pool:
        write = pool.submit(signer.write_timestamp)
        assert writing.wait(20)
        times += [ticks(signed(signer, late_ns)) for _ in range(100)]
        assert not write.done()
        release.set()
        write.result(20)
    times += [ticks(signed(signer, late_ns + 60_000 * MS)) for _ in range(100)]  # long after RETRY_S: still no write
    assert signer.unwritten == 1
    assert all(b > a for a, b in itertools.pairwise(times))


def test_a_closed_and_reused_signer_reserves_new_times(key_file: Path):
    signer = Signer(key_file, HOST0)
    signer.close()
    signer.write_timestamp()  # a session opens
    last = max(ticks(signed(signer, HOST0)) for _ in range(5))  # then it is killed
    assert ticks(signed(Signer(key_file, HOST0))) > last


def test_the_key_may_be_hexadecimal_and_its_files_are_private(key_file: Path, tmp_path: Path):
    hexadecimal = tmp_path / "hex.key"
    hexadecimal.write_text(SECRET.hex() + "\n")
    hexadecimal.chmod(0o600)
    assert Signer(key_file, HOST0).verify(signed(Signer(hexadecimal, HOST0)))
    assert os.stat(tmp_path / "hex.key.timestamp").st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("content", "mode", "expected_text"),
    [
        (SECRET, 0o640, "chmod 600"),
        (SECRET, 0o604, "chmod 600"),
        (SECRET[:-1], 0o600, "32 bytes"),
        (b"zz" * 32, 0o600, "64 hexadecimal"),
        (b"", 0o600, "32 bytes"),
        (b"\xff" * 64, 0o600, "64 hexadecimal"),
        (None, 0o600, "signing_key"),
    ],
)
def test_a_bad_key_file_is_an_error_without_its_content(
    tmp_path: Path, content: bytes | None, mode: int, expected_text: str, caplog: pytest.LogCaptureFixture
):
    path = tmp_path / "bad.key"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    with caplog.at_level(logging.DEBUG), pytest.raises(LinkError, match=expected_text) as error:
        Signer(path, HOST0)
    if content:
        assert content.hex() not in str(error.value) + caplog.text
        assert repr(content) not in str(error.value) + caplog.text
        assert error.value.__cause__ is None


def test_an_invalid_timestamp_file_is_an_error_with_advice(key_file: Path):
    key_file.with_name("mavlink.key.timestamp").write_text("yesterday")
    with pytest.raises(LinkError, match="delete it only when the host's clock is correct"):
        Signer(key_file, HOST0)
