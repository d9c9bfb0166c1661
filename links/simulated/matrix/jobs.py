"""Runs independent tasks in several processes; the results are in the order of the tasks.

An interrupt (Ctrl-C) reaches the parent process only. It asks the others to stop, which they do at their next progress
report, and waits for them. They end by themselves when the parent is killed.

Source: ours.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from typing import Any, TypeVar

from flow.link import LinkError

POLL_S = 0.2  # period of progress reports

Task = TypeVar("Task")
Result = TypeVar("Result")
Work = Callable[[Task, Callable[[float], None]], Result]
Shares = Any  # completed fraction of each task: a list, or an array in shared memory

_shared: tuple[Shares, Event]  # in a worker process


class Stopped(Exception):
    """The task was asked to stop."""


def run_all(
    work: Work[Task, Result], tasks: Sequence[Task], jobs: int, progress: Callable[[Sequence[float]], None]
) -> list[Result]:
    """`work(task, report)` for each task, in `jobs` processes of their own if that is more than one.

    `report` takes the completed fraction of a task, `progress` those of all tasks. An exception in `work` stops
    everything. With several processes `work` must be a function of a module, and tasks and results picklable.
    """
    if jobs > 1 and len(tasks) > 1:
        return _in_processes(work, tasks, min(jobs, len(tasks)), progress)
    shares = [0.0] * len(tasks)

    def report(index: int, share: float) -> None:
        shares[index] = share
        progress(shares)

    results: list[Result] = []
    for index, task in enumerate(tasks):
        results.append(work(task, lambda share, index=index: report(index, share)))
        report(index, 1.0)
    return results


def _in_processes(
    work: Work[Task, Result], tasks: Sequence[Task], jobs: int, progress: Callable[[Sequence[float]], None]
) -> list[Result]:
    context = multiprocessing.get_context("spawn")  # fork would copy locks without the threads that hold them
    shares, stop = context.RawArray("d", len(tasks)), context.Event()
    with ProcessPoolExecutor(jobs, context, _initialise, (shares, stop)) as pool:
        try:
            with _interrupts_ignored():  # inherited by the processes that start here
                futures = [pool.submit(_work, work, index, task) for index, task in enumerate(tasks)]
            waiting: set[Future[Result]] = set(futures)
            while waiting:
                done, waiting = wait(waiting, POLL_S, FIRST_COMPLETED)
                progress(shares)
                for future in done:
                    future.result()
            return [future.result() for future in futures]
        except BrokenProcessPool:
            raise LinkError(f"one of {jobs} processes was killed: if memory is short, use fewer --jobs") from None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _initialise(shares: Shares, stop: Event) -> None:
    """Initialise a worker process."""
    global _shared
    _shared = shares, stop
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(work: Work[Task, Result], index: int, task: Task) -> Result:
    shares, stop = _shared

    def report(share: float) -> None:
        shares[index] = share
        if stop.is_set():
            raise Stopped

    report(0.0)
    result = work(task, report)
    shares[index] = 1.0
    return result
