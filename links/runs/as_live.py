"""Re-runs a live run from its recording: the same order of inputs, the same messages, the same output hash.

A recording may be somebody else's, so its configuration is data: it names classes of grd only and no other file, and of
its taps only the viewer runs, into the folder of the re-run. Sources decode records and open nothing, sinks are not
called. `trusted` lifts these limits, for a configuration with stages or taps of one's own.

Source: ours; flow/live/rerun.py.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.graph import Graph
from flow.link import LinkError, Tap
from flow.live.input_order import END_TOPIC, ORDER_TOPIC, read_orders
from flow.live.rerun import Rerun
from flow.taps import Digest
from links.recording import Progress, Session
from links.runs.request import RunRequest, RunResult
from links.runs.run_folder import RunFolder, read_truth_file

PACKAGES = ("stages", "links")  # whose classes the configuration of a recording may name
SECTIONS = ("rig", "stages", "links")
MAX_NODES = 200


@dataclass(frozen=True, slots=True)
class RerunResult:
    """A re-run and its comparison with the live run."""

    result: RunResult
    same_hash: bool  # also when the hash of the live run is not known
    comparison: str  # for people


def rerun_into(
    folder: Path, recording: Path, progress: Progress | None = None, *, trusted: bool = False
) -> RerunResult:
    """Re-run a live run, all parts of its recording. Raises ConfigError, LinkError.

    `trusted`: the configuration in the recording is the user's own.
    """
    started_s = time.monotonic()
    session = Session(recording, whole=True)
    orders = read_orders(session.records([ORDER_TOPIC]))
    if not orders:
        raise LinkError(
            f"{recording} has no order of inputs (topic {ORDER_TOPIC}): it is not the recording of a live"
            " run. Replay it without --as-live"
        )
    graph, request = _graph_of(session, trusted)
    warnings: list[str] = []
    for name, order in orders.items():
        if order.cut_off:
            warnings.append(f"{name}: part of its input order is missing; the re-run ends there")
    digest, truth, end = Digest(), read_truth_file(recording), None
    with RunFolder(folder, recording, request, graph, started_s) as run:
        rerun = Rerun(graph, orders, (digest, *run.taps))
        for record in session.records(progress=progress):
            if record.topic == END_TOPIC:
                end = record.data
            rerun.feed(record)
        report = rerun.finish()
        warnings += [f"{name}: {n} messages of the live run are missing" for name, n in rerun.left.items()]
        warnings = [*session.warnings, *warnings]
        result = run.finish(report, digest.hexdigest(), truth, warnings, parts=len(session.parts))
    if end is None:
        return RerunResult(result, True, "the live run was interrupted, so its hash is not known")
    live_hash = _hash_of(end)
    if live_hash is None:
        return RerunResult(result, True, "the live run computed no hash to compare: record it with grd run --hash")
    if not live_hash:
        return RerunResult(result, True, f"the record of the live run's hash is damaged ({END_TOPIC}): not compared")
    same_hash = live_hash == result.output_hash
    return RerunResult(result, same_hash, f"the live run's hash is {'the same' if same_hash else live_hash}")


def _graph_of(session: Session, trusted: bool) -> tuple[Graph, RunRequest]:
    """The graph of the configuration in the recording, and the request for it."""
    text, recording = session.config_yaml, session.path
    if text is None:
        raise LinkError(f"{recording} has no configuration: it is not the recording of a live run. Leave out --as-live")
    try:
        values = yaml_values(text)
    except YamlTextError as error:
        raise LinkError(f"{recording} (config.yaml): {error}") from None
    if not isinstance(values, dict):
        raise LinkError(f"{recording} (config.yaml): must be a mapping")
    if "host" in values:
        raise LinkError(
            f"{recording} was recorded on host '{values['host']}' of a run on several hosts: --as-live needs a run on "
            "one host. To replay the sensors of this host, name a configuration with --config"
        )
    if not trusted:
        _limit(values, recording)
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "config.yaml")
        config.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
        graph = RunRequest(config).graph(packages=None if trusted else PACKAGES)
    if not trusted:
        from links.viewer import Viewer  # imports Rerun

        taps = {name for name, spec in graph.nodes.items() if issubclass(spec.cls, Tap) and spec.cls is not Viewer}
        graph = graph.restricted_to(graph.nodes.keys() - taps)
    return graph, RunRequest(config)


def _limit(values: dict[str, Any], recording: Path) -> None:
    """Raise LinkError for a configuration that a recording must not have; switch off the server of its viewers."""
    if unknown := [key for key in values if key not in SECTIONS]:
        raise LinkError(f"{recording} (config.yaml): '{unknown[0]}' is not read from a recording")
    links, stages = values.get("links"), values.get("stages")
    if sum(len(nodes) for nodes in (links, stages) if isinstance(nodes, dict)) > MAX_NODES:
        raise LinkError(f"{recording} (config.yaml): more than {MAX_NODES} stages and links")
    for link in links.values() if isinstance(links, dict) else ():
        config = link.get("config") if isinstance(link, dict) else None
        if isinstance(config, dict) and "serve" in config:
            config["serve"] = False


def _hash_of(data: bytes) -> str | None:
    """The live run's hash; None: not computed; empty: the record is damaged."""
    try:
        output_hash = json.loads(data)["output_hash"]
        return None if output_hash is None else str(output_hash)
    except (ValueError, TypeError, KeyError):
        return ""
