"""Signatures: pymavlink's peers accept ours, forgeries and repeats are refused, times grow over restarts and crashes."""

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
from mavlink_poses import HOST0, MS
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import LinkError
from links.mavlink.signing import AHEAD_TICKS, RETRY_S, Signer, ticks_of
from links.mavlink.wire import packed

mavlink: Any = ardupilotmega
SECRET = bytes(range(32))
BEAT = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "mavlink.key"
    path.write_bytes(SECRET)
    path.chmod(0o600)
    return path


def signed(signer: Signer, now_ns: int = HOST0, system: int = 1, component: int = 1) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    signer.sign_for(mav, now_ns)
    return packed(BEAT, mav)


def signed_for_minutes(signer: Signer) -> list[int]:
    """Times of a frame a second for 200 s, kept as a session does."""
    times = list[int]()
    for second in range(200):
        times.append(ticks(signed(signer, HOST0 + second * 1000 * MS)))
        signer.keep()
    return times


def ticks(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def other_key(tmp_path: Path) -> Path:
    path = tmp_path / "other.key"
    path.write_text("ab" * 32 + "\n")
    path.chmod(0o600)
    return path


def test_pymavlink_takes_what_we_sign_and_not_without_the_key(key_file: Path):
    frame = signed(Signer(key_file, HOST0))
    for secret, taken in ((SECRET, True), (b"x" * 32, False)):
        receiver = mavlink.MAVLink(None)
        receiver.signing.secret_key = secret
        receiver.signing.timestamp = ticks_of(HOST0)
        if taken:
            assert receiver.decode(bytearray(frame)).get_signed()
        else:
            with pytest.raises(mavlink.MAVError):
                receiver.decode(bytearray(frame))


def test_we_take_what_pymavlink_signs_once(key_file: Path):
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    sender.signing.secret_key, sender.signing.sign_outgoing = SECRET, True
    sender.signing.timestamp = ticks_of(HOST0)
    first, second = packed(BEAT, sender), packed(BEAT, sender)
    signer = Signer(key_file, HOST0)
    assert signer.verify(first)
    assert not signer.verify(first)  # heard before
    assert signer.verify(second)
    assert not signer.verify(first)  # older


def test_what_is_unsigned_changed_or_of_another_key_is_refused(key_file: Path, tmp_path: Path):
    ours, theirs = Signer(key_file, HOST0), Signer(other_key(tmp_path), HOST0)
    assert not ours.verify(signed(theirs))
    assert not ours.verify(packed(BEAT, mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
    frame = signed(Signer(key_file, HOST0))
    for at in range(len(frame)):
        changed = bytearray(frame)
        changed[at] ^= 1
        assert not ours.verify(bytes(changed))
    assert ours.verify(frame)


def test_a_forged_frame_with_a_far_time_does_not_silence_the_true_sender(key_file: Path, tmp_path: Path):
    ours, forger = Signer(key_file, HOST0), Signer(other_key(tmp_path), HOST0)
    assert not ours.verify(signed(forger, HOST0 + 10**9 * MS))
    assert ours.verify(signed(Signer(key_file, HOST0)))


def test_a_new_sender_may_be_a_minute_behind_and_no_more(key_file: Path):
    ours = Signer(key_file, HOST0)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    sender.signing.secret_key, sender.signing.sign_outgoing = SECRET, True
    sender.signing.timestamp = ticks_of(HOST0) - AHEAD_TICKS
    assert not ours.verify(packed(BEAT, sender))
    assert ours.verify(packed(BEAT, sender))


def test_times_follow_the_clock_and_grow_though_it_stands_or_goes_back(key_file: Path):
    signer = Signer(key_file, HOST0)
    times = [ticks(signed(signer, at)) for at in (HOST0, HOST0, HOST0 - 10**6 * MS, HOST0 + 5000 * MS)]
    assert all(b > a for a, b in itertools.pairwise(times))
    assert times[-1] == ticks_of(HOST0 + 5000 * MS)


@pytest.mark.parametrize("closed", [True, False])
def test_after_a_restart_with_a_wrong_clock_no_time_is_used_again(key_file: Path, closed: bool):
    signer = Signer(key_file, HOST0)
    last = max(signed_for_minutes(signer))
    if closed:  # else it was killed
        signer.close()
    again = Signer(key_file, HOST0 - 10**9 * MS)
    first = ticks(signed(again, HOST0 - 10**9 * MS))
    assert last < first
    assert first <= last + (2 if closed else AHEAD_TICKS + 1)


def full_disk(descriptor: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_disk_that_takes_no_more_is_said_and_counted_and_times_go_on_growing(
    key_file: Path, monkeypatch: pytest.MonkeyPatch
):
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.signing.time.monotonic", lambda: now_s)
    signer = Signer(key_file, HOST0)
    with monkeypatch.context() as full:
        full.setattr("links.mavlink.signing.os.fsync", full_disk)
        times = signed_for_minutes(signer)
        assert signer.unwritten == 1  # it is not tried each time
        assert "cannot be written: No space left on device" in (signer.status or "")
        signer.close()
        times += [ticks(signed(signer, HOST0)) for _ in range(3)]  # the link again, and the clock set back
        assert all(b > a for a, b in itertools.pairwise(times))
    now_s += RETRY_S
    signer.keep()
    assert signer.status is None
    assert ticks(signed(Signer(key_file, HOST0))) > times[-1]


def test_a_disk_that_takes_its_time_and_then_fails_holds_up_none_that_signs(
    key_file: Path, monkeypatch: pytest.MonkeyPatch
):
    signer = Signer(key_file, HOST0)
    writing, release = threading.Event(), threading.Event()

    def slow(descriptor: int) -> None:
        writing.set()
        if not release.wait(20):
            pytest.fail("it waited for the disk")
        full_disk(descriptor)

    monkeypatch.setattr("links.mavlink.signing.os.fsync", slow)
    late_ns = HOST0 + 61_000 * MS  # all that was written ahead is used up
    times = [ticks(signed(signer, late_ns))]  # nobody writes: the disk is not asked
    assert not writing.is_set()
    with ThreadPoolExecutor(1) as pool:
        keeping = pool.submit(signer.keep)
        assert writing.wait(20)
        times += [ticks(signed(signer, late_ns)) for _ in range(100)]
        assert not keeping.done()
        release.set()
        keeping.result(20)
    times += [ticks(signed(signer, late_ns + 60_000 * MS)) for _ in range(100)]  # long after RETRY_S: still not asked
    assert signer.unwritten == 1
    assert all(b > a for a, b in itertools.pairwise(times))


def test_a_signer_that_was_closed_and_goes_on_reserves_its_times_anew(key_file: Path):
    signer = Signer(key_file, HOST0)
    signer.close()
    signer.keep()  # a session opens
    last = max(ticks(signed(signer, HOST0)) for _ in range(5))  # then it is killed
    assert ticks(signed(Signer(key_file, HOST0))) > last


def test_the_key_may_be_written_in_hexadecimal_and_its_files_are_ours_alone(key_file: Path, tmp_path: Path):
    hexadecimal = tmp_path / "hex.key"
    hexadecimal.write_text(SECRET.hex() + "\n")
    hexadecimal.chmod(0o600)
    assert Signer(key_file, HOST0).verify(signed(Signer(hexadecimal, HOST0)))
    assert os.stat(tmp_path / "hex.key.timestamp").st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("content", "mode", "says"),
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
def test_a_bad_key_file_says_what_to_do_and_never_what_it_holds(
    tmp_path: Path, content: bytes | None, mode: int, says: str, caplog: pytest.LogCaptureFixture
):
    path = tmp_path / "bad.key"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    with caplog.at_level(logging.DEBUG), pytest.raises(LinkError, match=says) as error:
        Signer(path, HOST0)
    if content:
        assert content.hex() not in str(error.value) + caplog.text
        assert repr(content) not in str(error.value) + caplog.text
        assert error.value.__cause__ is None


def test_a_spoiled_timestamp_file_stops_it_with_advice(key_file: Path):
    key_file.with_name("mavlink.key.timestamp").write_text("yesterday")
    with pytest.raises(LinkError, match="delete it only when the host's clock is right"):
        Signer(key_file, HOST0)
