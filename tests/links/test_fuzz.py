"""Hostile bytes at every door: a million and more, changed from good ones by a seeded hand; a table at the end.

    python -m pytest -m slow -s tests/links/test_fuzz.py

Each format says which errors it may raise; any other is a crash. An input that takes longer than MOST_S hangs. Where a
checksum guards a format, half of the inputs get a right one, so that what lies behind it is reached. `GRD_FUZZ_SHARE`
(0.01) makes it shorter while one looks for something.
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
from links.mavlink import Autopilot
from links.mavlink.framing import FrameSplitter, dialect, frame_bytes
from links.recording import CompressedImage, RecordingReader, RecordingWriter, encode_compressed_image
from links.simulated.sensors.protocol2 import status
from links.vehicle_odometry import VehicleOdometry
from links.velodyne import Lidar
from links.velodyne.position import PpsMonitor
from links.zenoh.envelope import read_envelope
from stages import messages

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SHARE = float(os.environ.get("GRD_FUZZ_SHARE", "1"))
MOST_S = 20.0  # for one input, on a busy machine
MOST_GROWTH_MB = 300.0  # of the process by one format
WISHED = 1_000_000
NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF)
WORDS = (b"null", b"-1", b"1e999", b"NaN", b"[]", b"{}", b'""', b"true", b"\xff", b"9" * 30, b"[" * 60, b"&a *a", b"!!")


class Hand:
    """Makes bad bytes of good ones."""

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
                word = rng.choice(WORDS)
                data[at : at + rng.choice((0, len(word)))] = word
        return bytes(data)

    def coin(self) -> bool:
        return self._rng.random() < 0.5


@dataclass
class Door:
    """One format: how many inputs, who takes them, and which errors are an answer."""

    name: str
    count: int
    take: Callable[[bytes], object]
    answers: tuple[type[Exception], ...]
    hand: Hand
    seal: Callable[[bytes], bytes] | None = None


class Hang(Exception):
    pass


@contextmanager
def alarm():
    def ring(*_):
        raise Hang(f"an input took longer than {MOST_S:g} s")

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


def vlp16() -> Door:
    lidar, hand, now = Lidar(), Hand(records(["/lidar/packets"])), [10**18]

    def take(data: bytes) -> object:
        now[0] += 1_327_104
        return lidar.decode(Record("/lidar/packets", now[0], now[0], data))

    return Door("VLP-16 packets", 330_000, take, (LinkError,), hand)


def position() -> Door:
    told = b"$GPRMC,101112,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
    packet = bytes(198) + struct.pack("<I", 5) + b"\x03" + bytes(3) + told.ljust(306, b"\0")
    return Door("position packets", 90_000, PpsMonitor().add, (), Hand([packet[:512].ljust(512, b"\0")]))


def mavlink_seal(data: bytes) -> bytes:
    """The right checksum, where the header says how long the frame is."""
    length = frame_bytes(data)
    if not length or length > len(data) or data[0] != 0xFD or data[2]:
        return data
    kind = int.from_bytes(data[7:10], "little")
    known = dialect().mavlink_map.get(kind)
    crc = ardupilotmega.x25crc(data[1 : length - 2])
    crc.accumulate(bytes([known.crc_extra if known else 0]))
    return data[: length - 2] + struct.pack("<H", crc.crc)


def mavlink_frames() -> Door:
    autopilot, splitters = Autopilot(), (FrameSplitter(), FrameSplitter())
    hand, now = Hand(records(["/autopilot/rx"], 60)), [10**18]

    def take(data: bytes) -> None:
        now[0] += 5_000_000
        splitters[0].datagram(data)
        splitters[1].stream(data)
        autopilot.decode(Record("/autopilot/rx", now[0], now[0], data))

    return Door("MAVLink", 180_000, take, (), hand, mavlink_seal)


class Line(BlockingPort):
    """A serial line that answers with given bytes, and whose time goes on by being asked."""

    def __init__(self) -> None:
        super().__init__("memory", 1_000_000, 0.02)
        self.answer, self.now_ms, self.tx_time_per_byte = b"", 0.0, 0.01

    def getCurrentTime(self) -> float:
        self.now_ms += 1.0
        return self.now_ms

    def readPort(self, length: int) -> bytes:
        given, self.answer = self.answer[:length], self.answer[length:]
        return given

    def writePort(self, packet) -> int:
        return len(packet)

    def clearPort(self) -> None:
        pass

    def drain(self, quiet_s: float, limit_s: float) -> int:
        dropped, self.answer = len(self.answer), b""
        return dropped


def servo_replies() -> Door:
    line = Line()
    bus = Bus(line, 1)
    sdk = Protocol2PacketHandler()

    def seal(data: bytes) -> bytes:
        if len(data) < 11:
            return data
        body = data[:-2]
        return body + struct.pack("<H", sdk.updateCRC(0, list(body), len(body)))

    def take(data: bytes) -> None:
        line.answer, line.is_using = data, False
        bus.read(126, 10)

    good = [status(1, 0, bytes(range(10))), status(1, 0x80, bytes(10)), status(1, 0, b"\xff\xff\xfd\x00" * 2 + b"ab")]
    return Door("servo replies", 120_000, take, (BusError,), Hand(good), seal)


def json_door(name: str, count: int, source, topic: str, good: list[bytes]) -> Door:
    return Door(name, count, lambda data: source.decode(Record(topic, 10**18, 10**18, data)), (), Hand(good, text=True))


def odometry_json() -> Door:
    pose = {"xyz_m": [1.0, 2.0, 0.1], "quaternion_xyzw": [0, 0, 0, 1], "covariance": [0.01] * 36, "age_s": 0.02}
    good = [json.dumps(pose).encode(), json.dumps({**pose, "covariance": None}).encode()]
    return json_door("vehicle odometry", 60_000, VehicleOdometry(), "/vehicle/odometry", good)


def servo_json() -> Door:
    state = {"position_rad": 1.5, "velocity_radps": 0.1, "goal_rad": 1.2, "error": 0}
    return json_door("servo states", 60_000, Servo(), "/servo/state", [json.dumps(state).encode()])


def pictures() -> Door:
    import cv2
    import numpy as np

    camera = Camera(topic="/camera/vehicle")
    jpeg = cv2.imencode(".jpg", np.random.default_rng(3).integers(0, 255, (48, 64), np.uint8))[1].tobytes()
    good = [encode_compressed_image(CompressedImage(10**18, "camera_vehicle", jpeg))]
    return Door("camera frames", 60_000, lambda d: camera.decode(Record("/camera/vehicle", 1, 1, d)), (), Hand(good))


def zenoh_messages() -> Door:
    kinds = {name: cls for name, cls in vars(messages).items() if isinstance(cls, type) and issubclass(cls, Message)}
    lidar = Lidar().decode(Record("/lidar/packets", 10**18, 10**18, records(["/lidar/packets"], 2)[0]))
    state = Servo().decode(Record("/servo/state", 1, 1, records(["/servo/state"], 2)[0]))
    tick, lost = messages.Tick(stamp_ns=1), messages.TrackState(
        stamp_ns=1, state=messages.TrackingState.LOST, reason="gone", hits=1, frame_s=0.1, track_id=2
    )  # fmt: skip
    good = [encode(message) for message in (lidar, state, tick, lost)]

    def seal(data: bytes) -> bytes:
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

    return Door("messages of hosts", 150_000, take, (CodecError,), Hand(good), seal)


def mcap_files(folder: Path) -> Door:
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

    return Door("MCAP files", 10_000, take, (LinkError,), Hand([good.read_bytes()]))


def yaml_files(folder: Path) -> Door:
    for name in ("estimate.yaml", "paper.yaml"):
        load_graph(ROOT / "configs" / name)  # imports all stages that they name, once
    bad = folder / "bad.yaml"
    good = [(ROOT / "configs" / name).read_bytes() for name in ("estimate.yaml", "paper.yaml")]
    good = [text.replace(b"include: rigs", f"include: {ROOT}/configs/rigs".encode()) for text in good]

    def take(data: bytes) -> None:
        bad.write_bytes(data)
        load_graph(bad)

    return Door("YAML configurations", 3_000, take, (ConfigError,), Hand(good, text=True))


def hosts_files(folder: Path) -> Door:
    graph = load_graph(ROOT / "configs" / "paper.yaml")
    files = {"certificate": "c.pem", "key": "k.pem", "authority": "a.pem"}
    hosts = {"vehicle": {"listen": "tls/127.0.0.1:7447", **files}, "base": files}
    place = {node: "base" if node == "viewer" else "vehicle" for node in graph.nodes}
    whole = {"hosts": hosts, "place": place, "see": {"viewer": ["track.drone_fix"]}}
    bad = folder / "bad_hosts.yaml"

    def take(data: bytes) -> None:
        bad.write_bytes(data)
        load_hosts(bad, graph)

    return Door("hosts.yaml", 6_000, take, (ConfigError,), Hand([yaml.safe_dump(whole).encode()], text=True))


def knock(door: Door) -> str:
    """All inputs of one door; its line of the table. AssertionError with the input that broke something."""
    count = max(round(door.count * SHARE), 100)
    refused = worst_s = 0.0
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began_s = time.perf_counter()
    with alarm():
        for number in range(count):
            data = door.hand.next()
            if door.seal is not None and door.hand.coin():
                data = door.seal(data)
            signal.setitimer(signal.ITIMER_REAL, MOST_S)
            start_s = time.perf_counter()
            try:
                door.take(data)
            except door.answers:
                refused += 1
            except Exception as error:  # noqa: BLE001 (any other is the finding)
                pytest.fail(f"{door.name}, input {number}: {error!r} for {data[:2000]!r}")
            worst_s = max(worst_s, time.perf_counter() - start_s)
    took_s = time.perf_counter() - began_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    assert peak_mb - before_mb < MOST_GROWTH_MB, f"{door.name}: grew by {peak_mb - before_mb:.0f} MB"
    return (
        f"{door.name:22}{count:>9}{100 * refused / count:9.1f}{took_s:9.1f}{1e3 * worst_s:11.1f}{peak_mb:9.0f}"
        f"{peak_mb - before_mb:9.1f}"
    )


def test_a_million_bad_inputs_crash_nothing_hang_nothing_and_fill_no_memory(tmp_path):
    doors = [
        vlp16(), position(), mavlink_frames(), servo_replies(), servo_json(), odometry_json(), pictures(),
        zenoh_messages(), mcap_files(tmp_path), yaml_files(tmp_path), hosts_files(tmp_path),
    ]  # fmt: skip
    lines = [f"{'format':22}{'inputs':>9}{'raised %':>9}{'time [s]':>9}{'worst [ms]':>11}{'RSS [MB]':>9}{'growth':>9}"]
    for door in doors:
        lines.append(knock(door))
        sys.stdout.write("\n".join(lines[-1:]) + "\n")
    sys.stdout.write("\n" + "\n".join(lines) + f"\n{sum(door.count for door in doors)} inputs at share 1\n")
    assert sum(door.count for door in doors) >= WISHED
