"""Tasks in several processes: the same results as in one, and an orderly end on interrupt."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from flow.jobs import run_all
from flow.link import LinkError

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0

SLOW = """\
import os, signal, sys, time
from pathlib import Path
from flow.jobs import run_all

def slow(name, report):
    here = Path(sys.argv[1])
    (here / f"{name}.began").write_text(str(os.getpid()))
    try:
        while True:
            time.sleep(0.01)
            report(0.5)
    finally:
        (here / f"{name}.ended").touch()

if __name__ == "__main__":
    # the parent of the tests may ignore it, as `sh -c "... &"` does, and children inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run_all(slow, ["a", "b", "c"], 2, lambda shares: None)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def square(number: int, report: Callable[[float], None]) -> tuple[int, int]:
    """Process id, and the square."""
    report(0.5)
    time.sleep(0.01 * (5 - number))
    return os.getpid(), number**2


def refuse(number: int, report: Callable[[float], None]) -> int:
    if number == 1:
        raise ValueError(f"no {number}")
    return number


def vanish(number: int, report: Callable[[float], None]) -> int:
    os._exit(3)


def ignores_interrupts(number: int, report: Callable[[float], None]) -> bool:
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def start(folder: Path) -> tuple[subprocess.Popen[str], list[int]]:
    """Three endless tasks in two processes, both busy."""
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
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_are_in_the_order_of_the_tasks_and_progress_reaches_its_end(jobs: int) -> None:
    fractions: list[list[float]] = []
    results = run_all(square, [1, 2, 3, 4], jobs, lambda shares: fractions.append(list(shares)))
    assert [number for _, number in results] == [1, 4, 9, 16]
    assert ({pid for pid, _ in results} == {os.getpid()}) == (jobs == 1)
    assert fractions[-1] == [1.0] * 4
    assert fractions == sorted(fractions)


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_exception_of_a_task_stops_all_and_is_raised(jobs: int) -> None:
    with pytest.raises(ValueError, match="no 1"):
        run_all(refuse, [0, 1, 2], jobs, lambda shares: None)


def killed_once(folder: str, report: Callable[[float], None]) -> int:
    """Kills its own process the first time."""
    first = Path(folder) / "began"
    if not first.exists():
        first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def test_a_task_that_always_kills_its_worker_is_an_error_that_states_what_to_do() -> None:
    with pytest.raises(LinkError, match="too many workers were lost with the same task: if memory is short"):
        run_all(vanish, [0, 1], 2, lambda shares: None)


def test_a_task_of_a_lost_worker_runs_again(tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
    (folders[1] / "began").touch()  # is not killed
    assert len(run_all(killed_once, [str(folder) for folder in folders], 2, lambda shares: None)) == 2


def test_an_unknown_scheduler_is_an_error_that_states_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flow.jobs.CONNECT_S", 1)
    with pytest.raises(LinkError, match=r"no scheduler at tcp://127.0.0.1:9: .*start one: dask scheduler"):
        run_all(square, [1], "tcp://127.0.0.1:9", lambda shares: None)


@pytest.mark.filterwarnings("error")
def test_another_run_on_this_machine_is_no_warning() -> None:
    """The other one has the port that a dask scheduler asks for unless told otherwise."""
    with socket.socket() as other:
        with suppress(OSError):
            other.bind(("127.0.0.1", 8787))
            other.listen()
        assert [value for _, value in run_all(square, [0, 1], 2, lambda shares: None)] == [0, 1]


def test_no_tasks_give_no_results() -> None:
    assert run_all(square, [], 4, lambda shares: None) == []


def test_an_interrupt_reaches_the_parent_process_only() -> None:
    """The workers ignore it from their first line on, so that none ends with a traceback."""
    before = signal.getsignal(signal.SIGINT)
    assert run_all(ignores_interrupts, [0, 1], 2, lambda shares: None) == [True, True]
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_ends_all_processes_without_a_traceback(tmp_path: Path) -> None:
    """As Ctrl-C in a terminal, to the whole group: running tasks clean up, waiting ones do not start."""
    run, workers = start(tmp_path)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert (run.returncode, errors) == (130, "")
    assert all((tmp_path / f"{name}.ended").is_file() for name in "ab")
    assert not (tmp_path / "c.began").is_file()
    assert not any(is_running(pid) for pid in workers)


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs /proc to see processes")
def test_processes_end_with_their_parent(tmp_path: Path) -> None:
    run, workers = start(tmp_path)
    run.kill()
    run.wait()
    try:
        patient(lambda: not any(is_running(pid) for pid in workers))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.communicate()
