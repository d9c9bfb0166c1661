"""Replays of several recordings on workers, each into a folder of its own.

A folder that holds a complete run of the same recording and settings is kept, so an interrupted command can be
repeated. A recording that fails does not stop the others.

Source: ours.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from flow.config_error import ConfigError
from flow.jobs import Workers, run_all
from flow.link import LinkError
from flow.ports import RunError
from links.recording import Session
from links.runs.request import RunRequest
from links.runs.results import SUMMARY_FILE
from links.runs.run_folder import holds_run, replay_into


@dataclass(frozen=True)
class ReplayTask:
    """One recording to replay."""

    recording: Path
    folder: Path
    request: RunRequest
    hashed: bool


@dataclass(frozen=True)
class ReplayOutcome:
    """What became of a recording: the folder of its run, or why it has none."""

    recording: Path
    folder: Path
    output_hash: str | None = None
    kept: bool = False  # the run was there
    failure: str = ""

    def __str__(self) -> str:
        if self.failure:
            return f"{self.recording}: {self.failure}"
        return f"{self.folder}: {'kept' if self.kept else 'made'}, output hash {self.output_hash or 'not computed'}"


def replay_all(
    recordings: Sequence[Path],
    request: RunRequest,
    out_dir: Path,
    workers: Workers,
    progress: Callable[[float, float], None],
    *,
    hashed: bool = True,
) -> list[ReplayOutcome]:
    """Replay into `out_dir/<recording>-<configuration>`. LinkError: two recordings have one name."""
    twice = [name for name, count in Counter(path.stem for path in recordings).items() if count > 1]
    if twice:
        raise LinkError(f"several recordings are named {twice[0]}: their runs would share a folder; give each --out")
    tasks = [ReplayTask(path, out_dir / f"{path.stem}-{request.config.stem}", request, hashed) for path in recordings]
    return run_all(replay_one, tasks, workers, lambda shares: progress(sum(shares), len(tasks)))


def replay_one(task: ReplayTask, report: Callable[[float], None]) -> ReplayOutcome:
    """Replay one recording, unless its folder holds the run."""
    try:
        graph = task.request.graph(Session(task.recording).rig_yaml, f"{task.recording} (rig.yaml)")
        if holds_run(task.folder, task.recording, graph):
            summary = json.loads((task.folder / SUMMARY_FILE).read_text(encoding="utf-8"))
            if summary["output_hash"] is not None or not task.hashed:
                return ReplayOutcome(task.recording, task.folder, summary["output_hash"], kept=True)
        result = replay_into(
            task.folder, task.recording, task.request, lambda done, whole: report(done / whole), hashed=task.hashed
        )
    except (LinkError, ConfigError, RunError, OSError) as error:
        return ReplayOutcome(task.recording, task.folder, failure=str(error))
    return ReplayOutcome(task.recording, task.folder, result.output_hash)
