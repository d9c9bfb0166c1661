"""The real SDK against the emulated servo: good exchanges, and every way in which one can go wrong."""

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
from links.dynamixel.bus import BadReply, BlockingPort, Bus, BusError, Gone, NoReply, Refused, WrongReply
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


def test_a_block_read_brings_position_velocity_and_load_at_once(emulator, bus):
    before_ns = time.monotonic_ns()
    reply = bus.read(126, 10)
    assert len(reply.data) == 10
    assert position(reply) == 1024
    assert mx28.PRESENT_VELOCITY.value(reply.data, POSITION_BLOCK) == 0
    assert before_ns <= reply.request_ns < reply.reply_ns <= time.monotonic_ns()
    assert not reply.alert


def test_ping_tells_the_model_and_a_write_is_read_back(emulator, bus):
    assert bus.ping() == 30
    bus.write(mx28.PROFILE_VELOCITY, 50, 2000)
    assert bus.read(112, 8).data == (50).to_bytes(4, "little") + (2000).to_bytes(4, "little")


def test_a_write_that_the_servo_refuses_says_why(emulator, bus):
    with pytest.raises(Refused, match=r"write 4096 to Goal Position \(116\): the value is beyond its own limit"):
        bus.write(mx28.GOAL_POSITION, 4096)
    bus.write(mx28.TORQUE_ENABLE, 1)
    with pytest.raises(Refused, match=r"Return Delay Time \(9\).*torque on"):
        bus.write(mx28.RETURN_DELAY_TIME, 3)


def test_the_sdk_alone_takes_a_late_reply_for_the_next_answer(emulator):
    """What the wrapping is for: the SDK reads a position as the profile velocity, and 0 where there was no answer."""
    port, handler = PortHandler(str(emulator.path)), Protocol2PacketHandler()
    port.openPort()
    emulator.hold_back()
    assert handler.read4ByteTxRx(port, 1, mx28.PRESENT_POSITION.address)[0] == 0
    assert handler.read4ByteTxRx(port, 1, mx28.PROFILE_VELOCITY.address)[:2] == (1024, 0)
    assert emulator.get(mx28.PROFILE_VELOCITY) == 0
    port.closePort()


def test_a_late_reply_is_not_taken_for_the_next_answer(emulator, bus):
    emulator.hold_back()
    with pytest.raises(NoReply):
        bus.read(126, 10)
    with pytest.raises(WrongReply, match="an answer of 10 bytes, not 11"):
        bus.read(126, 11)
    assert position(bus.read(126, 12)) == 1024


def test_a_late_reply_is_not_taken_for_a_ping_of_another_model(emulator, bus):
    emulator.hold_back()
    with pytest.raises(NoReply):
        bus.write(mx28.PROFILE_VELOCITY, 50)
    with pytest.raises(WrongReply):
        bus.ping()
    assert bus.ping() == 30


def test_bytes_before_an_answer_are_skipped(emulator, bus):
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
def test_a_spoilt_answer_is_an_error_and_the_next_one_is_right(emulator, bus, fault, error):
    fault(emulator)
    with pytest.raises(error):
        bus.read(126, 10)
    assert position(bus.read(126, 11)) == 1024


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_answer_whatsoever_hangs_crashes_or_is_believed(data):
    with DynamixelEmulator() as emulator:
        bus = Bus.open(str(emulator.path), BAUD, 1, 0.005)
        pieces = st.sampled_from([b"\xff\xff\xfd\x00", b"\xff\xff\xfd\x00\x01", b"\x55", b"\x0e\x00", b"\xff"])
        emulator.replace(b"".join(data.draw(st.lists(pieces | st.binary(max_size=24), max_size=12))))
        with pytest.raises(BusError):
            bus.read(126, 10)
        bus.close()


def test_a_line_that_never_stops_talking_does_not_hold_it_up():
    host, servo = os.openpty()
    tty.setraw(servo)
    enough, talked = threading.Event(), threading.Event()

    os.set_blocking(host, False)

    def babble():
        end_s = time.monotonic() + 10
        while not enough.is_set() and time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):  # the line is full
                os.write(host, b"\xff\xff\xfd\x00\x01\x55" * 20)
            talked.set()

    thread = threading.Thread(target=babble)
    thread.start()
    bus = Bus.open(os.ttyname(servo), BAUD, 1, 0.03)
    talked.wait(5)
    with pytest.raises(BusError):
        bus.read(126, 10)
    still_talking = thread.is_alive()
    enough.set()
    thread.join()
    bus.close()
    os.close(host)
    os.close(servo)
    assert still_talking


class Scripted(BlockingPort):
    """A port on which the answers are given."""

    def __init__(self):
        super().__init__("", BAUD, 0.02)
        self.answer = bytearray()

    def readPort(self, length):
        said = bytes(self.answer[: max(length, 0)])
        del self.answer[: len(said)]
        if not said:
            self.packet_timeout = -1.0  # the deadline passes
        return said

    def writePort(self, packet):
        return len(packet)

    def clearPort(self):
        pass

    def drain(self, quiet_s, limit_s):
        dropped = len(self.answer)
        self.answer.clear()
        return dropped


def made_answer(random, whole):
    """Answers that are nearly right: a good one with bytes changed, cut, repeated, or mixed with others."""
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
    """Of so many spoilt answers: how many were believed, and how many of those had false bytes in them."""
    random, port, believed, false = np.random.default_rng(7), Scripted(), 0, 0
    bus, data = Bus(port, 1), bytes(range(10))
    whole = status(1, 0, data)
    for _ in range(count):
        port.answer += made_answer(random, whole)
        try:
            reply = bus.read(126, 10)
        except BusError:
            port.answer.clear()
            continue
        believed += 1
        false += reply.data != data
        assert len(reply.data) == 10
    return believed, false


def test_spoilt_answers_are_refused_or_right():
    believed, false = fuzz(3_000)
    assert 200 < believed < 2_500
    assert false == 0


@pytest.mark.slow
def test_of_a_million_spoilt_answers_a_few_pass_a_checksum_of_16_bits():
    _, false = fuzz(1_000_000)
    assert false < 20  # some 500 000 are damaged within an answer of the right length; the worker doubts jumps


def test_a_servo_that_says_nothing_costs_its_timeout_and_no_more(emulator, bus):
    emulator.silence()
    with pytest.raises(NoReply, match=r"read 126..135: no reply"):
        bus.read(126, 10)
    emulator.silence(False)
    assert position(bus.read(126, 10)) == 1024


def test_an_unplugged_adapter_is_gone_and_a_new_line_finds_it_again(emulator, bus):
    emulator.unplug()
    with pytest.raises(Gone):
        bus.read(126, 10)
    with pytest.raises(Gone, match="cannot open"):
        Bus.open(str(emulator.path), BAUD, 1, 0.03)
    emulator.plug_in()
    again = Bus.open(str(emulator.path), BAUD, 1, 0.03)
    assert position(again.read(126, 10)) == 1024
    again.close()


def test_at_another_rate_the_servo_hears_nothing(emulator):
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
            "fastest_units": 240,
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


def test_setting_up_holds_the_servo_where_it_is_whatever_its_goal_was(emulator, bus):
    emulator.set(mx28.GOAL_POSITION, 3000)
    Drive(bus, settings_of(emulator)).set_up()
    assert emulator.get(mx28.TORQUE_ENABLE) == 1
    assert emulator.get(mx28.GOAL_POSITION) == 1024
    assert emulator.get(mx28.BUS_WATCHDOG) == 5
    assert emulator.get(mx28.PROFILE_VELOCITY) == 1  # 0 would be no limit
    assert emulator.position_rad(np.array([time.monotonic_ns()]))[0] == pytest.approx(math.pi / 2, abs=mx28.TICK_RAD)


def test_a_servo_that_answers_pings_alone_is_made_to_answer_everything(emulator, bus):
    emulator.set(mx28.STATUS_RETURN_LEVEL, 0)
    Drive(bus, settings_of(emulator)).set_up()
    assert emulator.get(mx28.STATUS_RETURN_LEVEL) == 2
