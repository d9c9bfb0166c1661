"""What a run is made of (`RunRequest`) and what it leaves (`RunResult`).

Source: ours.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flow.config.tree import load_tree
from flow.config_error import ConfigError, ErrorDetail, Location
from flow.graph import Graph, load_graph
from flow.link import LinkError
from flow.replay import RunReport
from links.mavlink import Autopilot
from links.recording import Session
from links.runs.fused_poses import FULL, FusedPoses
from links.runs.results import Results
from links.runs.shipped import CONFIGS
from links.runs.truth import FixErrors
from links.runs.usage import Usage
from stages.geometry.rig import Rig

NO_RIG = "{}"


@dataclass(frozen=True, slots=True)
class RunRequest:
    """A configuration: a file, overlay files, and changed settings (`NAME.SETTING=VALUE`)."""

    config: Path
    overlays: tuple[Path, ...] = ()
    sets: tuple[str, ...] = ()

    def graph(self, rig_yaml: str | None = None, where: str = "", packages: Collection[str] | None = None) -> Graph:
        """The graph on the rig `rig_yaml`, read from `where`, or (None) on the rig of the configuration.

        `packages`: as in `load_graph`. Raises ConfigError for both, and for a pose that would be sent to another
        drone's autopilot.
        """
        sections = None if rig_yaml is None else {"rig": (rig_yaml, where)}
        graph = load_graph(self.config, self.overlays, self.sets, sections, packages=packages, rig=Rig)
        if errors := _poses_of_other_drones(graph, str(self.config)):
            raise ConfigError(errors)
        return graph

    def graph_on(self, session: Session) -> Graph:
        """The graph on the rig of a recording, in place of that of the configuration. LinkError: there is none."""
        rig_yaml = session.rig_yaml
        if rig_yaml is None and "rig" in load_tree(self.config).values:
            rig_yaml = NO_RIG
            if not self.rig_on(session):
                text = f"{session.path} has no rig: give that of its vehicle with --overlay"
                raise LinkError("; ".join([text, *session.warnings]))
        return self.graph(rig_yaml, f"{session.path} (rig.yaml)")

    def rig_on(self, session: Session) -> dict[str, Any]:
        """The rig of a recording with the overlays; empty: neither has one."""
        sections = {"rig": (session.rig_yaml or NO_RIG, f"{session.path} (rig.yaml)")}
        rig = load_tree(self.config, self.overlays, self.sets, sections).values.get("rig")
        return rig if isinstance(rig, dict) else {}


def fitting_request(recording: Path, overlays: tuple[Path, ...] = (), sets: tuple[str, ...] = ()) -> RunRequest:
    """grd's own pipeline for a recording: the one with cameras where the rig has them."""
    request = RunRequest(CONFIGS / "estimate.yaml", overlays, sets)
    try:
        has_cameras = bool(request.rig_on(Session(recording)).get("cameras"))
    except LinkError:  # a replay reports it
        return request
    return RunRequest(CONFIGS / "vision.yaml", overlays, sets) if has_cameras else request


@dataclass(frozen=True, slots=True)
class RunResult:
    """A run that has ended."""

    recording: Path
    out_dir: Path
    report: RunReport
    results: Results
    errors: FixErrors | None  # of the LiDAR positions; None: the truth is not known
    poses: FusedPoses | None  # None: no stage fuses, no position, or files cut off
    output_hash: str | None  # None: not computed
    wall_s: float
    warnings: list[str]
    usage: Usage | None = None  # of a live run
    parts: int | None = None  # of the recording that a replay read
    stage_outputs: str = ""  # stages and message counts, when no stage of the configuration searches for a drone

    @property
    def counted_full(self) -> bool:
        """Whether a stage published a pose with a rotation, also when a full disk has cut the pose files off."""
        return any(self.results.pose_states.get(state) for state in FULL)


def _poses_of_other_drones(graph: Graph, file: str) -> list[ErrorDetail]:
    """An error for each autopilot whose pose depends on another autopilot that gets poses."""
    sent = {edge.consumer: edge for edge in graph.edges if issubclass(graph.nodes[edge.consumer].cls, Autopilot)}
    errors: list[ErrorDetail] = []
    for autopilot, pose in sent.items():
        for other in sorted(graph.feeding(pose.producer) & sent.keys() - {autopilot}):
            inputs = [e for e in graph.edges if e.consumer == pose.producer]
            ports = ", ".join(e.port for e in inputs if other in graph.feeding(e.producer))
            text = f"'{pose.producer}' depends on '{other}', the autopilot of another drone, by its inputs {ports}: "
            text += "copy the stages that give them as well (`nodes` of the include), or set these inputs to null."
            errors.append(ErrorDetail(Location(file, 0), f"links.{autopilot}.inputs.{pose.port}", text))
    return errors
