"""What a long run uses: memory, threads, open files and processor time, looked at now and then, for its summary.

A leak shows as growth from the middle to the end; caches and compiled code come in the first minute. The looks are
thinned out as the run goes on, so that an hour's are as many as a minute's. Memory and processor time are those of the
processes in which stages work, too.

Source: ours; proc(5), /proc/PID/statm, /proc/PID/stat and /proc/self/fd.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path

EVERY_S, MOST = 1.0, 240  # at first; twice as far apart when there are so many
_PROC = Path("/proc")
_FDS = _PROC / "self" / "fd"


class Usage:
    """Looks when it is called, if it is time; columns of equal length by name."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._every_s = EVERY_S
        self._next_s = 0.0
        self.others_cpu_s = 0.0
        """Of the newest look."""
        self.columns: dict[str, list[float]] = {name: [] for name in ("since_s", "rss_mb", "threads", "files", "cpu_s")}

    def look(self, others: Iterable[int] = ()) -> None:
        """One more row when it is due, with the processes `others`; nothing on a system without /proc."""
        since_s = time.monotonic() - self._began_s
        if since_s < self._next_s or not _FDS.exists():
            return
        self._next_s = since_s + self._every_s
        used = [_used(pid) for pid in others]
        self.others_cpu_s = sum(cpu_s for _, cpu_s in used)
        row = (
            round(since_s, 1),
            round(_used("self")[0] + sum(rss_mb for rss_mb, _ in used), 1),
            threading.active_count(),
            len(os.listdir(_FDS)) - 1,  # the listing opens one
            round(time.process_time() + self.others_cpu_s, 2),
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


def _used(pid: int | str) -> tuple[float, float]:
    """A process' memory [MB] and processor time [s]; nothing of one that has just ended."""
    try:
        pages = int((_PROC / str(pid) / "statm").read_text().split()[1])
        ticks = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[11:13]  # utime and stime
    except (FileNotFoundError, ProcessLookupError):
        return 0.0, 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
