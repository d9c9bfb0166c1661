"""UDP datagrams of a classic libpcap capture (tcpdump, VeloView, `editcap -F pcap`).

Both byte orders, microseconds and nanoseconds; Ethernet (with VLAN tags), raw IP, Linux cooked v1 and v2, loopback.
Datagrams that are larger than a packet of the network (an Ouster's) are captured in fragments, and put together again.

Source: draft-ietf-opsawg-pcap (file format); https://www.tcpdump.org/linktypes.html; RFC 791 (IPv4), RFC 768 (UDP).
"""

from __future__ import annotations

import ipaddress
import shlex
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from flow.link import LinkError

_MAGIC: dict[bytes, tuple[str, int]] = {  # byte order, ns per unit of the fraction
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_PCAPNG = b"\x0a\x0d\x0d\x0a"
_FILE_HEADER_BYTES = 24
_MAX_PACKET_BYTES = 262_144  # libpcap's largest snapshot length; more is damage
_ETHERNET, _RAW, _COOKED, _COOKED_2, _NULL, _LOOP = 1, 101, 113, 276, 0, 108
_RAW_ALIASES = (_RAW, 12, 14)  # numbers that some systems wrote for raw IP
_ETHERTYPE_IPV4 = 0x0800
_ETHERTYPE_VLAN = (0x8100, 0x88A8)
_AF_INET = 2
_PROTOCOL_UDP = 17
_MORE_FRAGMENTS, _FRAGMENT_OFFSET = 0x2000, 0x1FFF  # the offset counts 8 bytes
_INCOMPLETE = 64  # datagrams that are put together at a time; of more the oldest is dropped
_FRAGMENT = "IPv4 fragment of an incomplete datagram"


@dataclass(frozen=True, slots=True)
class Datagram:
    """One UDP datagram as captured."""

    time_ns: int
    sender: str
    port: int  # destination
    payload: bytes
    offset: int  # of its last packet header in the file


@dataclass(slots=True)
class PcapReport:
    """What was skipped in a capture."""

    skipped: Counter[str] = field(default_factory=Counter)  # packets by reason
    warnings: list[str] = field(default_factory=list)
    done_bytes: int = 0


def is_pcap(magic: bytes) -> bool:
    """Whether a file with this start is a capture, pcap or pcapng."""
    return magic[:4] in _MAGIC or magic[:4] == _PCAPNG


def read_datagrams(stream: IO[bytes], path: Path, report: PcapReport) -> Iterator[Datagram]:
    """UDP datagrams in file order. LinkError for what is no classic pcap; damage later on ends it with a warning."""
    header = stream.read(_FILE_HEADER_BYTES)
    if header[:4] == _PCAPNG:
        command = shlex.join(["editcap", "-F", "pcap", str(path), str(path.with_name(f"{path.stem}-classic.pcap"))])
        raise LinkError(f"{path} is a pcapng capture: convert it with `{command}`")
    if header[:4] not in _MAGIC:
        raise LinkError(f"{path} is no pcap capture: it starts with {header[:4].hex(' ')}")
    if len(header) < _FILE_HEADER_BYTES:
        raise LinkError(f"{path} ends at byte {len(header)}, in its file header: copy it again")
    order, unit_ns = _MAGIC[header[:4]]
    link_type = struct.unpack_from(order + "I", header, 20)[0] & 0xFFFF
    if link_type not in (_ETHERNET, *_RAW_ALIASES, _COOKED, _COOKED_2, _NULL, _LOOP):
        raise LinkError(
            f"{path}: link type {link_type} is not supported: capture on an Ethernet interface (tcpdump -i eth0)"
        )
    packet_header, fragments = struct.Struct(order + "IIII"), _Fragments(report.skipped)
    offset = _FILE_HEADER_BYTES
    while head := stream.read(packet_header.size):
        if len(head) < packet_header.size:
            report.warnings.append(f"{path}: cut off at byte {offset}, in a packet header")
            return
        seconds, fraction, captured, original = packet_header.unpack(head)
        if captured > _MAX_PACKET_BYTES or fraction * unit_ns >= 1_000_000_000:
            report.warnings.append(f"{path}: the packet header at byte {offset} is damaged; nothing after it was read")
            return
        packet = stream.read(captured)
        if len(packet) < captured:
            report.warnings.append(f"{path}: cut off at byte {offset + 16 + len(packet)}, in the packet at {offset}")
            return
        datagram = _datagram(packet, link_type, seconds * 1_000_000_000 + fraction * unit_ns, offset, fragments)
        offset += packet_header.size + captured
        report.done_bytes = offset
        if isinstance(datagram, Datagram):
            yield datagram
        elif datagram is not None:
            report.skipped["cut short by the capture's snapshot length" if captured < original else datagram] += 1


class _Fragments:
    """Puts fragmented IPv4 datagrams together again; fragments count as skipped until theirs is complete."""

    def __init__(self, skipped: Counter[str]) -> None:
        self._skipped = skipped
        self._parts: dict[bytes, dict[int, bytes]] = {}  # fragments by datagram and offset, the oldest datagram first
        self._bytes: dict[bytes, int] = {}  # of datagrams whose last fragment has come

    def add(self, header: bytes, data: bytes) -> bytes | None:
        """The content of the datagram that this fragment completes."""
        key, field = header[12:20] + header[4:6] + header[9:10], int.from_bytes(header[6:8], "big")
        at = 8 * (field & _FRAGMENT_OFFSET)
        if key not in self._parts and len(self._parts) == _INCOMPLETE:
            self._drop(next(iter(self._parts)))
        parts = self._parts.setdefault(key, {})
        self._skipped[_FRAGMENT] += at not in parts
        parts[at] = data
        if not field & _MORE_FRAGMENTS:
            self._bytes[key] = at + len(data)
        whole = b""
        for start in sorted(parts):
            if start != len(whole):
                return None
            whole += parts[start]
        if len(whole) != self._bytes.get(key):
            return None
        self._skipped[_FRAGMENT] -= len(parts)
        if not self._skipped[_FRAGMENT]:
            del self._skipped[_FRAGMENT]
        self._drop(key)
        return whole

    def _drop(self, key: bytes) -> None:
        del self._parts[key]
        self._bytes.pop(key, None)


def _datagram(packet: bytes, link_type: int, time_ns: int, offset: int, fragments: _Fragments) -> Datagram | str | None:
    """The UDP datagram that a packet contains or completes, why there is none, or None for a fragment."""
    start = _ipv4_start(packet, link_type)
    if start is None:
        return "not IPv4"
    if len(packet) < start + 20 or packet[start] >> 4 != 4:
        return "damaged IPv4 header"
    header_bytes = (packet[start] & 0x0F) * 4
    total, fragment = struct.unpack_from(">H2xH", packet, start + 2)
    if packet[start + 9] != _PROTOCOL_UDP:
        return "not UDP"
    content: bytes | None = packet[start + header_bytes : start + total]
    if fragment & (_MORE_FRAGMENTS | _FRAGMENT_OFFSET):
        if len(packet) < start + total or total <= header_bytes:
            return "damaged IPv4 fragment"
        content = fragments.add(packet[start : start + 20], content)
        if content is None:
            return None
    if len(content) < 8:
        return "damaged UDP header"
    port, length = struct.unpack_from(">HH", content, 2)
    if not 8 <= length <= len(content):
        return "damaged UDP header"
    sender = str(ipaddress.IPv4Address(packet[start + 12 : start + 16]))
    return Datagram(time_ns, sender, port, content[8:length], offset)


def _ipv4_start(packet: bytes, link_type: int) -> int | None:
    """Where the IPv4 header starts, or None when the packet carries something else."""
    if link_type in _RAW_ALIASES:
        return 0
    if link_type in (_NULL, _LOOP):  # address family, in the byte order of whoever wrote it
        return 4 if packet[:4] in (_AF_INET.to_bytes(4, "little"), _AF_INET.to_bytes(4, "big")) else None
    type_at, start = {_ETHERNET: (12, 14), _COOKED: (14, 16), _COOKED_2: (0, 20)}[link_type]
    ethertype = int.from_bytes(packet[type_at : type_at + 2], "big")
    while link_type == _ETHERNET and ethertype in _ETHERTYPE_VLAN:
        ethertype = int.from_bytes(packet[start + 2 : start + 4], "big")
        start += 4
    return start if ethertype == _ETHERTYPE_IPV4 else None
