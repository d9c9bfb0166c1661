"""Fuzzing of every input format with more than a million mutated inputs from a fixed seed; prints a table.

    python -m pytest -m slow -s tests/links/test_fuzz.py

Each format declares the errors that it may raise; any other error is a failure, and so is an input that takes longer
than MAX_INPUT_S. For a format with a checksum half of the inputs get a correct one, so that the code after the check is
reached. `GRD_FUZZ_SHARE` (0.01) reduces the number of inputs.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import struct
import sys
import time
import zlib
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from dynamixel_sdk import Protocol2PacketHandler
from pymavlink.dialects.v20 import ardupilotmega

from flow.config.hosts_file import load_hosts
from flow.config_error import ConfigError
from flow.graph import load_graph
from flow.link import LinkError, Record
from flow.message import Message
from flow.remote.codec import MAX_BYTES, CodecError, decode, encode
from links.camera import Camera
from links.dynamixel.bus import BlockingPort, Bus, BusError
from links.dynamixel.servo import Servo
from links.lidar import Lidar
from links.lidar.position import PpsMonitor
from links.mavlink import Autopilot
from links.mavlink.transport.framing import FrameSplitter, dialect, frame_bytes
from links.recording import CompressedImage, RecordingReader, RecordingWriter, encode_compressed_image
from links.simulated.sensors.protocol2 import status
from links.vehicle_odometry import VehicleOdometry
from links.zenoh.envelope import read_envelope
from stages import messages
from tests.links.fuzz_files import files

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SHARE = float(os.environ.get("GRD_FUZZ_SHARE", "1"))
MAX_INPUT_S = 20.0  # for one input, on a busy machine
MAX_GROWTH_MB = 300.0  # of the process by one format
MIN_INPUTS = 1_000_000
NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF)
TOKENS = (
    b"null",
    b"-1",
    b"1e999",
    b"NaN",
    b"[]",
    b"{}",
    b'""',
    b"true",
    b"\xff",
    b"9" * 30,
    b"[" * 60,
    b"&a *a",
    b"!!",
)


class Mutator:
    """Mutates valid inputs."""

    def __init__(self, seeds: list[bytes], seed: int = 7, text: bool = False) -> None:
        self._rng, self._seeds, self._text = random.Random(seed), seeds, text

    def next(self) -> bytes:
        rng = self._rng
        if rng.random() < 0.02:
            return rng.randbytes(rng.randrange(0, 200))
        data = bytearray(rng.choice(self._seeds))
        for _ in range(rng.randrange(1, 5)):
            at = rng.randrange(len(data) + 1)
            what = rng.randrange(7 if self._text else 6)
            if what == 0 and data:
                data[at - 1] ^= 1 << rng.randrange(8)
            elif what == 1:
                size = rng.choice((1, 2, 4, 8))
                data[at : at + size] = (rng.choice(NUMBERS) % 256**size).to_bytes(size, "little")
            elif what == 2:
                del data[at : at + rng.randrange(1, 40)]
            elif what == 3:
                data[at:at] = rng.randbytes(rng.randrange(1, 20))
            elif what == 4:
                other = rng.choice(self._seeds)
                start = rng.randrange(len(other) + 1)
                data[at : at + 40] = other[start : start + 40]
            elif what == 5:
                data = data[: max(at, len(data) // 2)] if rng.random() < 0.3 else data
            else:
                token = rng.choice(TOKENS)
                data[at : at + rng.choice((0, len(token)))] = token
        return bytes(data)

    def coin(self) -> bool:
        return self._rng.random() < 0.5


@dataclass
class InputFormat:
    """One format: number of inputs, function under test, and the errors that it may raise."""

    name: str
    count: int
    decode: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]
    mutator: Mutator
    add_checksum: Callable[[bytes], bytes] | None = None


class InputTimeout(Exception):
    pass


@contextmanager
def alarm():
    def ring(*_):
        raise InputTimeout(f"an input took longer than {MAX_INPUT_S:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def records(topics: list[str], most: int = 20) -> list[bytes]:
    with RecordingReader(ROOT / "recordings" / "experiment_2.mcap") as reader:
        found: dict[str, list[bytes]] = {}
        for record in reader.records(topics):
            found.setdefault(record.topic, []).append(record.data)
    return [data for kind in found.values() for data in kind[:: max(len(kind) // most, 1)]]


def vlp16() -> InputFormat:
    lidar, mutator, now = Lidar(slice_ms=0.1), Mutator(records(["/lidar/packets"])), [10**18]

    def take(data: bytes) -> object:
        now[0] += 1_327_104
        return lidar.decode(Record("/lidar/packets", now[0], now[0], data))

    return InputFormat("VLP-16 packets", 330_000, take, (LinkError,), mutator)


def position() -> InputFormat:
    sentence = b"$GPRMC,101112,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
    packet = bytes(198) + struct.pack("<I", 5) + b"\x03" + bytes(3) + sentence.ljust(306, b"\0")
    return InputFormat("position packets", 90_000, PpsMonitor().add, (), Mutator([packet[:512].ljust(512, b"\0")]))


def add_mavlink_checksum(data: bytes) -> bytes:
    """Correct the checksum if the header contains a valid length."""
    length = frame_bytes(data)
    if not length or length > len(data) or data[0] != 0xFD or data[2]:
        return data
    kind = int.from_bytes(data[7:10], "little")
    known = dialect().mavlink_map.get(kind)
    crc = ardupilotmega.x25crc(data[1 : length - 2])
    crc.accumulate(bytes([known.crc_extra if known else 0]))
    return data[: length - 2] + struct.pack("<H", crc.crc)


def mavlink_frames() -> InputFormat:
    autopilot, splitters = Autopilot(), (FrameSplitter(), FrameSplitter())
    mutator, now = Mutator(records(["/autopilot/rx"], 60)), [10**18]

    def take(data: bytes) -> None:
        now[0] += 5_000_000
        splitters[0].datagram(data)
        splitters[1].stream(data)
        autopilot.decode(Record("/autopilot/rx", now[0], now[0], data))

    return InputFormat("MAVLink", 180_000, take, (), mutator, add_mavlink_checksum)


class Line(BlockingPort):
    """A serial line that replies with given bytes; its time advances with each call."""

    def __init__(self) -> None:
        super().__init__("memory", 1_000_000, 0.02)
        self.reply, self.now_ms, self.tx_time_per_byte = b"", 0.0, 0.01

    def getCurrentTime(self) -> float:
        self.now_ms += 1.0
        return self.now_ms

    def readPort(self, length: int) -> bytes:
        given, self.reply = self.reply[:length], self.reply[length:]
        return given

    def writePort(self, packet) -> int:
        return len(packet)

    def clearPort(self) -> None:
        pass

    def drain(self, quiet_s: float, limit_s: float) -> int:
        dropped, self.reply = len(self.reply), b""
        return dropped


def servo_replies() -> InputFormat:
    line = Line()
    bus = Bus(line, 1)
    sdk = Protocol2PacketHandler()

    def add_checksum(data: bytes) -> bytes:
        if len(data) < 11:
            return data
        body = data[:-2]
        return body + struct.pack("<H", sdk.updateCRC(0, list(body), len(body)))

    def take(data: bytes) -> None:
        line.reply, line.is_using = data, False
        bus.read(126, 10)

    good = [status(1, 0, bytes(range(10))), status(1, 0x80, bytes(10)), status(1, 0, b"\xff\xff\xfd\x00" * 2 + b"ab")]
    return InputFormat("servo replies", 120_000, take, (BusError,), Mutator(good), add_checksum)


def json_format(name: str, count: int, source, topic: str, good: list[bytes]) -> InputFormat:
    return InputFormat(
        name, count, lambda data: source.decode(Record(topic, 10**18, 10**18, data)), (), Mutator(good, text=True)
    )


def odometry_json() -> InputFormat:
    pose = {"xyz_m": [1.0, 2.0, 0.1], "quaternion_xyzw": [0, 0, 0, 1], "covariance": [0.01] * 36, "age_s": 0.02}
    good = [json.dumps(pose).encode(), json.dumps({**pose, "covariance": None}).encode()]
    return json_format("vehicle odometry", 60_000, VehicleOdometry(), "/vehicle/odometry", good)


def servo_json() -> InputFormat:
    state = {"position_rad": 1.5, "velocity_radps": 0.1, "goal_rad": 1.2, "error": 0}
    return json_format("servo states", 60_000, Servo(), "/servo/state", [json.dumps(state).encode()])


def camera_frames() -> InputFormat:
    import cv2
    import numpy as np

    camera = Camera(topic="/camera/vehicle")
    jpeg = cv2.imencode(".jpg", np.random.default_rng(3).integers(0, 255, (48, 64), np.uint8))[1].tobytes()
    good = [encode_compressed_image(CompressedImage(10**18, "camera_vehicle", jpeg))]
    return InputFormat(
        "camera frames", 60_000, lambda d: camera.decode(Record("/camera/vehicle", 1, 1, d)), (), Mutator(good)
    )


def zenoh_messages() -> InputFormat:
    kinds = {name: cls for name, cls in vars(messages).items() if isinstance(cls, type) and issubclass(cls, Message)}
    lidar = Lidar(slice_ms=0.1).decode(Record("/lidar/packets", 10**18, 10**18, records(["/lidar/packets"], 2)[0]))
    state = Servo().decode(Record("/servo/state", 1, 1, records(["/servo/state"], 2)[0]))
    tick, lost = messages.Tick(stamp_ns=1), messages.TrackState(
        stamp_ns=1, state=messages.TrackingState.LOST, reason="gone", hits=1, frame_s=0.1, track_id=2
    )  # fmt: skip
    good = [encode(message) for message in (lidar, state, tick, lost)]

    def add_checksum(data: bytes) -> bytes:
        if len(data) < 22:
            return data
        name = data[21]
        head = bytearray(data[:22])
        head[13:17] = struct.pack("<I", zlib.crc32(data[22:]))
        head[17:21] = struct.pack("<I", max(len(data) - 22 - name, 0) % MAX_BYTES)
        return bytes(head) + data[22:]

    def take(data: bytes) -> None:
        read_envelope(data)
        decode(data, kinds)

    return InputFormat("messages of hosts", 150_000, take, (CodecError,), Mutator(good), add_checksum)


def mcap_files(folder: Path) -> InputFormat:
    good = folder / "good.mcap"
    with RecordingWriter(good, rig_yaml="version: 1\n", config_yaml="stages: {}\n", lossless=True) as writer:
        for number in range(40):
            writer.write(Record("/servo/state", 1000 + number, 900 + number, b'{"a": %d}' % number))
            writer.write(Record("/camera/vehicle", 1000 + number, 900 + number, bytes([number]) * 50))
    bad = folder / "bad.mcap"

    def take(data: bytes) -> None:
        bad.write_bytes(data)
        with RecordingReader(bad) as reader:
            for _ in reader.records():
                pass

    return InputFormat("MCAP files", 10_000, take, (LinkError,), Mutator([good.read_bytes()]))


def yaml_files(folder: Path) -> InputFormat:
    for name in ("estimate.yaml", "paper.yaml"):
        load_graph(ROOT / "configs" / name)  # imports all stages that they name, once
    bad = folder / "bad.yaml"
    good = [(ROOT / "configs" / name).read_bytes() for name in ("estimate.yaml", "paper.yaml")]
    good = [text.replace(b"include: rigs", f"include: {ROOT}/configs/rigs".encode()) for text in good]

    def take(data: bytes) -> None:
        bad.write_bytes(data)
        load_graph(bad)

    return InputFormat("YAML configurations", 3_000, take, (ConfigError,), Mutator(good, text=True))


def hosts_files(folder: Path) -> InputFormat:
    graph = load_graph(ROOT / "configs" / "paper.yaml")
    files = {"certificate": "c.pem", "key": "k.pem", "authority": "a.pem"}
    hosts = {"vehicle": {"listen": "tls/127.0.0.1:7447", **files}, "base": files}
    placement = {node: "base" if node == "viewer" else "vehicle" for node in graph.nodes}
    whole = {"hosts": hosts, "placement": placement, "taps": {"viewer": ["track.drone_fix"]}}
    bad = folder / "bad_hosts.yaml"

    def take(data: bytes) -> None:
        bad.write_bytes(data)
        load_hosts(bad, graph)

    return InputFormat("hosts.yaml", 6_000, take, (ConfigError,), Mutator([yaml.safe_dump(whole).encode()], text=True))


def fuzz(input_format: InputFormat) -> str:
    """Run all inputs of one format; returns its line of the table. Fails with the input that raised another error."""
    count = max(round(input_format.count * SHARE), 100)
    rejected = worst_s = 0.0
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    begin_s = time.perf_counter()
    with alarm():
        for number in range(count):
            data = input_format.mutator.next()
            if input_format.add_checksum is not None and input_format.mutator.coin():
                data = input_format.add_checksum(data)
            signal.setitimer(signal.ITIMER_REAL, MAX_INPUT_S)
            start_s = time.perf_counter()
            try:
                input_format.decode(data)
            except input_format.errors:
                rejected += 1
            except Exception as error:  # noqa: BLE001 (a failure)
                pytest.fail(f"{input_format.name}, input {number}: {error!r} for {data[:2000]!r}")
            worst_s = max(worst_s, time.perf_counter() - start_s)
    took_s = time.perf_counter() - begin_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    assert peak_mb - before_mb < MAX_GROWTH_MB, f"{input_format.name}: grew by {peak_mb - before_mb:.0f} MB"
    return (
        f"{input_format.name:22}{count:>9}{100 * rejected / count:9.1f}{took_s:9.1f}{1e3 * worst_s:11.1f}{peak_mb:9.0f}"
        f"{peak_mb - before_mb:9.1f}"
    )


def test_a_million_mutated_inputs_cause_no_crash_timeout_or_growth(tmp_path):
    formats = [
        vlp16(), position(), mavlink_frames(), servo_replies(), servo_json(), odometry_json(), camera_frames(),
        zenoh_messages(), mcap_files(tmp_path), yaml_files(tmp_path), hosts_files(tmp_path),
    ]  # fmt: skip
    for name, count, take, errors, good, text in files(tmp_path):
        formats.append(InputFormat(name, count, take, errors, Mutator(good, text=text)))
    lines = [f"{'format':22}{'inputs':>9}{'raised %':>9}{'time [s]':>9}{'worst [ms]':>11}{'RSS [MB]':>9}{'growth':>9}"]
    for input_format in formats:
        lines.append(fuzz(input_format))
        sys.stdout.write("\n".join(lines[-1:]) + "\n")
    sys.stdout.write("\n" + "\n".join(lines) + f"\n{sum(each.count for each in formats)} inputs at share 1\n")
    assert sum(each.count for each in formats) >= MIN_INPUTS
