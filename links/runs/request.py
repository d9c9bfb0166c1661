"""What a run is made of (`RunRequest`) and what it leaves (`RunResult`).

Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flow.graph import Graph, load_graph
from flow.replay import RunReport
from links.runs.fused_poses import FULL, FusedPoses
from links.runs.results import Results
from links.runs.truth import FixErrors
from links.runs.usage import Usage


@dataclass(frozen=True, slots=True)
class RunRequest:
    """A configuration: a file, overlay files, and changed settings (`NAME.SETTING=VALUE`)."""

    config: Path
    overlays: tuple[Path, ...] = ()
    sets: tuple[str, ...] = ()

    def graph(self, rig_yaml: str | None, where: str) -> Graph:
        """The graph on the rig `rig_yaml`, read from `where`, or (None) on the rig of the configuration.

        Raises ConfigError for both.
        """
        sections = None if rig_yaml is None else {"rig": (rig_yaml, where)}
        return load_graph(self.config, self.overlays, self.sets, sections)


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
