"""grd with a stepped wall clock: python -m tests.links.stepped_clock FILE ARGUMENTS OF GRD...

FILE holds the seconds by which the wall clock and the kernel's stamps are ahead; it is read every POLL_S.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

POLL_S = 0.05
FILE = Path(sys.argv.pop(1))
true_ns = time.time_ns
ahead_ns = 0


def poll() -> None:
    global ahead_ns
    while True:
        text = FILE.read_text() if FILE.exists() else ""
        ahead_ns = round(1e9 * float(text)) if text else 0
        time.sleep(POLL_S)


time.time_ns = lambda: true_ns() + ahead_ns

from links.cli import main  # noqa: E402
from links.clock import datagram_time  # noqa: E402 (after the clock was replaced)

kernel_ns = datagram_time.kernel_time_ns


def stamped(ancillary):
    stamp_ns = kernel_ns(ancillary)
    return None if stamp_ns is None else stamp_ns + ahead_ns


datagram_time.kernel_time_ns = stamped

if __name__ == "__main__":
    threading.Thread(target=poll, daemon=True).start()
    main()
