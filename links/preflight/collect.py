"""Fill `Observations` from live hardware over some seconds, or from a whole recording.

The graph runs as in `grd run` (`flow.live`) or `grd replay` (`flow.replay`) with one more tap.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from flow.config.draw import mermaid
from flow.counters import Counters
from flow.graph import Graph
from flow.link import TRUTH_TOPICS, Record, Run, Source, Tap
from flow.live import Live
from flow.live.report import LinkState, LiveReport
from flow.message import Message
from flow.replay import Replay
from links.clock import host_time
from links.preflight.devices import checks_for
from links.preflight.observations import Observation, Observations, ObservedSource
from links.recording import Progress, Session
from links.simulated import LiveRig
from stages import messages

KEPT: tuple[type[Message], ...] = (
    messages.AutopilotEstimator,
    messages.AutopilotStatus,
    messages.DroneAttitude,
    messages.DroneFix,
    messages.DroneImu,
    messages.DroneLocalPosition,
    messages.DroneOdometry,
    messages.VehicleMotion,
)
MAX_MESSAGES = 20_000  # kept per type, the newest

M = TypeVar("M", bound=Message)


class ObservationTap(Tap):
    """Collects every record and the messages of the types in KEPT. Called from many threads, per topic from one."""

    def __init__(self) -> None:
        super().__init__()
        self._by_topic: dict[str, Observation] = {}
        self._topics: dict[str, str] = {}  # of the sources, by name
        self._messages: defaultdict[type[Message], deque[Message]] = defaultdict(lambda: deque(maxlen=MAX_MESSAGES))

    def attach(self, sources: Mapping[str, Source]) -> None:
        """Set the sources whose records will arrive, by node name."""
        self._by_topic = {}
        for source in sources.values():
            observation = checks_for(source).observation(source)
            self._by_topic |= dict.fromkeys(source.replay_topics, observation)
        self._topics = {name: source.topic for name, source in sources.items()}

    def wants(self, message: type[Message]) -> bool:
        """See Tap."""
        return message in KEPT

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """See Tap."""
        if type(message) in KEPT:
            self._messages[type(message)].append(message)

    def record(self, record: Record) -> None:
        """See Tap. A side topic such as /lidar/position goes to the source whose topic has the same first name."""
        observation = self._by_topic.get(record.topic)
        if observation is None:
            parent = record.topic.rpartition("/")[0] + "/"
            observation = next(
                (o for topic, o in self._by_topic.items() if topic.startswith(parent) and parent != "/"), None
            )
        if observation is not None:
            observation.add(record)

    @property
    def every_source_has_sent(self) -> bool:
        """Whether every source has sent at least one record."""
        return all(self._by_topic[topic].records.count for topic in self._topics.values())

    def observation(self, name: str) -> Observation:
        """The records of the source of that name."""
        return self._by_topic[self._topics[name]]

    def messages(self, kind: type[M]) -> list[M]:
        """The newest messages of a type, oldest first."""
        return cast("list[M]", list(self._messages[kind]))


def collect_live(graph: Graph, meanwhile: Callable[[ObservationTap], None]) -> Observations:
    """Run a graph live for as long as `meanwhile` takes, then stop it."""
    tap = ObservationTap()
    live = Live(graph, (tap,), now_ns=host_time.now_ns)
    sources = {name: link for name, link in live.nodes.items() if isinstance(link, Source)}
    tap.attach(sources)
    live.start()
    try:
        meanwhile(tap)
        report, end_ns = live.report(), host_time.now_ns()
        statuses = {name: _status(name, link, report) for name, link in sources.items()}
        counters = {name: Counters.of(link.counters) for name, link in sources.items()}
    finally:
        live.stop()
    observed = [
        ObservedSource(name, link, tap.observation(name), counters[name], statuses[name], end_ns, live=True)
        for name, link in sources.items()
    ]
    return _observations(graph, observed, tap, live=True)


def _status(name: str, link: Source, report: LiveReport) -> str | None:
    """The link's own status, or why it could not be opened, or what decoding raised."""
    if type(link).listen is Source.listen:
        return f"{type(link).__name__} cannot run live"
    reported = report.links[name]
    if link.status is not None or reported.state not in (LinkState.OPEN, LinkState.CLOSED):
        return link.status or reported.state_text
    raised = [event.text for event in report.events if event.node == name]
    return raised[-1] if reported.undecoded and raised else None


def collect_recording(graph: Graph, session: Session, progress: Progress | None = None) -> Observations:
    """Replay a recording through a graph. Raises RunError where a stage fails, LinkError."""
    tap = ObservationTap()
    runner = Replay(graph, (tap,))
    sources = {name: node for name, node in runner.nodes.items() if isinstance(node, Source)}
    tap.attach(sources)
    for record in session.records(progress=progress):
        if not record.topic.startswith(TRUTH_TOPICS):
            tap.record(record)
            runner.feed(record)
    runner.finish()
    observed = [
        ObservedSource(name, link, tap.observation(name), Counters.of(link.counters), None, session.end_ns, live=False)
        for name, link in sources.items()
    ]
    return _observations(graph, observed, tap, live=False)


def _observations(graph: Graph, sources: list[ObservedSource], tap: ObservationTap, live: bool) -> Observations:
    rig: dict[str, Any] = graph.values.get("rig") or {}
    return Observations(tuple(sources), {kind: tap.messages(kind) for kind in KEPT}, live, rig)


@contextmanager
def simulated_rig(graph: Graph) -> Iterator[None]:
    """Run the simulated rig of the configuration, if it has one, as `grd run` does, but disarmed. LinkError."""
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
