"""Samples of the resources of a run."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from links.runs import usage
from links.runs.usage import Usage

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(usage.time, "monotonic", lambda: now[0])

    def to(elapsed_s: float) -> None:
        now[0] = 100.0 + elapsed_s

    return to


def test_a_sample_is_taken_when_it_is_due_and_no_more_often(clock):
    used = Usage()
    for elapsed_s in (0.0, 0.4, 1.0, 1.5, 2.1):
        clock(elapsed_s)
        used.sample()
    assert used.columns["elapsed_s"] == [0.0, 1.0, 2.1]
    assert all(len(column) == 3 for column in used.columns.values())
    assert used.columns["rss_mb"][0] > 10
    assert used.columns["threads"][0] >= 1
    assert used.columns["files"][0] >= 3
    assert used.columns["cpu_s"] == sorted(used.columns["cpu_s"])


def test_an_hour_has_a_bounded_number_of_samples_and_keeps_its_start(clock):
    used = Usage()
    for elapsed_s in range(3600):
        clock(float(elapsed_s))
        used.sample()
    times = used.columns["elapsed_s"]
    assert usage.MAX_SAMPLES / 2 <= len(times) < usage.MAX_SAMPLES
    assert times[0] == 0.0
    assert times[-1] > 3550
    assert len(str(used).split(";")) == 3


def test_other_processes_count_while_they_run(clock):
    busy = "import sys\nheld = b'x' * 50_000_000\nwhile True: pass"
    child = subprocess.Popen([sys.executable, "-c", busy])
    used = Usage()
    try:
        while usage._used(child.pid)[1] < 0.3:
            time.sleep(0.02)
        used.sample([child.pid])
    finally:
        child.kill()
        child.wait()
    assert used.subprocesses_cpu_s >= 0.3
    clock(1.0)
    used.sample([child.pid])
    with_it, alone = used.columns["rss_mb"]
    assert alone < with_it - 45
    assert used.subprocesses_cpu_s == 0.0


def test_without_a_sample_there_is_no_report(clock):
    assert str(Usage()) == ""
