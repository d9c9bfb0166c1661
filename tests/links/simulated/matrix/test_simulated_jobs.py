"""Work in several processes: one outcome whoever did it, and an end when it is asked for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from flow.link import LinkError
from links.simulated.matrix.jobs import run_all

ROOT = Path(__file__).resolve().parents[4]
PATIENCE_S = 60.0

SLOW = """\
import os, signal, sys, time
from pathlib import Path
from links.simulated.matrix.jobs import run_all

def slow(name, tell):
    here = Path(sys.argv[1])
    (here / f"{name}.began").write_text(str(os.getpid()))
    try:
        while True:
            time.sleep(0.01)
            tell(0.5)
    finally:
        (here / f"{name}.ended").touch()

if __name__ == "__main__":
    # whoever started the tests may ignore it, as `sh -c "... &"` does, and children inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run_all(slow, ["a", "b", "c"], 2, lambda shares: None)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def square(number: int, tell: Callable[[float], None]) -> tuple[int, int]:
    """Who did it, and the square."""
    tell(0.5)
    time.sleep(0.01 * (5 - number))
    return os.getpid(), number**2


def refuse(number: int, tell: Callable[[float], None]) -> int:
    if number == 1:
        raise ValueError(f"no {number}")
    return number


def vanish(number: int, tell: Callable[[float], None]) -> int:
    os._exit(3)


def ignores_interrupts(number: int, tell: Callable[[float], None]) -> bool:
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def start(folder: Path) -> tuple[subprocess.Popen[str], list[int]]:
    """Three tasks without an end in two processes, both at work."""
    script = folder / "slow.py"
    script.write_text(SLOW, encoding="utf-8")
    words, env = [sys.executable, str(script), str(folder)], os.environ | {"PYTHONPATH": str(ROOT)}
    run = subprocess.Popen(words, env=env, start_new_session=True, stderr=subprocess.PIPE, text=True)
    patient(lambda: all((folder / f"{name}.began").is_file() for name in "ab"))
    patient(lambda: all((folder / f"{name}.began").read_text() for name in "ab"))
    return run, [int((folder / f"{name}.began").read_text()) for name in "ab"]


def patient(holds: Callable[[], bool]) -> None:
    """Wait until something holds."""
    until = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """Whether a process is there and no zombie that waits for being noticed."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_come_in_the_order_of_the_work_and_progress_reaches_its_end(jobs: int) -> None:
    told: list[list[float]] = []
    results = run_all(square, [1, 2, 3, 4], jobs, lambda shares: told.append(list(shares)))
    assert [number for _, number in results] == [1, 4, 9, 16]
    assert ({pid for pid, _ in results} == {os.getpid()}) == (jobs == 1)
    assert told[-1] == [1.0] * 4
    assert told == sorted(told)


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_the_work_raises_stops_everything_and_arrives(jobs: int) -> None:
    with pytest.raises(ValueError, match="no 1"):
        run_all(refuse, [0, 1, 2], jobs, lambda shares: None)


def test_a_process_that_was_killed_is_said_with_what_to_do() -> None:
    with pytest.raises(LinkError, match="was killed: if memory was short, take fewer --jobs"):
        run_all(vanish, [0, 1], 2, lambda shares: None)


def test_no_work_is_done_at_once() -> None:
    assert run_all(square, [], 4, lambda shares: None) == []


def test_an_interrupt_is_for_the_first_process_alone() -> None:
    """The others have ignored it since before their first line ran, so that none dies of it with a traceback."""
    before = signal.getsignal(signal.SIGINT)
    assert run_all(ignores_interrupts, [0, 1], 2, lambda shares: None) == [True, True]
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_ends_all_processes_in_order_without_a_traceback(tmp_path: Path) -> None:
    """As Ctrl-C in a terminal, to the whole group: each piece of work tidies up, what waits is not initial_estimate."""
    run, workers = start(tmp_path)
    os.killpg(run.pid, signal.SIGINT)
    _, said = run.communicate(timeout=PATIENCE_S)
    assert (run.returncode, said) == (130, "")
    assert all((tmp_path / f"{name}.ended").is_file() for name in "ab")
    assert not (tmp_path / "c.began").is_file()
    assert not any(is_running(pid) for pid in workers)


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs /proc to see processes")
def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    run, workers = start(tmp_path)
    run.kill()
    run.wait()
    try:
        patient(lambda: not any(is_running(pid) for pid in workers))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.communicate()
