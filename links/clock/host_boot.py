"""The boot of this host: a time that two processes share, however the wall clock is set between them.

Host time is anchored to the wall clock once per process (`host_time.py`). A host without a battery boots with a wrong
time, and GPS or NTP sets it later: two processes then have anchors that differ by hours. The time since the boot does
not depend on the wall clock.

Source: ours; proc(5), /proc/sys/kernel/random/boot_id; clock_gettime(2), CLOCK_BOOTTIME.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class HostBoot:
    """One boot of this host."""

    id: str
    at_ns: int  # when it was, on the host time of the process that asks


def host_boot(now_ns: int, boot_id: Path = BOOT_ID) -> HostBoot | None:
    """The host's boot, at this host time; None where the system does not tell it."""
    try:
        return HostBoot(
            boot_id.read_text(encoding="ascii").strip(), now_ns - time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        )
    except (OSError, AttributeError):  # no Linux
        return None


def on_own_clock(other_ns: int, other: HostBoot | None, own: HostBoot | None) -> int:
    """Host time of this process for one of an earlier process, by the boots that each had.

    Of an earlier boot only the wall clock of then is known, and that it was before this boot.
    """
    if other is None or own is None:
        return other_ns
    return other_ns - other.at_ns + own.at_ns if other.id == own.id else min(other_ns, own.at_ns)
