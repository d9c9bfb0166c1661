"""The real SDK against the emulated servo: good exchanges and every failure."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import tty

import numpy as np
import pytest
from dynamixel_sdk import PortHandler, Protocol2PacketHandler
from hypothesis import given, settings
from hypothesis import strategies as st

from links.dynamixel import mx28
from links.dynamixel.bus import BadReply, BlockingPort, Bus, BusError, Gone, NoReply, RequestRejected, WrongReply
from links.dynamixel.drive import POSITION_BLOCK, Drive, DriveSettings
from links.simulated.sensors.dynamixel_emulator import DynamixelEmulator
from links.simulated.sensors.protocol2 import status
from links.simulated.sensors.servo import ServoSettings

BAUD = 1_000_000


@pytest.fixture
def emulator():
    with DynamixelEmulator(ServoSettings(travel_deg=(0.0, 360.0), start_deg=90.0)) as servo:
        yield servo


@pytest.fixture
def bus(emulator):
    line = Bus.open(str(emulator.path), BAUD, 1, 0.03)
    yield line
    line.close()


def position(reply):
    return mx28.PRESENT_POSITION.value(reply.data, POSITION_BLOCK)


def test_a_block_read_returns_position_velocity_and_load_together(emulator, bus):
    before_ns = time.monotonic_ns()
    reply = bus.read(126, 10)
    assert len(reply.data) == 10
    assert position(reply) == 1024
    assert mx28.PRESENT_VELOCITY.value(reply.data, POSITION_BLOCK) == 0
    assert before_ns <= reply.request_ns < reply.reply_ns <= time.monotonic_ns()
    assert not reply.alert


def test_ping_returns_the_model_and_a_write_is_read_back(emulator, bus):
    assert bus.ping() == 30
    bus.write(mx28.PROFILE_VELOCITY, 50, 2000)
    assert bus.read(112, 8).data == (50).to_bytes(4, "little") + (2000).to_bytes(4, "little")


def test_a_write_that_the_servo_rejects_raises_with_the_reason(emulator, bus):
    with pytest.raises(
        RequestRejected, match=r"write 4096 to Goal Position \(116\): the value is beyond the servo's limit"
    ):
        bus.write(mx28.GOAL_POSITION, 4096)
    bus.write(mx28.TORQUE_ENABLE, 1)
    with pytest.raises(RequestRejected, match=r"Return Delay Time \(9\).*torque on"):
        bus.write(mx28.RETURN_DELAY_TIME, 3)


def test_the_sdk_alone_mistakes_a_late_reply_for_the_next_one(emulator):
    """Why Bus wraps it: the SDK returns a position as the profile velocity, and 0 where there was no reply."""
    port, handler = PortHandler(str(emulator.path)), Protocol2PacketHandler()
    port.openPort()
    emulator.hold_back()
    assert handler.read4ByteTxRx(port, 1, mx28.PRESENT_POSITION.address)[0] == 0
    assert handler.read4ByteTxRx(port, 1, mx28.PROFILE_VELOCITY.address)[:2] == (1024, 0)
    assert emulator.get(mx28.PROFILE_VELOCITY) == 0
    port.closePort()


def test_a_late_reply_is_not_mistaken_for_the_next_one(emulator, bus):
    emulator.hold_back()
    with pytest.raises(NoReply):
        bus.read(126, 10)
    with pytest.raises(WrongReply, match="a reply of 10 bytes, not 11"):
        bus.read(126, 11)
    assert position(bus.read(126, 12)) == 1024


def test_a_late_reply_is_not_mistaken_for_a_ping_of_another_model(emulator, bus):
    emulator.hold_back()
    with pytest.raises(NoReply):
        bus.write(mx28.PROFILE_VELOCITY, 50)
    with pytest.raises(WrongReply):
        bus.ping()
    assert bus.ping() == 30


def test_bytes_before_a_reply_are_skipped(emulator, bus):
    emulator.garbage(b"\x00\xff\xff\xfd\xff\xff" * 5)
    assert position(bus.read(126, 10)) == 1024


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (lambda e: e.bad_crc(), BadReply),
        (lambda e: e.cut_off(9), BadReply),
        (lambda e: e.cut_off(20), BadReply),
        (lambda e: e.short_data(), WrongReply),
        (lambda e: e.replace(b""), NoReply),
        (lambda e: e.replace(b"\xff\xff\xfd\x00\x01\x00\x00" + bytes(20)), BadReply),
        (lambda e: e.replace(b"\xff\xff\xfd\x00\x01\xff\x03\x55" + bytes(60)), BadReply),
        (lambda e: e.replace(status(2, 0, bytes(10))), (NoReply, BadReply)),
        (lambda e: e.replace(b"\xff\xff\xfd" * 500), BadReply),
    ],
    ids=[
        "crc",
        "cut in the header",
        "cut in the data",
        "short",
        "none",
        "length 0",
        "length 1023",
        "other id",
        "babble",
    ],
)
def test_a_corrupted_reply_is_an_error_and_the_next_one_is_correct(emulator, bus, fault, error):
    fault(emulator)
    with pytest.raises(error):
        bus.read(126, 10)
    assert position(bus.read(126, 11)) == 1024


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_random_reply_hangs_crashes_or_is_accepted(data):
    with DynamixelEmulator() as emulator:
        bus = Bus.open(str(emulator.path), BAUD, 1, 0.005)
        pieces = st.sampled_from([b"\xff\xff\xfd\x00", b"\xff\xff\xfd\x00\x01", b"\x55", b"\x0e\x00", b"\xff"])
        emulator.replace(b"".join(data.draw(st.lists(pieces | st.binary(max_size=24), max_size=12))))
        with pytest.raises(BusError):
            bus.read(126, 10)
        bus.close()


def test_a_line_that_never_stops_sending_does_not_block_the_bus():
    host, servo = os.openpty()
    tty.setraw(servo)
    stop, started = threading.Event(), threading.Event()

    os.set_blocking(host, False)

    def babble():
        end_s = time.monotonic() + 10
        while not stop.is_set() and time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):  # the line is full
                os.write(host, b"\xff\xff\xfd\x00\x01\x55" * 20)
            started.set()

    thread = threading.Thread(target=babble)
    thread.start()
    bus = Bus.open(os.ttyname(servo), BAUD, 1, 0.03)
    started.wait(5)
    with pytest.raises(BusError):
        bus.read(126, 10)
    still_sending = thread.is_alive()
    stop.set()
    thread.join()
    bus.close()
    os.close(host)
    os.close(servo)
    assert still_sending


class Scripted(BlockingPort):
    """A port with scripted replies."""

    def __init__(self):
        super().__init__("", BAUD, 0.02)
        self.reply = bytearray()

    def readPort(self, length):
        data = bytes(self.reply[: max(length, 0)])
        del self.reply[: len(data)]
        if not data:
            self.packet_timeout = -1.0  # the deadline passes
        return data

    def writePort(self, packet):
        return len(packet)

    def clearPort(self):
        pass

    def drain(self, quiet_s, limit_s):
        dropped = len(self.reply)
        self.reply.clear()
        return dropped


def corrupted(random, whole):
    """An almost valid reply: a good one with bytes changed, cut, repeated or inserted."""
    data = bytearray(whole)
    for _ in range(int(random.integers(0, 4))):
        at = int(random.integers(0, len(data) + 1))
        match random.integers(0, 4):
            case 0:
                data[at : at + 1] = random.bytes(1)
            case 1:
                del data[at:]
            case 2:
                data[at:at] = random.bytes(int(random.integers(1, 6)))
            case _:
                data[at:at] = data[: int(random.integers(0, len(data) + 1))]
    return bytes(data)


def fuzz(count):
    """(accepted, accepted with wrong data) of `count` corrupted replies."""
    random, port, accepted, wrong = np.random.default_rng(7), Scripted(), 0, 0
    bus, data = Bus(port, 1), bytes(range(10))
    whole = status(1, 0, data)
    for _ in range(count):
        port.reply += corrupted(random, whole)
        try:
            reply = bus.read(126, 10)
        except BusError:
            port.reply.clear()
            continue
        accepted += 1
        wrong += reply.data != data
        assert len(reply.data) == 10
    return accepted, wrong


def test_corrupted_replies_are_rejected_or_correct():
    accepted, wrong = fuzz(3_000)
    assert 200 < accepted < 2_500
    assert wrong == 0


@pytest.mark.slow
def test_of_a_million_corrupted_replies_a_few_pass_the_16_bit_checksum():
    _, wrong = fuzz(1_000_000)
    assert wrong < 20  # about 500 000 are damaged within a reply of the right length; the worker's filter rejects jumps


def test_a_silent_servo_costs_one_timeout(emulator, bus):
    emulator.silence()
    with pytest.raises(NoReply, match=r"read 126..135: no reply"):
        bus.read(126, 10)
    emulator.silence(False)
    assert position(bus.read(126, 10)) == 1024


def test_an_unplugged_adapter_is_gone_and_a_new_bus_finds_it_again(emulator, bus):
    emulator.unplug()
    with pytest.raises(Gone):
        bus.read(126, 10)
    with pytest.raises(Gone, match="cannot open"):
        Bus.open(str(emulator.path), BAUD, 1, 0.03)
    emulator.plug_in()
    reopened = Bus.open(str(emulator.path), BAUD, 1, 0.03)
    assert position(reopened.read(126, 10)) == 1024
    reopened.close()


def test_at_another_baud_rate_the_servo_does_not_reply(emulator):
    line = Bus.open(str(emulator.path), 57_600, 1, 0.03)
    with pytest.raises(NoReply):
        line.ping()
    line.close()


def settings_of(emulator, **changed):
    return DriveSettings(
        **{
            "port": str(emulator.path),
            "servo_id": 1,
            "baud": BAUD,
            "limit_ticks": (0, 2048),
            "max_velocity_units": 240,
            "watchdog_ms": 100,
            "reply_timeout_ms": 30,
            "goal_slack_ms": 500,
            "rate_hz": 250,
            "start_s": 3,
            "write_settings": False,
            "reboot": True,
        }
        | changed
    )


def test_set_up_holds_the_servo_at_its_position_whatever_its_goal_was(emulator, bus):
    emulator.set(mx28.GOAL_POSITION, 3000)
    Drive(bus, settings_of(emulator)).set_up()
    assert emulator.get(mx28.TORQUE_ENABLE) == 1
    assert emulator.get(mx28.GOAL_POSITION) == 1024
    assert emulator.get(mx28.BUS_WATCHDOG) == 5
    assert emulator.get(mx28.PROFILE_VELOCITY) == 1  # 0 would be no limit
    assert emulator.position_rad(np.array([time.monotonic_ns()]))[0] == pytest.approx(math.pi / 2, abs=mx28.TICK_RAD)


def test_a_servo_that_replies_to_pings_only_is_set_to_reply_to_everything(emulator, bus):
    emulator.set(mx28.STATUS_RETURN_LEVEL, 0)
    Drive(bus, settings_of(emulator)).set_up()
    assert emulator.get(mx28.STATUS_RETURN_LEVEL) == 2
