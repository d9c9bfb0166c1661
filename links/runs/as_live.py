"""A live run again from its recording, into a folder as every run's: the same steps, the same messages, the same hash.

Source: ours; flow/live/rerun.py.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

from flow.graph import Graph, load_graph
from flow.link import LinkError
from flow.live.input_order import END_TOPIC, ORDER_TOPIC, read_orders
from flow.live.rerun import Rerun
from flow.taps import Digest
from links.recording import Progress, Session
from links.runs.run_folder import Asked, Finished, RunFolder, truth_beside


@dataclass(frozen=True, slots=True)
class Repeated:
    """A repeated run, and how it compares with the live one."""

    finished: Finished
    same: bool
    verdict: str


def repeat_into(folder: Path, recording: Path, progress: Progress | None = None) -> Repeated:
    """Take a live run again, all its parts. Raises ConfigError, LinkError."""
    began_s = time.monotonic()
    session = Session(recording, whole=True)
    orders = read_orders(session.records([ORDER_TOPIC]))
    if not orders:
        raise LinkError(
            f"{recording} does not say in which order its stages worked (topic {ORDER_TOPIC}): it is no live run's"
            " recording. Replay it without --as-live"
        )
    graph, asked = _graph_of(session)
    warnings: list[str] = []
    for name, order in orders.items():
        if order.cut_off:
            warnings.append(f"{name}: a piece of its order is missing; it is repeated up to there")
    digest, truth, live_hash = Digest(), truth_beside(recording), None
    with RunFolder(folder, recording, asked, graph, began_s) as run:
        rerun = Rerun(graph, orders, (digest, *run.taps))
        for record in session.records(progress=progress):
            if record.topic == END_TOPIC:
                live_hash = _hash_of(record.data)
            rerun.feed(record)
        report = rerun.finish()
        warnings += [f"{name}: {n} messages of the live run are not there" for name, n in rerun.left.items()]
        warnings = [*session.warnings, *warnings]
        finished = run.finish(report, digest.hexdigest(), truth, warnings, parts=len(session.parts))
    if live_hash is None:
        return Repeated(finished, True, "the live run was not stopped in order, so its hash is not known")
    same = live_hash == finished.digest
    return Repeated(finished, same, f"the live run's hash was {'the same' if same else live_hash}")


def _graph_of(session: Session) -> tuple[Graph, Asked]:
    """The graph of the configuration that the recording carries."""
    text, recording = session.config_yaml, session.path
    if text is None:
        raise LinkError(f"{recording} carries no configuration: it is no live run's recording. Leave out --as-live")
    values = yaml.safe_load(text)
    if isinstance(values, dict) and "host" in values:
        raise LinkError(
            f"{recording} is what host '{values['host']}' recorded of a run on several hosts: --as-live repeats runs "
            "on one host only. What its own sensors gave can be replayed: name a configuration with --config instead"
        )
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "config.yaml")
        config.write_text(text, encoding="utf-8")
        return load_graph(config), Asked(config)


def _hash_of(data: bytes) -> str | None:
    try:
        return str(json.loads(data)["output_hash"])
    except (ValueError, TypeError, KeyError):
        return None
