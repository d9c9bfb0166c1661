"""A live run from its configuration to its folder: started, watched until it shall stop, ended, summed up.

The folder is what a replay leaves, and the recording. `flow.live` does the work, `links.recording.Recorder` records.

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
from links import host_time
from links.recording import Recorder
from links.runs.run_folder import Asked, Finished, RunFolder
from links.runs.usage import Usage

LOOK_S = 0.1
STOPPING = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True, slots=True)
class Look:
    """What one who watches a run is shown, some times a second."""

    since_s: float
    report: Callable[[], LiveReport]  # made when asked for: it costs some milliseconds of every thread
    news: list[str]  # events not told before


Show = Callable[[Look], None]


def live_graph(asked: Asked) -> Graph:
    """The graph of a configuration that can run live. Raises ConfigError, LinkError."""
    graph = asked.graph(None, "")
    if not any(issubclass(spec.cls, Source) and spec.cls.listen is not Source.listen for spec in graph.nodes.values()):
        raise LinkError(f"{asked.config}: no link of it can listen, so there is nothing to run live")
    return graph


def run_live(
    folder: Path, asked: Asked, graph: Graph, show: Show, for_s: float | None = None, extra: tuple[Tap, ...] = ()
) -> Finished:
    """Run live until SIGINT, SIGTERM, `for_s` seconds, or a stage that stops it. Raises LinkError.

    `graph` is `live_graph(asked)`. `extra` taps see every message beside those that the configuration declares. From
    the main thread only.
    """
    began_s = time.monotonic()
    digest = Digest()
    recorder = next((spec for spec in graph.nodes.values() if issubclass(spec.cls, Recorder)), None)
    recording = folder / (str(recorder.config.get("file", "flight.mcap")) if recorder else "not recorded")
    with RunFolder(folder, recording, asked, graph, began_s, live=True) as run, stop_asked() as stop:
        live = Live(graph, (*run.taps, *extra), digest=digest, now_ns=host_time.now_ns)
        if recorder is None:
            live.events.report("run", "no links.recording.Recorder is configured: nothing is recorded")
        gc.collect()
        gc.freeze()  # what is there now stays: the collector has less to look through, and pauses are short
        live.start()
        started_s, usage = time.monotonic(), Usage()
        try:
            while not stop.wait(LOOK_S) and (for_s is None or time.monotonic() < started_s + for_s):
                _show(live, started_s, show, run)
                usage.look(live.processes)
        finally:
            report = live.stop()
        _show(live, started_s, show, run)
        gc.unfreeze()
        return run.finish(report, digest.hexdigest(), None, [], usage)


def _show(live: Live, started_s: float, show: Show, run: RunFolder) -> None:
    news = live.events.fetch()
    for text in news:
        run.note(text)
    try:
        show(Look(time.monotonic() - started_s, live.report, news))
    except (OSError, SystemExit) as error:  # where it is shown is full or gone; rich ends on a broken pipe
        why = error if isinstance(error, OSError) else "the pipe is closed"
        live.events.report("run", f"cannot be shown on the terminal ({why}); the run goes on, run.log has it")


@contextmanager
def stop_asked() -> Generator[threading.Event]:
    """An event that SIGINT and SIGTERM set; the second time they do what they did before."""
    asked = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        del frame
        asked.set()
        signal.signal(number, before[number])

    before = {int(number): signal.signal(number, stop) for number in STOPPING}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
