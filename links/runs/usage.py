"""Memory, threads, open files and processor time of a live run, sampled for its summary.

A leak shows as growth from the middle to the end of the run; caches and compiled code grow in the first minute. The
sample period doubles when there are MAX_SAMPLES, so the number of samples is bounded. Memory and processor time include
the subprocesses of the stages.

Source: ours; proc(5), /proc/PID/statm, /proc/PID/stat and /proc/self/fd.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
from collections.abc import Iterable
from pathlib import Path

PERIOD_S, MAX_SAMPLES = 1.0, 240  # first period; it doubles when there are so many samples
_PROC = Path("/proc")
_FDS = _PROC / "self" / "fd"


class Usage:
    """Samples of the resources, as columns of equal length by name."""

    def __init__(self) -> None:
        self._started_s = time.monotonic()
        self._period_s = PERIOD_S
        self._next_s = 0.0
        self.subprocesses_cpu_s = 0.0
        """Processor time of the subprocesses at the newest sample."""
        self.columns: dict[str, list[float]] = {
            name: [] for name in ("elapsed_s", "rss_mb", "threads", "files", "cpu_s")
        }

    def sample(self, subprocesses: Iterable[int] = ()) -> None:
        """Add a row when it is due; `subprocesses` are process ids. No rows on a system without /proc."""
        elapsed_s = time.monotonic() - self._started_s
        if elapsed_s < self._next_s or not _FDS.exists():
            return
        self._next_s = elapsed_s + self._period_s
        used = [_used(pid) for pid in subprocesses]
        self.subprocesses_cpu_s = sum(cpu_s for _, cpu_s in used)
        row = (
            round(elapsed_s, 1),
            round(_used("self")[0] + sum(rss_mb for rss_mb, _ in used), 1),
            threading.active_count(),
            len(os.listdir(_FDS)) - 1,  # the listing itself opens one
            round(time.process_time() + self.subprocesses_cpu_s, 2),
        )
        for column, value in zip(self.columns.values(), row, strict=True):
            column.append(value)
        if len(self.columns["elapsed_s"]) >= MAX_SAMPLES:
            self._period_s *= 2
            self.columns = {name: column[::2] for name, column in self.columns.items()}

    def now(self, folder: Path) -> str:
        """`512 MB of memory, 130 % of a core, 41 GB free`: of the newest samples, and the disk of a folder."""
        texts: list[str] = []
        if times := self.columns["elapsed_s"]:
            texts.append(f"{self.columns['rss_mb'][-1]:.0f} MB of memory")
            if len(times) > 1:
                cpu_s = self.columns["cpu_s"][-1] - self.columns["cpu_s"][-2]
                texts.append(f"{100 * cpu_s / (times[-1] - times[-2]):.0f} % of a core")
        with contextlib.suppress(OSError):
            texts.append(f"{shutil.disk_usage(folder).free / 1e9:.0f} GB free")
        return ", ".join(texts)

    def __str__(self) -> str:
        """First, middle and last sample; empty without samples."""
        times = self.columns["elapsed_s"]
        if not times:
            return ""
        texts: list[str] = []
        for at in dict.fromkeys((0, len(times) // 2, len(times) - 1)):
            elapsed_s, rss_mb, threads, files, cpu_s = (column[at] for column in self.columns.values())
            texts.append(
                f"at {elapsed_s:.0f} s {rss_mb:.0f} MB, {threads:g} threads, {files:g} files, {cpu_s:.0f} s of CPU"
            )
        return "; ".join(texts)


def _used(pid: int | str) -> tuple[float, float]:
    """Memory [MB] and processor time [s] of a process; zeros when it has ended."""
    try:
        pages = int((_PROC / str(pid) / "statm").read_text().split()[1])
        ticks = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[11:13]  # utime and stime
    except (FileNotFoundError, ProcessLookupError):
        return 0.0, 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
