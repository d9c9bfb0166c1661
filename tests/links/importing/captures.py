"""Builds pcap files packet by packet: the bytes of a capture, without a capture library."""

import struct

NS = 1_000_000_000


def udp(payload: bytes, port: int = 2368, sender: tuple[int, int, int, int] = (192, 168, 1, 201)) -> bytes:
    """An IPv4 packet with one UDP datagram in it (RFC 791, RFC 768; checksums zero)."""
    datagram = struct.pack(">HHHH", 2368, port, 8 + len(payload), 0) + payload
    return ipv4(datagram, sender=sender)


def ipv4(
    content: bytes,
    *,
    protocol: int = 17,
    fragment: int = 0,
    number: int = 1,
    options: bytes = b"",
    sender: tuple[int, int, int, int] = (192, 168, 1, 201),
) -> bytes:
    """An IPv4 packet."""
    words = 5 + len(options) // 4
    head = struct.pack(">BBHHHBBH", 0x40 | words, 0, 4 * words + len(content), number, fragment, 64, protocol, 0)
    return head + bytes(sender) + bytes([255] * 4) + options + content


def fragments(payload: bytes, number: int, most: int = 1480) -> list[bytes]:
    """The Ethernet frames of a UDP datagram that is larger than a packet, in order; `number`: its identification."""
    datagram = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload
    starts = range(0, len(datagram), most)
    more = [0x2000 * (start + most < len(datagram)) for start in starts]
    return [
        ethernet(ipv4(datagram[start : start + most], fragment=start // 8 | flag, number=number))
        for start, flag in zip(starts, more, strict=True)
    ]


def ethernet(packet: bytes, ethertype: int = 0x0800, vlans: tuple[int, ...] = ()) -> bytes:
    """An Ethernet frame, with VLAN tags."""
    tags = b"".join(struct.pack(">HH", tag, 5) for tag in vlans)
    return bytes(12) + tags + struct.pack(">H", ethertype) + packet


def pcap(frames: list[bytes], *, order: str = "<", nanoseconds: bool = False, link_type: int = 1) -> bytes:
    """A capture of frames at intervals of 1.326001 ms."""
    unit_ns = 1 if nanoseconds else 1000
    out = [struct.pack(order + "IHHiIII", 0xA1B23C4D if nanoseconds else 0xA1B2C3D4, 2, 4, 0, 0, 65535, link_type)]
    for frame, time_ns in zip(frames, times_ns(len(frames), unit_ns), strict=True):
        fraction = time_ns % NS // unit_ns
        out += [struct.pack(order + "IIII", time_ns // NS, fraction, len(frame), len(frame)), frame]
    return b"".join(out)


def times_ns(count: int, unit_ns: int) -> list[int]:
    """The arrival times of `pcap`'s frames, at the resolution of the file."""
    return [(1_700_000_000 * NS + 1_326_001 * i) // unit_ns * unit_ns for i in range(count)]
