"""Live vehicle odometry: one JSON object per UDP datagram, from one sender.

    {"xyz_m": [x, y, z], "quaternion_xyzw": [x, y, z, w], "covariance": [36 numbers] or null, "age_s": 0.004}

`age_s`: age of the pose at the time of sending; 0 when it is missing. A pose older than one second is skipped and
counted. The other fields are those of the recording format.

Source: recording format in recordings/README.md (/vehicle/odometry).
"""

from __future__ import annotations

import json
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from flow.link import LinkError, Record
from links.clock import datagram_time

DATAGRAM_BYTES = 4096
WAKE_S = 0.2  # how often a waiting listener checks whether it was closed
MAX_AGE_S = 1.0
WRONG_AGE = "age_s invalid or too large"  # counter


@contextmanager
def listen_udp(
    topic: str, bind: str, port: int, sender: str | None, counters: Counter[str], what: str = "the vehicle's odometry"
) -> Iterator[Iterator[Record]]:
    """Open the socket and yield an iterator of records, which ends with the context. LinkError: it cannot be opened.

    `what`: is received, for errors.
    """
    closed = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        try:
            datagram_time.enable_stamps(udp)
            udp.bind((bind, port))
        except OSError as error:
            raise LinkError(
                f"cannot listen on UDP {bind}:{port} for {what}: {error.strerror}. Check `bind` and `port`; "
                "is another grd listening there?"
            ) from error
        udp.settimeout(WAKE_S)
        try:
            yield _records(udp, closed, topic, sender, counters, what)
        finally:
            closed.set()


def _records(
    udp: socket.socket, closed: threading.Event, topic: str, sender: str | None, counters: Counter[str], what: str
) -> Iterator[Record]:
    while not closed.is_set():
        try:
            data, ancillary, _, (host, _) = udp.recvmsg(DATAGRAM_BYTES, datagram_time.ANCILLARY_BYTES)
        except TimeoutError:
            continue
        except OSError as error:
            if closed.is_set():
                return
            raise LinkError(f"{what}: {error.strerror}: is the network interface still up?") from error
        arrival_ns = datagram_time.arrival_ns(ancillary)
        if sender is not None and host != sender:
            counters["from other senders"] += 1
            continue
        age = age_s(data)
        if age is None:
            counters[WRONG_AGE] += 1
            continue
        yield Record(topic, arrival_ns, arrival_ns - round(1e9 * age), data)


def age_s(data: bytes) -> float | None:
    """`age_s` of a datagram, 0 without it; None: invalid or above MAX_AGE_S."""
    try:
        fields: Any = json.loads(data)
        age = float(fields.get("age_s", 0.0))
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        return 0.0 if b"age_s" not in data else None  # `decode` rejects invalid JSON
    return age if 0.0 <= age <= MAX_AGE_S else None
