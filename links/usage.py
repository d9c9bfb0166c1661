"""What a long run uses: memory, threads, open files and processor time, looked at now and then, for its summary.

A leak shows as growth from the middle to the end; caches and compiled code come in the first minute. The looks are
thinned out as the run goes on, so that an hour's are as many as a minute's.

Source: ours; proc(5), /proc/self/statm and /proc/self/fd.
"""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

EVERY_S, MOST = 1.0, 240  # at first; twice as far apart when there are so many
_STATM, _FDS = Path("/proc/self/statm"), Path("/proc/self/fd")


class Usage:
    """Looks when it is called, if it is time; columns of equal length by name."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._every_s = EVERY_S
        self._next_s = 0.0
        self.columns: dict[str, list[float]] = {name: [] for name in ("since_s", "rss_mb", "threads", "files", "cpu_s")}

    def look(self) -> None:
        """One more row when it is due; nothing on a system without /proc."""
        since_s = time.monotonic() - self._began_s
        if since_s < self._next_s or not _STATM.exists():
            return
        self._next_s = since_s + self._every_s
        pages = int(_STATM.read_text().split()[1])
        row = (
            round(since_s, 1),
            round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1),
            threading.active_count(),
            len(os.listdir(_FDS)) - 1,  # the listing opens one
            round(time.process_time(), 2),
        )
        for column, value in zip(self.columns.values(), row, strict=True):
            column.append(value)
        if len(self.columns["since_s"]) >= MOST:
            self._every_s *= 2
            self.columns = {name: column[::2] for name, column in self.columns.items()}

    def __str__(self) -> str:
        """Start, middle and end in a sentence; empty without looks."""
        times = self.columns["since_s"]
        if not times:
            return ""
        told: list[str] = []
        for at in dict.fromkeys((0, len(times) // 2, len(times) - 1)):
            since_s, rss_mb, threads, files, cpu_s = (column[at] for column in self.columns.values())
            told.append(
                f"at {since_s:.0f} s {rss_mb:.0f} MB, {threads:g} threads, {files:g} files, {cpu_s:.0f} s of CPU"
            )
        return "; ".join(told)
