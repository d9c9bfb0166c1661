"""Runs independent tasks on workers; the results are in the order of the tasks.

Workers are processes of this machine, or those of a dask scheduler at an address, which see the same files at the same
paths. A task whose worker is lost runs again on another one, so a task must be repeatable. An interrupt (Ctrl-C)
reaches the parent process only. It asks the tasks to stop, which they do at their next progress report, and waits for
them. Processes of this machine end by themselves when the parent is killed.

Source: https://distributed.dask.org/en/stable/resilience.html (tasks of a lost worker), api.html (Client, Event).
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import time
import uuid
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from flow.link import LinkError

POLL_S = 0.2  # period of progress reports
REPORT_S = 0.5  # least time between two reports of a task
CONNECT_S = 10
LOST_WORKERS = 2  # on this machine a task is given up when it has lost more

Task = TypeVar("Task")
Result = TypeVar("Result")
Work = Callable[[Task, Callable[[float], None]], Result]
Workers = int | str  # number of processes on this machine, or the address of a scheduler


class Stopped(Exception):
    """The task was asked to stop."""


def run_all(
    work: Work[Task, Result], tasks: Sequence[Task], workers: Workers, progress: Callable[[Sequence[float]], None]
) -> list[Result]:
    """`work(task, report)` for each task, on workers unless one process of this machine is enough.

    `report` takes the completed fraction of a task, `progress` those of all tasks. An exception in `work` stops
    everything. On workers `work` must be a function of a module, and tasks and results picklable.
    """
    if isinstance(workers, str) or (workers > 1 and len(tasks) > 1):
        return _on_workers(work, tasks, workers, progress)
    shares = [0.0] * len(tasks)

    def report(index: int, share: float) -> None:
        shares[index] = share
        progress(shares)

    results: list[Result] = []
    for index, task in enumerate(tasks):
        results.append(work(task, lambda share, index=index: report(index, share)))
        report(index, 1.0)
    return results


def _on_workers(
    work: Work[Task, Result], tasks: Sequence[Task], workers: Workers, progress: Callable[[Sequence[float]], None]
) -> list[Result]:
    try:
        import distributed
    except ModuleNotFoundError:
        raise LinkError("several processes need dask, not installed: pip install -e '.[cluster]'") from None

    shares, run = [0.0] * len(tasks), uuid.uuid4().hex

    def on_report(event: tuple[float, tuple[int, float]]) -> None:
        index, share = event[1]
        shares[index] = max(shares[index], share)

    with ExitStack() as stack:
        client = stack.enter_context(_client(workers, len(tasks)))
        stop: Any = distributed.Event(f"stop-{run}", client=client)
        client.subscribe_topic(run, on_report)
        futures = [
            client.submit(_work, work, index, task, run, os.getcwd(), key=f"{run}-{index}", pure=False)
            for index, task in enumerate(tasks)
        ]
        try:
            waiting = set(futures)
            while waiting:
                time.sleep(POLL_S)
                for future in [future for future in waiting if future.done()]:
                    waiting.remove(future)
                    future.result()
                    shares[futures.index(future)] = 1.0
                progress(shares)
            return [future.result() for future in futures]
        except distributed.KilledWorker:
            raise LinkError("too many workers were lost with the same task: if memory is short, use fewer") from None
        finally:
            stop.set()
            client.cancel([future for future in futures if not future.done()], force=False)
            _wait_for_running(client, run)


def _wait_for_running(client: Any, run: str) -> None:
    """Wait until no worker executes a task of the run: each stops at its next report."""
    while any(key.startswith(run) for keys in client.processing().values() for key in map(str, keys)):
        time.sleep(POLL_S)


@contextmanager
def _client(workers: Workers, tasks: int) -> Generator[Any, None, None]:
    """A client of a scheduler: of one at an address, or of one with processes of this machine."""
    import distributed
    from dask import config  # pyright: ignore[reportPrivateImportUsage]

    if isinstance(workers, str):
        try:
            client = distributed.Client(workers, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise LinkError(f"no scheduler at {workers}: {error}; start one: dask scheduler --host ADDRESS") from None
        with client:
            yield client
        return
    settings = {"distributed.scheduler.allowed-failures": LOST_WORKERS}
    with config.set(settings), ExitStack() as stack:
        with _interrupts_ignored():  # inherited by the processes that start here
            cluster = distributed.LocalCluster(
                n_workers=min(workers, tasks),
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",  # of its HTTP server, on a free port
                scheduler_kwargs={"dashboard": False},
                memory_limit=0,  # no limit
                silence_logs=logging.CRITICAL,
            )
        stack.enter_context(cluster)
        yield stack.enter_context(distributed.Client(cluster, set_as_default=False))


@contextmanager
def _interrupts_ignored() -> Generator[None, None, None]:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _work(work: Work[Task, Result], index: int, task: Task, run: str, folder: str) -> Result:
    """Do a task in a worker, in the working directory of the caller."""
    import distributed

    worker, reported_s = distributed.get_worker(), 0.0
    stop: Any = distributed.Event(f"stop-{run}")

    def report(share: float) -> None:
        nonlocal reported_s
        if time.monotonic() - reported_s < REPORT_S:
            return
        reported_s = time.monotonic()
        worker.log_event(run, (index, share))
        if stop.is_set():
            raise Stopped

    with contextlib.chdir(folder):
        report(0.0)
        return work(task, report)
