"""A live run: start, monitoring until the stop signal, stop, and output folder.

The output folder has the files of a replay and the recording. `flow.live` runs the graph, `links.recording.Recorder`
records it.

Source: ours.
"""

from __future__ import annotations

import gc
import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from flow.graph import Graph
from flow.link import LinkError, Source, Tap
from flow.live import Live
from flow.live.report import LiveReport
from flow.taps import Digest
from links.clock import host_time
from links.recording import Recorder
from links.runs.request import RunRequest, RunResult
from links.runs.run_folder import RunFolder
from links.runs.usage import Usage

POLL_S = 0.1
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True, slots=True)
class RunStatus:
    """Status of a live run, passed to its display some times a second."""

    elapsed_s: float
    report: Callable[[], LiveReport]  # on demand: it takes some milliseconds of every thread
    new_events: list[str]
    used: str = ""  # memory, processor, disk


ShowStatus = Callable[[RunStatus], None]


def live_graph(request: RunRequest) -> Graph:
    """The graph of a configuration that can run live. Raises ConfigError, LinkError."""
    graph = request.graph()
    if not any(issubclass(spec.cls, Source) and spec.cls.listen is not Source.listen for spec in graph.nodes.values()):
        raise LinkError(f"{request.config}: no link of this configuration can run live")
    return graph


def run_live(
    folder: Path,
    request: RunRequest,
    graph: Graph,
    show: ShowStatus,
    for_s: float | None = None,
    extra: tuple[Tap, ...] = (),
    *,
    hashed: bool = False,
) -> RunResult:
    """Run live until SIGINT, SIGTERM, `for_s` seconds, or a stage that stops it. Raises LinkError.

    `graph` is `live_graph(request)`. `extra` taps are added to those of the configuration. `hashed`: compute the output
    hash. Call it from the main thread only.
    """
    started_s = time.monotonic()
    digest = Digest() if hashed else None
    recorder = next((spec for spec in graph.nodes.values() if issubclass(spec.cls, Recorder)), None)
    recording = folder / (str(recorder.config.get("file", "flight.mcap")) if recorder else "not recorded")
    with RunFolder(folder, recording, request, graph, started_s, live=True) as run, stop_signals() as stop:
        live = Live(graph, (*run.taps, *extra), digest=digest, now_ns=host_time.now_ns)
        if recorder is None:
            live.events.report("run", "no links.recording.Recorder is configured: nothing is recorded")
        gc.collect()
        gc.freeze()  # objects that exist now are not scanned again: shorter pauses
        live.start()
        live_since_s, usage = time.monotonic(), Usage()
        try:
            while not stop.wait(POLL_S) and (for_s is None or time.monotonic() < live_since_s + for_s):
                _show(live, live_since_s, show, run, usage.now(folder))
                usage.sample(live.processes)
        finally:
            report = live.stop()
        _show(live, live_since_s, show, run)
        gc.unfreeze()
        return run.finish(report, None if digest is None else digest.hexdigest(), None, [], usage)


def _show(live: Live, live_since_s: float, show: ShowStatus, run: RunFolder, used: str = "") -> None:
    new_events = live.events.fetch()
    for text in new_events:
        run.note(text)
    try:
        show(RunStatus(time.monotonic() - live_since_s, live.report, new_events, used))
    except (OSError, SystemExit) as error:  # the output is full or closed; rich exits on a broken pipe
        reason = error if isinstance(error, OSError) else "the pipe is closed"
        live.events.report("run", f"cannot write to the terminal ({reason}); the run continues, see run.log")


@contextmanager
def stop_signals() -> Generator[threading.Event]:
    """An event that SIGINT and SIGTERM set; a second signal has its previous effect.

    SIGHUP is ignored: a terminal that hangs up, as an SSH connection that is lost, ends no flight.
    """
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        del frame
        stopped.set()
        signal.signal(number, before[number])

    before = {int(number): signal.signal(number, stop) for number in STOP_SIGNALS}
    before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # workers inherit it
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
