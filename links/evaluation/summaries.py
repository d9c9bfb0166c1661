"""Groups and drone-free runs as tables of text, for the terminal and the report.

Source: ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from rich.table import Table
from rich.text import Text

from links.evaluation.catalogue import CAMERAS
from links.evaluation.groups import CONFIG, Group, Key
from links.evaluation.no_drone import Alarms
from links.evaluation.probabilities import Reliability
from links.evaluation.rotation_groups import RotationGroup

HOW = (
    "ever, mute, false: runs that were right at least once, said nothing, were mostly false. hit, seen: share of the "
    "time searched, over all runs, in sweeps with a return of the drone, with 4 or more; found: by the best candidate; "
    "found/seen: of the time of those seen, by any. back: found again after it was hidden; lost: in sight. 3D RMSE: of "
    "the runs that were right at least once. Medians and 95 % count a failure as infinite ('never', or longer than the "
    "shortest run that failed); maxima are over what did not fail. false [/h]: outputs farther than 1 m from the "
    "drone, whatever sigma they state; sure: by more than three of their own sigmas, too. sent: poses good enough for "
    "the autopilot, by its gate: share of the time, and their largest errors. Of several drones each counts as a run."
)
NOTHING = "-"
ROTATION_HOW = (
    f"{CAMERAS}: over all rotations of a group. given: the branch that was told; modulo: the nearest of its four, "
    "quarter turns about the world's vertical, as are roll, pitch, yaw, the 95 % bound and NEES / 3 (honest: 1). "
    "wrong: RESOLVED and more than 45 deg off. resolved: runs with a first RESOLVED that is right. first, ground: time "
    "and the drone's way to it, relative to the vehicle and over ground, medians over runs."
)
RELIABILITY_HOW = (
    "what may be a drone: each thing counts once in a row, at the first look at it after which that was said; "
    "it was a drone when it was within 1 m of one then; 95 %: the interval in which the share lies."
)
Column = tuple[str, Callable[[Group], str]]
AnyGroup = TypeVar("AnyGroup", Group, RotationGroup)


@dataclass(frozen=True, slots=True)
class Summary:
    """A table in words."""

    title: str
    heads: list[str]
    rows: list[list[str]]
    named: int  # columns at the left that name the row
    note: str = ""

    def table(self) -> Table:
        """For the terminal."""
        table = Table(title=self.title, title_justify="left")
        for index, head in enumerate(self.heads):
            table.add_column(Text(head), justify="left" if index < self.named else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(Text(cell) for cell in row))
        return table


COLUMNS: tuple[Column, ...] = (
    ("runs", lambda g: str(g.runs)),
    ("right\n[%]", lambda g: _digits(g.right_share, 1)),
    ("ever", lambda g: str(g.ever_right)),
    ("mute", lambda g: str(g.silent)),
    ("false", lambda g: str(g.mostly_false)),
    ("hit\n[%]", lambda g: _percent(g.hit)),
    ("seen\n[%]", lambda g: _percent(g.seen)),
    ("found\n[%]", lambda g: _percent(g.found)),
    ("found/\nseen [%]", lambda g: _percent(g.found_when_seen)),
    ("first\nmedian [s]", lambda g: _digits(g.first_right_s.median, 1, g.shortest_failed_s)),
    ("first\n95 % [s]", lambda g: _digits(g.first_right_s.p95, 1, g.shortest_failed_s)),
    ("hit gap\nmedian [s]", lambda g: _digits(g.hit_gap_s.median, 2)),
    ("hit gap\nmax [s]", lambda g: _digits(g.hit_gap_s.largest, 2)),
    ("back", lambda g: _of(len(g.reacquired_s.succeeded), len(g.reacquired_s.values))),
    ("back\nmedian [s]", lambda g: _digits(g.reacquired_s.median, 2)),
    ("back\nmax [s]", lambda g: _digits(g.reacquired_s.largest, 2)),
    ("lost", lambda g: NOTHING if g.lost is None else str(g.lost)),
    ("3D RMSE\nmedian [m]", lambda g: _digits(g.rmse_m.median, 3)),
    ("in 95 %\n[%]", lambda g: _percent(g.inside_95)),
    ("false\n[/h]", lambda g: _digits(g.false_per_h, 0)),
    ("sure\n[/h]", lambda g: _digits(g.sure_false_per_h, 0)),
    ("sent\n[%]", lambda g: _digits(g.good_share, 1)),
    ("sent:\nmax [m]", lambda g: _digits(g.good_max_m, 2)),
    ("sent:\nmax [deg]", lambda g: _digits(g.good_max_deg, 1)),
)

ROTATION_COLUMNS: tuple[tuple[str, Callable[[RotationGroup], str]], ...] = (
    ("runs", lambda g: str(g.runs)),
    ("pictures", lambda g: str(g.accepted[1])),
    ("accepted\n[%]", lambda g: _percent(g.accepted)),
    ("given\nRMSE [deg]", lambda g: _digits(g.given.rmse, 2)),
    ("modulo\nRMSE [deg]", lambda g: _digits(g.modulo.rmse, 2)),
    ("modulo\nmedian", lambda g: _digits(g.modulo.median, 2)),
    ("modulo\n95 %", lambda g: _digits(g.modulo.p95, 2)),
    ("roll\nRMSE", lambda g: _digits(g.modulo.rmse_rpy[0], 2)),
    ("pitch\nRMSE", lambda g: _digits(g.modulo.rmse_rpy[1], 2)),
    ("yaw\nRMSE", lambda g: _digits(g.modulo.rmse_rpy[2], 2)),
    ("in 95 %\n[%]", lambda g: _percent(g.inside_95)),
    ("NEES\n/ 3", lambda g: _digits(g.nees_of_1, 2)),
    ("RESOLVED", lambda g: str(g.resolved)),
    ("wrong", lambda g: NOTHING if g.wrong_resolved is None else str(g.wrong_resolved)),
    ("resolved", lambda g: _of(len(g.resolved_s.succeeded), len(g.resolved_s.values))),
    ("first\n[s]", lambda g: _digits(g.resolved_s.median, 1)),
    ("first\n[m]", lambda g: _digits(g.resolved_m.median, 2)),
    ("ground\n[m]", lambda g: _digits(g.resolved_ground_m.median, 2)),
    ("switches", lambda g: str(g.switches)),
)


def group_summary(found: list[Group], key: Key) -> Summary:
    """Groups down, numbers across; the configuration is a column when there are several or nothing else names a row."""
    return _by_group("", found, key, COLUMNS, HOW)


def rotation_summary(found: list[RotationGroup], key: Key) -> Summary:
    """The same of the rotation by both cameras."""
    return _by_group(f"{CAMERAS}, ", found, key, ROTATION_COLUMNS, ROTATION_HOW)


def _by_group(
    title: str, found: list[AnyGroup], key: Key, columns: tuple[tuple[str, Callable[[AnyGroup], str]], ...], how: str
) -> Summary:
    with_config = not key or len({group.config for group in found}) > 1
    by = f"word {', '.join(map(str, key))} of the recording's name" if key else CONFIG
    told = {head: [tell(group) for group in found] for head, tell in columns}
    kept = {head: cells for head, cells in told.items() if any(cell != NOTHING for cell in cells)}
    names = [[*group.words, *([group.config] if with_config else [])] for group in found]
    heads = [*(f"word {word}" for word in key), *([CONFIG] if with_config else []), *kept]
    rows = [[*name, *cells] for name, cells in zip(names, zip(*kept.values(), strict=True), strict=True)]
    left_out = ", ".join(head.replace("\n", " ") for head in told if head not in kept)
    note = how + (f" Nothing to tell: {left_out}." if left_out else "")
    return Summary(f"{title}by {by}", heads, rows, len(names[0]), note)


def alarm_summary(found: list[Alarms]) -> Summary:
    """Configurations down; the note names the recordings in which drones were invented."""
    heads = [CONFIG, "runs", "hours", "outputs", "false\ndetections", "drones\ninvented", "[/h]", "below [/h]\n(95 %)"]
    rows = [
        [a.config, str(a.runs), f"{a.hours:.3g}", *map(str, (a.outputs, a.detections, a.invented))]
        + [f"{rate:.3g}" for rate in (a.per_h, a.upper_per_h)]
        for a in found
    ]
    where = [
        f"{a.config or 'runs'}: drones invented in "
        + ", ".join(f"{name} ({count})" if count > 1 else name for name, count in a.by_recording.items())
        for a in found
        if a.by_recording
    ]
    return Summary("without a drone", heads, rows, 1, "; ".join(where))


def reliability_summary(found: list[Reliability]) -> Summary:
    """Configurations and probabilities down: what was said, and what it was."""
    heads = [CONFIG, "probability said", "things", "mean\n[%]", "a drone\n[%]", "95 %\n[%]"]
    rows = [
        [
            r.config,
            f"{r.low:g} to {r.high:g}",
            str(r.things),
            *_percents(r.stated, r.share),
            " to ".join(_percents(*r.interval)),
        ]
        for r in found
    ]
    return Summary("what was said to be a drone", heads, rows, 2, RELIABILITY_HOW)


def _digits(value: float | None, digits: int, longer_than: float | None = None) -> str:
    if value is None:
        return NOTHING
    if math.isinf(value):
        return "never" if longer_than is None else f">{longer_than:.0f}"
    return f"{value:.{digits}f}"


def _percent(counts: tuple[float, float]) -> str:
    return f"{100 * counts[0] / counts[1]:.1f}" if counts[1] else NOTHING


def _percents(*shares: float) -> list[str]:
    return [f"{100 * share:.1f}" for share in shares]


def _of(count: int, of: int) -> str:
    return f"{count}/{of}" if of else NOTHING
