"""Many runs in few rows: grouped by a word of the recording's name, as the scenario matrix names them.

`manhattan-20m-hover-parked-s1`: word 1 is the scene, 2 the range, 3 the motion, 4 the vehicle, 5 the seed.

Source: ours. Shares are over all runs of a group; one that gave nothing counts as never right.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from rich.table import Table
from rich.text import Text

from flow.link import LinkError
from links.evaluation.judged import Evaluation


@dataclass(frozen=True, slots=True)
class Group:
    """Runs that share a word, summed up."""

    name: str
    runs: int
    right_share: float | None  # mean time right [%] of the runs in which it could be judged
    ever_right: int
    silent: int  # runs without any output
    mostly_false: int  # runs in which more than half of the outputs are false
    missed_sweeps: int  # with 4 or more returns of the drone
    median_rmse_m: float | None  # of the outputs of the runs that were right at least once


def groups(evaluations: list[Evaluation], word: int) -> list[Group]:
    """One group for each value of the word, numbers in their order. LinkError when a name has no such word."""
    by_name: dict[str, list[Evaluation]] = {}
    for e in evaluations:
        words = e.run.recording.split("-")
        if not 1 <= word <= len(words):
            raise LinkError(f"--by {word}: '{e.run.recording}' has {len(words)} words, joined by '-'")
        by_name.setdefault(words[word - 1], []).append(e)
    return [_group(name, by_name[name]) for name in sorted(by_name, key=_natural)]


def group_table(found: list[Group], word: int) -> Table:
    """The groups as rows, and all runs together as the last."""
    table = Table(title=f"by word {word} of the recording's name", title_justify="left")
    heads = ["", "runs", "time right [%]", "ever right", "no output", "mostly false", "missed sweeps", "3D RMSE [m]"]
    for head in heads:
        table.add_column(Text(head), justify="right" if head else "left", no_wrap=not head)
    for group in found:
        right = "-" if group.right_share is None else f"{group.right_share:.1f}"
        rmse = "-" if group.median_rmse_m is None else f"{group.median_rmse_m:.2f}"
        counts = (group.ever_right, group.silent, group.mostly_false, group.missed_sweeps)
        table.add_row(Text(group.name), str(group.runs), right, *map(str, counts), rmse)
    return table


def _group(name: str, evaluations: list[Evaluation]) -> Group:
    right = [v for e in evaluations if (v := _number(e, "right_share")) is not None]
    was_right = [e for e in evaluations if (_number(e, "right_share") or 0.0) > 0.0]
    rmse = sorted(v for e in was_right if (v := _number(e, "rmse_m")) is not None)
    outputs = {id(e): len(e.output.poses.stamps_ns) for e in evaluations}
    return Group(
        name=name,
        runs=len(evaluations),
        right_share=sum(right) / len(right) if right else None,
        ever_right=len(was_right),
        silent=sum(count == 0 for count in outputs.values()),
        mostly_false=sum((_number(e, "false_outputs") or 0) > 0.5 * outputs[id(e)] for e in evaluations),
        missed_sweeps=sum(int(_number(e, "missed_sweeps") or 0) for e in evaluations),
        median_rmse_m=rmse[len(rmse) // 2] if rmse else None,
    )


def _number(e: Evaluation, key: str) -> float | None:
    return e.values[key].value if key in e.values else None


def _natural(text: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", text) if part]
