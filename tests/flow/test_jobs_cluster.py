"""Flights on a dask scheduler with two workers, one of which is killed: the results of one process.

python -m pytest -m slow -n 0 tests/flow/test_jobs_cluster.py     about 2 min
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
ADDRESS = "tcp://127.0.0.1:18786"


@pytest.fixture
def workers() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Two workers of a scheduler on this machine."""
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "18786"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", ADDRESS, "--nthreads", "1", "--no-nanny"]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": env}
    scheduler = subprocess.Popen([*dask, "--no-dashboard"], **quiet)
    started = [subprocess.Popen([*worker, "--no-dashboard"], **quiet) for _ in range(2)]
    yield started
    for process in (*started, scheduler):
        process.kill()
        process.wait()


def fly(folder: Path, *options: str) -> subprocess.Popen[str]:
    scenarios = [f"configs/scenarios/flight/matrix/{name}.yaml" for name in ("hover", "square")]
    words = ["flights", *scenarios, "--closed-loop", "configs/sim_flight_fixes.yaml", "--set", "duration_s=12"]
    command = [sys.executable, "-c", "from links.cli import main; main()", *words, "-o", str(folder), "--seeds", "2"]
    return subprocess.Popen([*command, *options], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def outcomes(folder: Path) -> dict[str, dict]:
    return {file.name: json.loads(file.read_text()) for file in folder.glob("*.json")}


def test_flights_on_two_workers_of_which_one_is_killed_are_those_of_one_process(workers, tmp_path: Path) -> None:
    alone = fly(tmp_path / "alone")
    assert alone.wait(600) in (0, 1), alone.stdout.read()
    assert len(outcomes(tmp_path / "alone")) == 4
    several = fly(tmp_path / "several", "--scheduler", ADDRESS)
    until = time.monotonic() + 300
    while not outcomes(tmp_path / "several"):  # both are at work
        assert time.monotonic() < until
        assert several.poll() is None, several.stdout.read()
        time.sleep(0.1)
    workers[0].send_signal(signal.SIGKILL)
    assert several.wait(600) == alone.returncode, several.stdout.read()
    assert outcomes(tmp_path / "several") == outcomes(tmp_path / "alone")
    assert not list((tmp_path / "several").glob("*.part"))


def test_results_are_written_once_and_kept(tmp_path: Path) -> None:
    first = fly(tmp_path)
    first.wait(600)
    stamps = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*.json")}
    again = fly(tmp_path, "--jobs", "2")
    again.wait(600)
    assert {file: file.stat().st_mtime_ns for file in tmp_path.glob("*.json")} == stamps
