"""grd with a wall clock that somebody sets: python -m tests.links.stepped_clock FILE ARGUMENTS OF GRD...

The wall clock, and what the kernel stamps with it, is ahead by as many seconds as stand in FILE, looked at often.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

LOOK_S = 0.05
FILE = Path(sys.argv.pop(1))
really_ns = time.time_ns
ahead_ns = 0


def look() -> None:
    global ahead_ns
    while True:
        text = FILE.read_text() if FILE.exists() else ""
        ahead_ns = round(1e9 * float(text)) if text else 0
        time.sleep(LOOK_S)


time.time_ns = lambda: really_ns() + ahead_ns

from links.cli import main  # noqa: E402
from links.clock import datagram_time  # noqa: E402 (after the clock is ours)

kernel_ns = datagram_time.kernel_time_ns


def stamped(ancillary):
    stamp_ns = kernel_ns(ancillary)
    return None if stamp_ns is None else stamp_ns + ahead_ns


datagram_time.kernel_time_ns = stamped

if __name__ == "__main__":
    threading.Thread(target=look, daemon=True).start()
    main()
