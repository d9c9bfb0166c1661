"""Importing autopilots' own logs: ArduPilot dataflash and PX4 ULog, written here byte by byte, and a real flight."""

from __future__ import annotations

import math
import re
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from flow.link import LinkError
from links.cli.app import app
from links.importing import ImportReport, import_file
from links.importing.dataflash import DataflashLog
from links.mavlink.autopilot import Autopilot
from links.mavlink.transport.framing import parse_frame
from links.recording import RecordingReader
from stages.messages import AutopilotStatus, DroneAttitude, DroneGnss, DroneImu, DroneLocalPosition

REAL = Path(__file__).resolve().parents[4] / "shared" / "data" / "mavlink" / "copter_dataflash_imu50.bin"
GPS_EPOCH_S, LEAP_S = 315_964_800, 18
WEEK, MILLISECONDS = 2200, 123_000_000


def imported(tmp_path: Path, name: str, content: bytes) -> tuple[ImportReport, list[Any], list[Any]]:
    """The report, the decoded messages, and the frames."""
    path = tmp_path / name
    path.write_bytes(content)
    report = import_file(path, overwrite=True)
    with RecordingReader(report.path) as reader:
        assert reader.rig_yaml is None
        records = list(reader.records())
    autopilot = Autopilot()
    messages = [m for r in records if (m := autopilot.decode(r)) is not None]
    assert autopilot.counters["lost"] == 0
    return report, messages, [parse_frame(r.data) for r in records]


def of(messages: list[Any], kind: type) -> list[Any]:
    return [m for m in messages if isinstance(m, kind)]


# ---- ArduPilot


FORMATS: dict[str, tuple[int, str, str]] = {  # type, format, columns (LogStructure.h)
    "IMU": (130, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ATT": (131, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "GPS": (132, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "XKF1": (133, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD"),
    "ARM": (134, "QB", "TimeUS,ArmState"),
}
PACKED = {"Q": "Q", "B": "B", "f": "f", "c": "h", "C": "H", "I": "I", "H": "H", "L": "i", "e": "i"}
SCALE = {"c": 100, "C": 100, "e": 100, "L": 1e7}


def dataflash(rows: list[tuple[Any, ...]], formats: dict[str, tuple[int, str, str]] | None = None) -> bytes:
    """A log of (name, values...) with the definitions first."""
    formats = FORMATS if formats is None else formats
    out = _definition(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89)
    for name, (number, form, columns) in formats.items():
        size = struct.calcsize("<" + "".join(PACKED[c] for c in form)) + 3
        out += _definition(number, name, form, columns, size)
    for name, *values in rows:
        number, form, _ = formats[name]
        scaled = [round(v * SCALE[c]) if c in SCALE else v for c, v in zip(form, values, strict=True)]
        out += b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(PACKED[c] for c in form), *scaled)
    return out


def _definition(number: int, name: str, form: str, columns: str, size: int) -> bytes:
    texts = (name.encode(), form.encode(), columns.encode())
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, *texts)


def flight() -> bytes:
    """A second of flight, armed after half of it; the second IMU and the EKF's second core differ."""
    rows: list[tuple[Any, ...]] = []
    for k in range(100):
        us = 60_000_000 + 10_000 * k
        rows.append(("IMU", us, 0, 0.1, 0.2, 0.3, 0.5, -0.4, -9.8))
        rows.append(("IMU", us + 1, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        if k % 10 == 0:
            rows.append(("ATT", us + 2, 0, 10.0, 0, -5.0, 0, 90.0))
            rows.append(("XKF1", us + 3, 0, 1.0, 2.0, 3.0, 10.0, 20.0, -30.0))
            rows.append(("XKF1", us + 4, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        if k % 20 == 0:
            rows.append(("GPS", us, 0, 3, MILLISECONDS + 10 * k, WEEK, 12, 0.8, 35.7, 139.7, 40.5, 1.5, 270.0, 0, 0, 1))
        if k == 50:
            rows.append(("ARM", us, 1))
    return dataflash(rows)


def test_a_dataflash_log_becomes_the_autopilots_messages(tmp_path: Path):
    report, messages, frames = imported(tmp_path, "00000012.BIN", flight())
    assert report.path == tmp_path / "00000012.mcap"
    assert report.warnings == []
    imu, attitude, position = (of(messages, kind) for kind in (DroneImu, DroneAttitude, DroneLocalPosition))
    assert (len(imu), len(attitude), len(position)) == (100, 10, 10)
    assert_allclose(imu[5].acceleration_drone_mps2, [0.5, 0.4, 9.8], rtol=1e-6)  # forward, left, up
    assert_allclose(imu[5].angular_velocity_drone_radps, [0.1, -0.2, -0.3], rtol=1e-6)
    yaw, pitch, roll = math.radians(-90.0), math.radians(5.0), math.radians(10.0)
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    Rz, Ry = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]), np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    assert_allclose(attitude[3].R_odom_drone, Rz @ Ry @ Rx, atol=2e-4)
    assert_allclose(attitude[3].angular_velocity_drone_radps, [0.1, -0.2, -0.3], rtol=1e-6)  # of the IMU before it
    assert_allclose(position[2].xyz_odom_m, [10, -20, 30])
    assert_allclose(position[2].velocity_odom_mps, [1, -2, -3])
    assert [s.armed for s in of(messages, AutopilotStatus)] == [False]
    (fix, *more) = [f for f in frames if f.get_type() == "GPS_RAW_INT"]
    assert (fix.fix_type, fix.lat, fix.lon, fix.alt) == (3, 357_000_000, 1_397_000_000, 40_500)
    assert (fix.eph, fix.vel, fix.cog, fix.satellites_visible) == (80, 150, 27_000, 12)
    assert len(more) == 4


def test_times_of_a_dataflash_log_are_utc_and_of_the_sample(tmp_path: Path):
    _, messages, _ = imported(tmp_path, "a.bin", flight())
    utc_ns = round((GPS_EPOCH_S + WEEK * 604_800 + MILLISECONDS / 1000 - LEAP_S) * 1e9)
    assert abs(of(messages, DroneImu)[0].stamp_ns - (utc_ns - 12_500_000)) < 100_000  # behind ArduPilot's filters
    assert abs(of(messages, DroneAttitude)[0].stamp_ns - utc_ns) < 600_000


def test_the_flights_second_half_is_armed(tmp_path: Path):
    rows = [("ARM", 1_000_000, 1)]
    rows += [("IMU", 1_000_000 + 10_000 * k, 0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8) for k in range(250)]
    _, messages, _ = imported(tmp_path, "a.bin", dataflash(rows))
    assert [s.armed for s in of(messages, AutopilotStatus)] == [True] * 3


def test_a_dataflash_log_that_is_cut_or_damaged_gives_the_rest_with_a_warning(tmp_path: Path):
    content = bytearray(flight())
    content[3000:3020] = bytes(20)
    report, messages, _ = imported(tmp_path, "a.bin", bytes(content[:-10]))
    assert 95 <= len(of(messages, DroneImu)) < 100
    assert "bad bytes" in report.warnings[0]


def test_the_end_of_a_dataflash_log_is_the_first_warning_and_the_others_take_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from pymavlink import DFReader

    receive, count = DFReader.DFReader_binary.recv_msg, 0

    def fails(log: Any) -> Any:
        nonlocal count
        count += 1
        if count > 100:
            raise ValueError("broken")
        sys.stdout.write("bad bytes\n" + 1000 * "more\n")
        return receive(log)

    monkeypatch.setattr(DFReader.DFReader_binary, "recv_msg", fails)
    (tmp_path / "a.bin").write_bytes(flight())
    log = DataflashLog(tmp_path / "a.bin")
    assert 50 < len(list(log.messages())) <= 100
    end, skipped = log.warnings()
    assert re.search(r"a.bin: ends at \d+ % of its bytes: broken: the rest is missing", end)
    assert skipped.endswith("a.bin: bad bytes (and 100099 more)")
    assert len(log._noise.first) < 1000


def test_a_dataflash_log_without_sensors_is_refused(tmp_path: Path):
    for content, says in (
        (dataflash([("ARM", 1_000_000, 1)]), "no IMU, attitude, position or GNSS"),
        (b"\xa3\x95\x80" + bytes(100), "no IMU, attitude, position or GNSS|no dataflash log"),
    ):
        (tmp_path / "a.bin").write_bytes(content)
        with pytest.raises(LinkError, match=says):
            import_file(tmp_path / "a.bin")
        assert not (tmp_path / "a.mcap").exists()


def test_messages_of_the_same_name_with_other_fields_are_counted(tmp_path: Path):
    formats = {"ATT": (131, "Qf", "TimeUS,Angle"), "IMU": FORMATS["IMU"]}
    rows = [("ATT", 1_000_000, 1.0), ("IMU", 1_000_001, 0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8)]
    report, _, _ = imported(tmp_path, "a.bin", dataflash(rows, formats))
    assert report.skipped == {"ATT messages without the fields of an ArduPilot log": 1}


def test_flipped_bytes_of_a_dataflash_log_raise_only_link_errors(tmp_path: Path):
    content, random = flight(), np.random.default_rng(7)
    for _ in range(60):
        damaged = bytearray(content)
        for at in random.integers(3, len(content) if random.random() < 0.5 else 500, 3):
            damaged[at] = random.integers(0, 256)
        (tmp_path / "a.bin").write_bytes(damaged)
        try:
            import_file(tmp_path / "a.bin").path.unlink()
        except LinkError:
            assert not (tmp_path / "a.mcap").exists()


@pytest.mark.skipif(not REAL.is_file(), reason="the shared data are not here")
def test_a_real_flight_is_imported_completely(tmp_path: Path):
    report = import_file(REAL, tmp_path / "real.mcap")
    with RecordingReader(report.path) as reader:
        records = list(reader.records())
    autopilot = Autopilot()
    messages = [m for r in records if (m := autopilot.decode(r)) is not None]
    imu, attitude = of(messages, DroneImu), of(messages, DroneAttitude)
    assert (len(imu), len(attitude), autopilot.counters["unused"]) == (16_627, 3_326, 0)
    assert len(of(messages, DroneGnss)) == 1_664
    still = np.array([m.acceleration_drone_mps2 for m in imu[:500]])
    assert_allclose(np.linalg.norm(still.mean(0)), 9.8, atol=0.2)
    up = np.array([m.R_odom_drone[2] for m in attitude])
    assert_allclose(still.mean(0) / np.linalg.norm(still.mean(0)), up[:100].mean(0), atol=0.06)  # 2 deg of offset
    times = np.array([m.stamp_ns for m in attitude])
    part = np.searchsorted(times, [m.stamp_ns for m in imu])
    rates = np.array([m.angular_velocity_drone_radps for m in imu])
    turned = np.array([rates[part == k].sum(0) * 0.02 for k in range(1, len(times))])  # between two attitudes
    for axis in (0, 1):  # d up / dt = -rate x up
        expected = -np.cross(turned, up[:-1])[:, axis]
        assert np.corrcoef(np.diff(up, axis=0)[:, axis], expected)[0, 1] > 0.9
    gaps_ns = np.diff([m.stamp_ns for m in imu])
    assert 18_000_000 < np.median(gaps_ns) < 22_000_000


# ---- PX4


def ulog(topics: dict[str, tuple[str, list[tuple[Any, ...]]]]) -> bytes:
    """A ULog: per topic its fields (`float[3] gyro_rad;...`) and rows, the first value of which is the timestamp."""
    codes = {"uint64_t": "Q", "float": "f", "double": "d", "uint8_t": "B", "int32_t": "i", "bool": "?"}

    def section(kind: str, data: bytes) -> bytes:
        return struct.pack("<HB", len(data), ord(kind)) + data

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000)
    out += section("B", bytes(40))
    for name, (fields, _) in topics.items():
        out += section("F", f"{name}:{fields}".encode())
    for number, name in enumerate(topics):
        out += section("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        form = "<"
        for each in fields.strip(";").split(";"):
            kind = each.split(" ")[0]
            base, _, count = kind.partition("[")
            form += (count.rstrip("]") or "1") + codes[base]
        for row in rows:
            out += section("D", struct.pack("<H", number) + struct.pack(form, *row))
    return out


def px4_flight(utc_us: int = 1_700_000_000_000_000, new: bool = False) -> bytes:
    half = math.sqrt(0.5)
    times = [60_000_000 + 4_000 * k for k in range(250)]
    if new:
        gps = (
            "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;double altitude_msl_m;"
            "float hdop;float vel_m_s;float cog_rad;uint8_t fix_type;uint8_t satellites_used;"
        )
        place: tuple[Any, ...] = (35.7, 139.7, 40.5)
    else:
        gps = (
            "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
            "float hdop;float vel_m_s;float cog_rad;uint8_t fix_type;uint8_t satellites_used;"
        )
        place = (357_000_000, 1_397_000_000, 40_500)
    return ulog(
        {
            "sensor_combined": (
                "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
                [(t, 0.1, 0.2, 0.3, 0.5, -0.4, -9.8) for t in times],
            ),
            "vehicle_attitude": (
                "uint64_t timestamp;float[4] q;",
                [(t + 1, half, 0.0, 0.0, half) for t in times[::5]],  # facing east
            ),
            "vehicle_local_position": (
                "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;bool xy_valid;bool z_valid;",
                [(t + 2, 10.0, 20.0, -30.0, 1.0, 2.0, 3.0, k > 4, True) for k, t in enumerate(times[::25])],
            ),
            "vehicle_status": ("uint64_t timestamp;uint8_t arming_state;", [(times[0] - 1, 2)]),
            "sensor_gps" if new else "vehicle_gps_position": (
                gps,
                [
                    (times[0], 0, *place, 0.8, 1.5, math.pi, 2, 12),
                    (times[50], utc_us, *place, 0.8, 1.5, math.pi, 3, 12),
                ],
            ),
        }
    )


@pytest.mark.parametrize("new", [False, True])
def test_a_ulog_becomes_the_autopilots_messages(tmp_path: Path, new: bool):
    pytest.importorskip("pyulog")
    report, messages, frames = imported(tmp_path, "flight.ulg", px4_flight(new=new))
    assert report.warnings == []
    imu, attitude, position = (of(messages, kind) for kind in (DroneImu, DroneAttitude, DroneLocalPosition))
    assert (len(imu), len(attitude), len(position)) == (250, 50, 5)
    assert_allclose(imu[5].acceleration_drone_mps2, [0.5, 0.4, 9.8], rtol=1e-6)
    assert_allclose(imu[5].angular_velocity_drone_radps, [0.1, -0.2, -0.3], rtol=1e-6)
    assert_allclose(attitude[3].R_odom_drone, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    assert_allclose(position[2].xyz_odom_m, [10, -20, 30])
    assert [s.armed for s in of(messages, AutopilotStatus)] == [True]
    (_, fix) = [f for f in frames if f.get_type() == "GPS_RAW_INT"]
    assert (fix.fix_type, fix.lat, fix.lon, fix.alt, fix.cog) == (3, 357_000_000, 1_397_000_000, 40_500, 18_000)
    start_ns = 1_700_000_000_000_000_000 - 50 * 4_000_000
    assert abs(imu[0].stamp_ns - (start_ns - 2_000_000)) < 100_000  # its values are 2 ms old


def test_a_ulog_without_gnss_keeps_the_time_since_boot(tmp_path: Path):
    pytest.importorskip("pyulog")
    _, messages, _ = imported(tmp_path, "flight.ulg", px4_flight(utc_us=0))
    assert abs(of(messages, DroneImu)[0].stamp_ns - 60_000_000_000) < 5_000_000


def test_a_ulog_that_is_damaged_or_empty_is_refused(tmp_path: Path):
    pytest.importorskip("pyulog")
    whole = px4_flight()
    for content, says in (
        (whole[:20], "no IMU, attitude, position or GNSS|cannot be read"),
        (ulog({"other": ("uint64_t timestamp;float x;", [(1, 1.0)])}), "no IMU, attitude, position or GNSS"),
        (
            ulog({"sensor_combined": ("uint64_t timestamp;float x;", [(1, 1.0)])}),
            r"topic sensor_combined has no field 'gyro_rad\[0\]': .* import the telemetry log",
        ),
    ):
        (tmp_path / "a.ulg").write_bytes(content)
        with pytest.raises(LinkError, match=says):
            import_file(tmp_path / "a.ulg")
        assert not (tmp_path / "a.mcap").exists()
    random = np.random.default_rng(5)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in random.integers(16, len(whole) if random.random() < 0.5 else 800, 3):
            damaged[at] = random.integers(0, 256)
        (tmp_path / "a.ulg").write_bytes(damaged)
        try:
            import_file(tmp_path / "a.ulg").path.unlink()
        except LinkError:
            assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("latitude_deg", [math.nan, 1e6, math.inf])
def test_damaged_values_of_a_ulog_are_counted_and_the_rest_is_imported(tmp_path: Path, latitude_deg: float):
    pytest.importorskip("pyulog")
    latitude = struct.pack("<d", 35.7)
    content = px4_flight(new=True).replace(latitude, struct.pack("<d", latitude_deg), 1)
    report, messages, frames = imported(tmp_path, "flight.ulg", content)
    assert report.skipped == {"values out of range": 1}
    assert len(of(messages, DroneImu)) == 250
    assert len([f for f in frames if f.get_type() == "GPS_RAW_INT"]) == 1


def test_without_pyulog_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "pyulog", None)
    (tmp_path / "a.ulg").write_bytes(px4_flight())
    with pytest.raises(LinkError, match=r"install the extra ulog"):
        import_file(tmp_path / "a.ulg")


def test_info_shows_both_logs(tmp_path: Path):
    (tmp_path / "a.bin").write_bytes(flight())
    result = CliRunner().invoke(app, ["info", str(tmp_path / "a.bin")])
    assert result.exit_code == 0, result.output
    assert "ArduPilot dataflash log" in result.output
    assert "XKF1" in result.output
    pytest.importorskip("pyulog")
    (tmp_path / "a.ulg").write_bytes(px4_flight())
    result = CliRunner().invoke(app, ["info", str(tmp_path / "a.ulg")])
    assert result.exit_code == 0, result.output
    assert "vehicle_local_position" in result.output
