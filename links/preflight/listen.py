"""Hear what there is to hear: live for some seconds, or all of a recording. Both give the same `AllHeard`.

Source: ours; live by `flow.live`, recordings by `flow.replay`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from flow.config.draw import mermaid
from flow.graph import Graph
from flow.link import TRUTH_TOPICS, Run, Source
from flow.live import Live
from flow.live.report import LiveReport
from flow.replay import Replay
from links import host_time
from links.preflight.heard import KEPT, AllHeard, Ear, Heard
from links.recording import Progress, Session
from links.simulated import LiveRig


def listen_live(graph: Graph, meanwhile: Callable[[Ear], None]) -> AllHeard:
    """Run a graph live while `meanwhile` takes its time, then stop it and tell what came."""
    ear = Ear()
    live = Live(graph, (ear,), now_ns=host_time.now_ns)
    sources = {name: link for name, link in live.nodes.items() if isinstance(link, Source)}
    ear.attach(sources)
    live.start()
    try:
        meanwhile(ear)
        report, end_ns = live.report(), host_time.now_ns()
        statuses = {name: _status(name, link, report) for name, link in sources.items()}
        counters = {name: dict(link.counters) for name, link in sources.items()}
    finally:
        live.stop()
    heard = [
        Heard(name, link, ear.seen(name), counters[name], statuses[name], end_ns, live=True)
        for name, link in sources.items()
    ]
    return AllHeard(tuple(heard), {kind: ear.messages(kind) for kind in KEPT}, live=True)


def _status(name: str, link: Source, report: LiveReport) -> str | None:
    """What the link says itself, why it could not be opened, or what decoding raised."""
    if type(link).listen is Source.listen:
        return f"{type(link).__name__} cannot run live"
    told = report.links[name]
    if link.status is not None or told.state not in ("open", "closed"):
        return link.status or told.state
    raised = [event.text for event in report.events if event.node == name]
    return raised[-1] if told.undecoded and raised else None


def listen_to_recording(graph: Graph, session: Session, progress: Progress | None = None) -> AllHeard:
    """Feed a recording to a graph and tell what came. Raises RunError where a stage fails, LinkError."""
    ear = Ear()
    runner = Replay(graph, (ear,))
    sources = {name: node for name, node in runner.nodes.items() if isinstance(node, Source)}
    ear.attach(sources)
    for record in session.records(progress=progress):
        if not record.topic.startswith(TRUTH_TOPICS):
            ear.record(record)
            runner.feed(record)
    runner.finish()
    heard = [
        Heard(name, link, ear.seen(name), dict(link.counters), None, session.end_ns, live=False)
        for name, link in sources.items()
    ]
    return AllHeard(tuple(heard), {kind: ear.messages(kind) for kind in KEPT}, live=False)


@contextmanager
def simulated_rig(graph: Graph) -> Iterator[None]:
    """With the simulated rig, where the configuration has one, started as `grd run` does, but disarmed. LinkError."""
    with ExitStack() as stack:
        for spec in graph.nodes.values():
            if issubclass(spec.cls, LiveRig):
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="grd-preflight-")))
                rig = spec.build()
                assert isinstance(rig, LiveRig)
                rig = LiveRig(rig.settings.model_copy(update={"armed": False}))
                rig.open(Run(folder, spec.name, mermaid(graph), graph.settings_yaml(), live=True))
                stack.callback(rig.close)
        yield
