"""The kind of a file, by its first bytes.

Source: MCAP specification 0; ROS bag format 2.0 (http://wiki.ros.org/Bags/Format/2.0); SQLite file format; ArduPilot
AP_Logger LogStructure.h (FMT message); PX4 ULog file format; pcap (draft-ietf-opsawg-pcap).
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from flow.link import LinkError
from links.importing.pcap import is_pcap
from links.importing.tlog import looks_like_tlog
from links.recording.format import PROFILE
from links.recording.reader import open_file
from links.ros.bag import BAG_METADATA

SNIFF_BYTES = 4096
RUN_FILES = ("summary.json", "run.log")
_ROS1, _SQLITE, _ULOG, _DATAFLASH = b"#ROSBAG V2.0", b"SQLite format 3\0", b"ULog\x01\x12\x35", b"\xa3\x95\x80"
_COMPRESSED = {
    b"\x28\xb5\x2f\xfd": "zstd -d",
    b"\x1f\x8b": "gunzip -k",
    b"BZh": "bunzip2 -k",
    b"\xfd7zXZ\0": "unxz -k",
    b"PK\x03\x04": "unzip",
}
"""First bytes of a file that is compressed as a whole, and the command that unpacks it."""
IMPORTED = (
    "a pcap capture, a MAVLink log (.tlog), an ArduPilot log (.bin), a PX4 log (.ulg), "
    "a ROS bag (.bag, .db3, .mcap or their folder)"
)


class FileKind(StrEnum):
    """What a file or folder is."""

    RECORDING = "grd recording"
    BAG = "ROS bag"
    CAPTURE = "pcap capture"
    TELEMETRY = "MAVLink telemetry log"
    DATAFLASH = "ArduPilot dataflash log"
    ULOG = "PX4 ULog"
    RUN = "run"


def file_kind(path: Path) -> FileKind | None:
    """The kind; None: unknown. LinkError when it cannot be read, or is compressed as a whole."""
    if path.is_dir():
        if (path / BAG_METADATA).is_file():
            return FileKind.BAG
        if any((path / name).is_file() for name in RUN_FILES):
            return FileKind.RUN
        for inside in sorted((*path.glob("*.db3"), *path.glob("*.mcap"), *path.glob("*.bag"))):
            raise LinkError(
                f"{path} has no {BAG_METADATA}, so that it is no ROS 2 bag: name the file {inside}, or write "
                f"{BAG_METADATA} with `ros2 bag reindex {path}`"
            )
        return None
    with open_file(path) as stream:
        start = stream.read(SNIFF_BYTES)
    for magic, unpack in _COMPRESSED.items():
        if start.startswith(magic):
            folder = f"give its folder with {BAG_METADATA}, or " if path.suffix == ".zstd" else ""
            raise LinkError(f"{path} is compressed as a whole: {folder}unpack it first (`{unpack} {path}`)")
    if start.startswith(MCAP0_MAGIC):
        return FileKind.RECORDING if _mcap_profile(start) in (None, PROFILE.encode()) else FileKind.BAG
    for magic, kind in ((_ROS1, FileKind.BAG), (_SQLITE, FileKind.BAG), (_ULOG, FileKind.ULOG)):
        if start.startswith(magic):
            return kind
    if start.startswith(_DATAFLASH):
        return FileKind.DATAFLASH
    if is_pcap(start):
        return FileKind.CAPTURE
    return FileKind.TELEMETRY if path.suffix == ".tlog" or looks_like_tlog(start) else None


def file_bytes(path: Path) -> int:
    """Size of a file, or of the files in a folder."""
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
    return sum(file.stat().st_size for file in files)


def _mcap_profile(start: bytes) -> bytes | None:
    """The profile in the header, the first record of an MCAP file: opcode, length u64, profile (u32 length, text).

    None: the file is cut off before it.
    """
    at = len(MCAP0_MAGIC) + 9
    if len(start) < at + 4:
        return None
    size = int.from_bytes(start[at : at + 4], "little")
    return start[at + 4 : at + 4 + size]
