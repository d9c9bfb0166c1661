"""UDP datagrams of a classic libpcap capture (tcpdump, VeloView, `editcap -F pcap`).

Both byte orders, microseconds and nanoseconds; Ethernet (with VLAN tags), raw IP, Linux cooked v1 and v2, loopback.

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


@dataclass(frozen=True, slots=True)
class Datagram:
    """One UDP datagram as captured."""

    time_ns: int
    sender: str
    port: int  # destination
    payload: bytes
    offset: int  # of its packet header in the file


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
    packet_header = struct.Struct(order + "IIII")
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
        datagram = _datagram(packet, link_type, seconds * 1_000_000_000 + fraction * unit_ns, offset)
        offset += packet_header.size + captured
        report.done_bytes = offset
        if isinstance(datagram, Datagram):
            yield datagram
        else:
            report.skipped["cut short by the capture's snapshot length" if captured < original else datagram] += 1


def _datagram(packet: bytes, link_type: int, time_ns: int, offset: int) -> Datagram | str:
    """The UDP datagram in a packet, or why there is none."""
    start = _ipv4_start(packet, link_type)
    if start is None:
        return "not IPv4"
    if len(packet) < start + 20 or packet[start] >> 4 != 4:
        return "damaged IPv4 header"
    udp = start + (packet[start] & 0x0F) * 4
    total, fragment = struct.unpack_from(">H2xH", packet, start + 2)
    if fragment & 0x3FFF:  # more fragments follow, or this is not the first
        return "IPv4 fragment"
    if packet[start + 9] != _PROTOCOL_UDP:
        return "not UDP"
    if len(packet) < udp + 8:
        return "damaged UDP header"
    port, length = struct.unpack_from(">HH", packet, udp + 2)
    if length < 8 or udp + length > len(packet) or udp + length > start + total:
        return "damaged UDP header"
    sender = str(ipaddress.IPv4Address(packet[start + 12 : start + 16]))
    return Datagram(time_ns, sender, port, packet[udp + 8 : udp + length], offset)


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
