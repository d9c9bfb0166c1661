"""Independent pieces of work in several processes: the results come in the order of the work, whoever did it.

An interrupt (Ctrl-C) reaches this process alone. It asks the others to stop, which they do where their work next tells
how far it is, and waits until they have. They end by themselves when this process is killed.

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

LOOK_S = 0.2  # between two looks at how far the others are

Task = TypeVar("Task")
Result = TypeVar("Result")
Work = Callable[[Task, Callable[[float], None]], Result]
Shares = Any  # done of each task, 0 to 1: a list, or an array that the processes share

_shared: tuple[Shares, Event]  # in a process that works for another one


class Stopped(Exception):
    """The work was asked to stop."""


def run_all(
    work: Work[Task, Result], tasks: Sequence[Task], jobs: int, progress: Callable[[Sequence[float]], None]
) -> list[Result]:
    """`work(task, tell)` for each task, in `jobs` processes of their own if that is more than one.

    `tell` takes the share of a task that is done, `progress` those of all. What `work` raises stops everything. With
    several processes `work` is a function of a module, and tasks and results can be pickled.
    """
    if jobs > 1 and len(tasks) > 1:
        return _in_processes(work, tasks, min(jobs, len(tasks)), progress)
    shares = [0.0] * len(tasks)

    def tell(index: int, share: float) -> None:
        shares[index] = share
        progress(shares)

    results: list[Result] = []
    for index, task in enumerate(tasks):
        results.append(work(task, lambda share, index=index: tell(index, share)))
        tell(index, 1.0)
    return results


def _in_processes(
    work: Work[Task, Result], tasks: Sequence[Task], jobs: int, progress: Callable[[Sequence[float]], None]
) -> list[Result]:
    context = multiprocessing.get_context("spawn")  # a fork would copy locks of threads that it does not copy
    shares, stop = context.RawArray("d", len(tasks)), context.Event()
    with ProcessPoolExecutor(jobs, context, _begin, (shares, stop)) as pool:
        try:
            with _interrupts_ignored():  # as the processes that start here will
                futures = [pool.submit(_work, work, index, task) for index, task in enumerate(tasks)]
            waiting: set[Future[Result]] = set(futures)
            while waiting:
                done, waiting = wait(waiting, LOOK_S, FIRST_COMPLETED)
                progress(shares)
                for future in done:
                    future.result()
            return [future.result() for future in futures]
        except BrokenProcessPool:
            raise LinkError(f"one of {jobs} processes was killed: if memory was short, take fewer --jobs") from None
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


def _begin(shares: Shares, stop: Event) -> None:
    """What a process does first."""
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

    def tell(share: float) -> None:
        shares[index] = share
        if stop.is_set():
            raise Stopped

    tell(0.0)
    result = work(task, tell)
    shares[index] = 1.0
    return result
