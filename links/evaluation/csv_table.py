"""The metrics of every run as one table, a line a run, for whatever reads CSV.

Source: ours. `inf` (or `-inf`, where more is better): the run failed it; empty: not evaluated, or nothing to measure.
"""

from __future__ import annotations

import csv
from pathlib import Path

from links.evaluation.catalogue import metric_of
from links.evaluation.compare import keys_of
from links.evaluation.judged import Evaluation

ABOUT = ("recording", "config", "output", "drone", "run", "no_drone", "span_s", "outputs")
TIMED = ("found_share", "found_when_seen_share", "hit_share", "seen_share")  # may be pooled
COUNTED = (  # and these
    *TIMED,
    "inside_95_share",
    "rotation_accepted_share",
    "rotation_inside_95_share",
)


def write_csv(path: Path, evaluations: list[Evaluation]) -> None:
    """Write the table. A share that can be pooled over runs has its counts in `KEY_count` and `KEY_of`.

    One of time has its seconds in `KEY_s` and `KEY_of_s`; its counts are of searches, which are not alike in length.
    """
    keys = keys_of(evaluations)
    counts = [f"{key}_{what}" for key in COUNTED for what in ("count", "of")]
    seconds = [f"{key}_{what}" for key in TIMED for what in ("s", "of_s")]
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream)
        table.writerow([*ABOUT, *keys, *counts, *seconds])
        for e in evaluations:
            span_s = "" if e.span_ns is None else (e.span_ns[1] - e.span_ns[0]) / 1e9
            about = [e.run.recording, e.run.config, e.output.name, e.run.drone, e.run.name]
            about += [int(e.run.no_drone), span_s, len(e.output.poses)]
            pooled = [cell for key in COUNTED for cell in e.counts.get(key, ("", ""))]
            timed = [cell for key in TIMED for cell in e.seconds.get(key, ("", ""))]
            table.writerow([*about, *(_cell(e, key) for key in keys), *pooled, *timed])


def _cell(e: Evaluation, key: str) -> str:
    value = e.values.get(key)
    rank = None if value is None else value.ranked(metric_of(key).better)
    return "" if rank is None else f"{rank:.9g}"
