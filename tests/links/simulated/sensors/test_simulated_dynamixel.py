"""The emulated MX-28AR: packets as in the SDK, rules as in the e-manual, motion of the simulated servo."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from links.dynamixel import mx28
from links.dynamixel.bus import Bus, NoReply
from links.simulated.sensors import protocol2
from links.simulated.sensors.dynamixel_emulator import DynamixelEmulator
from links.simulated.sensors.mx28 import BOOT_NS, SimulatedMx28
from links.simulated.sensors.protocol2 import Instruction, crc16, packet, status, take
from links.simulated.sensors.servo import ServoSettings

MS = 1_000_000


@given(st.binary(max_size=60))
def test_the_checksum_is_the_sdks(data):
    assert crc16(data) == Protocol2PacketHandler().updateCRC(0, data, len(data))


def test_the_checksum_of_the_manuals_own_example():
    assert packet(1, protocol2.READ, bytes([132, 0, 4, 0])).hex(" ") == "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"


@given(st.lists(st.tuples(st.integers(0, 252), st.binary(max_size=40)), max_size=5), st.binary(max_size=8), st.data())
def test_packets_are_read_from_a_stream_however_it_is_cut(sent, noise, data):
    whole = noise.replace(b"\xff", b"") + b"".join(packet(i, protocol2.WRITE, p) for i, p in sent)
    stream, found = bytearray(), []
    for piece in whole[: (cut := data.draw(st.integers(0, len(whole))))], whole[cut:]:
        stream += piece
        while (instruction := take(stream)) is not None:
            found.append(instruction)
    assert found == [Instruction(i, protocol2.WRITE, p) for i, p in sent]


def test_a_damaged_packet_is_skipped_and_the_next_one_read():
    good = packet(1, protocol2.PING, b"")
    damaged = bytearray(packet(1, protocol2.WRITE, bytes(8)))
    damaged[10] ^= 1
    assert take(bytearray(bytes(damaged) + good)) == Instruction(1, protocol2.PING, b"")
    assert take(bytearray(b"\xff\xff\xfd\x00\x01\xff\xff" + good)) == Instruction(1, protocol2.PING, b"")


class Host:
    """Sends instructions to a servo without a bus, on its own clock."""

    def __init__(self, **settings):
        self.now_ns = 0
        self.servo = SimulatedMx28(ServoSettings(**{"travel_deg": (0, 360), "start_deg": 90} | settings), 1, 0)

    def ask(self, code, parameters=b"", servo_id=1):
        self.now_ns += MS
        return self.servo.reply(Instruction(servo_id, code, parameters), self.now_ns)

    def write(self, register, value):
        """The error number of the reply."""
        return self.ask(protocol2.WRITE, register.address.to_bytes(2, "little") + register.bytes(value))[8]

    def read(self, register):
        answer = self.ask(protocol2.READ, bytes([register.address, 0, register.size, 0]))
        return register.value(answer[9:-2], register.address)

    def wait(self, seconds, talking=False):
        end_ns = self.now_ns + round(1e9 * seconds)
        while talking and self.now_ns < end_ns:
            self.ask(protocol2.PING)
        self.now_ns = end_ns

    def drive(self, ticks, units=100):
        self.write(mx28.TORQUE_ENABLE, 1)
        self.write(mx28.PROFILE_VELOCITY, units)
        self.write(mx28.GOAL_POSITION, ticks)


def test_it_moves_to_its_goal_at_its_profile_speed():
    host = Host()
    host.drive(2048, 100)  # 22.9 rpm: 90 deg in 0.655 s
    host.wait(0.3)
    assert host.read(mx28.PRESENT_VELOCITY) == 100
    lag_deg = 137.4**2 / (2 * 6000)  # while it accelerates
    assert host.read(mx28.PRESENT_POSITION) == pytest.approx(1024 + (0.302 * 137.4 - lag_deg) / 360 * 4096, abs=4)
    assert host.read(mx28.MOVING) == 1
    host.wait(0.5)
    assert host.read(mx28.PRESENT_POSITION) == 2048
    assert host.read(mx28.MOVING) == 0


def test_without_torque_it_does_not_move_and_with_it_a_goal_from_before_counts():
    host = Host()
    host.write(mx28.GOAL_POSITION, 1100)
    host.wait(0.5)
    assert host.read(mx28.PRESENT_POSITION) == 1024
    host.write(mx28.TORQUE_ENABLE, 1)
    host.wait(0.5)
    assert host.read(mx28.PRESENT_POSITION) == 1100


@pytest.mark.parametrize(
    ("register", "value", "error"),
    [
        (mx28.GOAL_POSITION, 4096, mx28.DATA_LIMIT),
        (mx28.GOAL_POSITION, -1, mx28.DATA_LIMIT),
        (mx28.PRESENT_POSITION, 0, mx28.ACCESS_ERROR),
        (mx28.RETURN_DELAY_TIME, 0, mx28.ACCESS_ERROR),
        (mx28.PROFILE_VELOCITY, 30, 0),
    ],
)
def test_a_forbidden_write_is_rejected_and_changes_nothing(register, value, error):
    host = Host()
    host.servo.set(mx28.RETURN_DELAY_TIME, 250)
    host.write(mx28.TORQUE_ENABLE, 1)
    before = host.read(register)
    assert host.write(register, value) == error
    assert host.read(register) == (before if error else value)


def test_half_a_register_and_a_block_beyond_the_table_are_rejected():
    host = Host()
    assert host.ask(protocol2.WRITE, bytes([117, 0, 1]))[8] == mx28.DATA_LENGTH
    assert host.ask(protocol2.READ, bytes([0, 2, 255, 0]))[8] == mx28.DATA_LENGTH
    assert host.ask(0x42)[8] == mx28.INSTRUCTION_ERROR


def test_other_ids_and_low_status_levels_are_not_answered():
    host = Host()
    assert host.ask(protocol2.PING, servo_id=2) is None
    host.servo.set(mx28.STATUS_RETURN_LEVEL, 1)
    assert host.ask(protocol2.WRITE, bytes([64, 0, 1])) is None
    assert host.read(mx28.TORQUE_ENABLE) == 1
    host.servo.set(mx28.STATUS_RETURN_LEVEL, 0)
    assert host.ask(protocol2.READ, bytes([132, 0, 4, 0])) is None
    assert host.ask(protocol2.PING)[9:12] == bytes([30, 0, 45])


def test_its_watchdog_stops_it_without_instructions_and_locks_its_goal():
    host = Host()
    host.drive(3000, 100)
    host.write(mx28.BUS_WATCHDOG, 5)
    host.wait(0.2, talking=True)
    assert host.read(mx28.BUS_WATCHDOG) == 5
    moved = host.read(mx28.PRESENT_POSITION)
    host.wait(1.0)
    assert host.read(mx28.BUS_WATCHDOG) == mx28.WATCHDOG_TRIPPED
    assert moved < host.read(mx28.PRESENT_POSITION) < moved + 0.12 * 22.9 / 60 * 4096
    assert host.write(mx28.GOAL_POSITION, 2000) == mx28.DATA_RANGE
    assert host.write(mx28.BUS_WATCHDOG, 0) == 0
    assert host.write(mx28.GOAL_POSITION, 2000) == 0


def test_a_shutdown_lasts_until_a_reboot_which_resets_its_ram_and_takes_time():
    host = Host()
    host.drive(1100, 100)
    host.servo.shut_down(host.now_ns)
    assert host.ask(protocol2.PING)[8] == mx28.ALERT
    assert host.write(mx28.TORQUE_ENABLE, 1) == mx28.ALERT | mx28.ACCESS_ERROR
    assert host.ask(protocol2.REBOOT) is not None
    assert host.ask(protocol2.PING) is None
    host.wait(BOOT_NS * 1e-9)
    assert host.ask(protocol2.PING)[8] == 0
    assert [host.read(r) for r in (mx28.TORQUE_ENABLE, mx28.PROFILE_VELOCITY, mx28.BUS_WATCHDOG)] == [0, 0, 0]


def test_a_blocked_shaft_shows_load_and_shuts_down_only_while_it_tries_to_move():
    host = Host()
    host.servo.block(0, overload_s=0.5)
    host.wait(1.0)
    assert host.read(mx28.HARDWARE_ERROR_STATUS) == 0
    host.drive(2000)
    host.wait(0.01)
    assert host.read(mx28.HARDWARE_ERROR_STATUS) == mx28.OVERLOAD
    assert host.read(mx28.PRESENT_POSITION) == 1024
    assert host.read(mx28.TORQUE_ENABLE) == 0


def test_the_output_angle_has_encoder_error_and_backlash():
    host = Host(encoder_error_deg=1.0, backlash_deg=0.5)
    host.drive(2048)
    host.wait(1.0)
    host.servo.advance(host.now_ns)
    at = np.array([host.now_ns - 500 * MS, host.now_ns])
    difference_deg = np.degrees(host.servo.position_rad(at) - host.servo.output_rad(at))
    assert (np.abs(difference_deg) > 0.01).any()
    assert (np.abs(difference_deg) < 1.3).all()


def test_its_position_is_available_for_any_time_of_the_last_seconds():
    with DynamixelEmulator(ServoSettings(travel_deg=(0, 360), start_deg=45)) as emulator:
        now = time.monotonic_ns()
        assert np.degrees(emulator.output_rad(np.array([now - 10 * MS, now]))) == pytest.approx([45, 45], abs=1e-6)


def fails(ask):
    for _ in range(1000):
        try:
            ask()
        except NoReply:
            return True
    return False


def test_in_its_own_process_it_reads_faults_from_standard_input(tmp_path):
    path = tmp_path / "servo"
    process = subprocess.Popen(
        [sys.executable, "-m", "links.simulated.sensors.dynamixel_emulator", str(path)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        deadline_s = time.monotonic() + 20
        while not path.exists():
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        bus = Bus.open(str(path), 1_000_000, 1, 0.5)
        assert bus.ping() == 30
        process.stdin.write("unknown\nlate one\nsilence 1\n")
        process.stdin.flush()
        errors = [process.stderr.readline(), process.stderr.readline()]
        assert fails(bus.ping)  # the line after the rejected ones is read now or soon
        bus.close()
        process.stdin.close()
        assert process.wait(10) == 0
    assert "no such fault: 'unknown'" in errors[0]
    assert errors[1].startswith("late: ")


def test_a_status_packet_is_stuffed_where_its_data_contains_a_header():
    whole = status(1, 0, b"\xff\xff\xfd\x01")
    assert whole[9:14] == b"\xff\xff\xfd\xfd\x01"
    assert take(bytearray(whole)).parameters == b"\x00\xff\xff\xfd\x01"
