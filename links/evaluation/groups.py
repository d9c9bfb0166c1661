"""Many runs in few rows: grouped by words of the recording's name, as the matrix names them, and by configuration.

`manhattan-20m-hover-parked-s1`: word 1 is the scene, 2 the range, 3 the motion, 4 the vehicle, 5 the seed.

Source: ours. Counts and shares are over all runs of a group, those of searches by their time (searches.py); one that
failed counts as infinite in a median and a 95 % point, a maximum is over those that did not fail, and how many did
stands beside it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

from flow.link import LinkError
from links.evaluation.compare import by_config, median
from links.evaluation.judged import Evaluation, minutes

CONFIG, ALL = "config", "all"
Key = tuple[int, ...]  # words of the recording's name that a table is grouped by; none: all runs are one group

Amount = TypeVar("Amount", int, float)


@dataclass(frozen=True, slots=True)
class Spread:
    """A number of every run, where it could be measured."""

    values: tuple[float, ...]  # rising; inf where the run failed

    @property
    def succeeded(self) -> tuple[float, ...]:
        """Without the failures."""
        return tuple(v for v in self.values if math.isfinite(v))

    @property
    def median(self) -> float | None:
        """inf when half of the runs failed."""
        return median(list(self.values))

    @property
    def p95(self) -> float | None:
        """The smallest value that 95 % do not exceed."""
        return self.values[math.ceil(0.95 * len(self.values) - 1e-9) - 1] if self.values else None

    @property
    def largest(self) -> float | None:
        """Of the runs that succeeded."""
        return max(self.succeeded, default=None)


@dataclass(frozen=True, slots=True)
class Group:
    """Runs of one configuration that share words of their recordings' names, summed up. Shares are in percent."""

    words: tuple[str, ...]
    config: str
    runs: int
    right_share: float | None  # mean over the runs
    ever_right: int
    silent: int  # runs without any output
    mostly_false: int  # runs in which more than half of the outputs are false, whatever sigma they state
    hit: tuple[float, float]  # seconds of searches with a return of the drone, of all
    seen: tuple[float, float]  # of searches with 4 or more returns of the drone, of all
    found: tuple[float, float]  # of searches in which the best candidate was the drone, of all
    found_when_seen: tuple[float, float]  # of searches in which a candidate was, of those with 4 or more returns
    first_right_s: Spread
    shortest_failed_s: float | None  # length of the shortest run that never was right
    hit_gap_s: Spread
    reacquired_s: Spread  # one value for each time the drone came back in sight
    lost: int | None  # times lost though in sight
    rmse_m: Spread  # of the outputs of the runs that were right at least once
    inside_95: tuple[int, int]  # outputs whose 95 % ellipsoid holds the truth
    false_per_h: float | None
    sure_false_per_h: float | None  # of those, beyond three of their own sigmas
    good_share: float | None  # time with a pose good enough for the autopilot, mean over the runs
    good_max_m: float | None  # largest errors of such poses
    good_max_deg: float | None


def parse_by(text: str) -> Key:
    """`2`, `2,3`, `config`, `2,config` -> the words. Configurations stand side by side in any case."""
    words: list[int] = []
    for part in map(str.strip, text.split(",")):
        if part.isdecimal() and int(part) > 0:
            words.append(int(part))
        elif part != CONFIG:
            raise LinkError(f"--by {text}: a word's number from 1 on, several as in 2,3, or '{CONFIG}' is wanted")
    return tuple(words)


def groups(evaluations: Sequence[Evaluation], key: Key) -> list[Group]:
    """The groups of `grouped`, summed up."""
    return [_group(*group) for group in grouped(evaluations, key)]


def grouped(evaluations: Sequence[Evaluation], key: Key) -> list[tuple[tuple[str, ...], str, list[Evaluation]]]:
    """(words, configuration, runs) for each combination of the words and of configurations; all runs together last.

    Numbers stand in their order, configurations as they were given. LinkError when a name has no such word.
    """
    configs = list(by_config(list(evaluations)))
    cells: dict[tuple[str, ...], list[Evaluation]] = {}
    for e in evaluations:
        words = e.run.recording.split("-")
        if max(key, default=0) > len(words):
            raise LinkError(f"--by {max(key)}: '{e.run.recording}' has {len(words)} words, joined by '-'")
        cells.setdefault(tuple(words[word - 1] for word in key), []).append(e)
    rows = [(words, cells[words]) for words in sorted(cells, key=lambda words: [_natural(word) for word in words])]
    if key:
        rows.append(((ALL, *[""] * (len(key) - 1)), list(evaluations)))
    return [
        (words, config, own)
        for words, several in rows
        for config in configs
        if (own := [e for e in several if e.run.config == config])
    ]


def _group(words: tuple[str, ...], config: str, evaluations: list[Evaluation]) -> Group:
    right = [v for e in evaluations if (v := _number(e, "right_share")) is not None]
    good = [v for e in evaluations if (v := _number(e, "good_share")) is not None]
    was_right = [e for e in evaluations if (_number(e, "right_share") or 0.0) > 0.0]
    lost = [v for e in evaluations if (v := _number(e, "lost_count")) is not None]
    failed = [e.span_ns for e in evaluations if "first_right_s" in e.values and e.values["first_right_s"].failed]
    lengths_s = [60 * minutes(span) for span in failed if span is not None]
    return Group(
        words=words,
        config=config,
        runs=len(evaluations),
        right_share=sum(right) / len(right) if right else None,
        ever_right=len(was_right),
        silent=sum(len(e.output.poses) == 0 for e in evaluations),
        mostly_false=sum((_number(e, "false_outputs") or 0) > 0.5 * len(e.output.poses) for e in evaluations),
        hit=pooled((e.seconds for e in evaluations), "hit_share"),
        seen=pooled((e.seconds for e in evaluations), "seen_share"),
        found=pooled((e.seconds for e in evaluations), "found_share"),
        found_when_seen=pooled((e.seconds for e in evaluations), "found_when_seen_share"),
        first_right_s=spread(evaluations, "first_right_s"),
        shortest_failed_s=min(lengths_s, default=None),
        hit_gap_s=spread(evaluations, "longest_hit_gap_s"),
        reacquired_s=Spread(tuple(sorted(t for e in evaluations for t in e.reappeared_s))),
        lost=int(sum(lost)) if lost else None,
        rmse_m=spread(was_right, "rmse_m"),
        inside_95=pooled((e.counts for e in evaluations), "inside_95_share"),
        false_per_h=_per_h(evaluations, "false_outputs"),
        sure_false_per_h=_per_h(evaluations, "sure_false_outputs"),
        good_share=sum(good) / len(good) if good else None,
        good_max_m=spread(evaluations, "good_max_m").largest,
        good_max_deg=spread(evaluations, "good_max_deg").largest,
    )


def _per_h(evaluations: list[Evaluation], key: str) -> float | None:
    counted = [(v, e.span_ns) for e in evaluations if (v := _number(e, key)) is not None and e.span_ns]
    hours = sum(minutes(span) for _, span in counted) / 60
    return sum(count for count, _ in counted) / hours if counted else None


def spread(evaluations: list[Evaluation], key: str) -> Spread:
    """A metric of which less is better, over the runs that could be measured."""
    ranks = [value.ranked("low") for e in evaluations if (value := e.values.get(key)) is not None]
    return Spread(tuple(sorted(rank for rank in ranks if rank is not None)))


def pooled(shares: Iterable[Mapping[str, tuple[Amount, Amount]]], key: str) -> tuple[Amount, Amount]:
    """Of a share that each run keeps as counts or seconds: (how many, of how many) over all runs."""
    told = [share[key] for share in shares if key in share]
    return cast(tuple[Amount, Amount], (sum(some for some, _ in told), sum(of for _, of in told)))


def _number(e: Evaluation, key: str) -> float | None:
    return e.values[key].value if key in e.values else None


def _natural(text: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", text) if part]
