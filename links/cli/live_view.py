"""Console display of a live run: one screen of a terminal, a line every few seconds otherwise (a log file, systemd).

The screen fits 24 rows: state and pose, what is sent to the autopilot, each source with its rate, age and status, the
edges that drop messages or are late, what stages reject, and the newest events.

Source: ours.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live as Screen
from rich.table import Table
from rich.text import Text

from flow.link import Tap
from flow.live.report import LinkState, LiveReport
from flow.message import Message
from links.cli.console import err, out
from links.mavlink.frame_sender import POSE_REJECTED, SENT
from links.runs.live_run import RunStatus
from stages.messages import DroneFix, PositionEstimate, RelativePose, TrackState

SCREEN_PERIOD_S, LINE_PERIOD_S = 0.25, 5.0
RATE_S = 1.0  # rates are averages over this time at least
MAX_EDGES, MAX_OTHERS, MAX_EVENTS = 3, 1, 3  # rows of the screen
POSE_MESSAGES = ("ODOMETRY", "VISION_POSITION_ESTIMATE", "LANDING_TARGET")
SHOWN = (RelativePose, DroneFix, TrackState)


class LatestMessages(Tap):
    """Keeps the newest message of each kind that the console shows, by the stage that published it."""

    def __init__(self) -> None:
        super().__init__()
        self._messages: dict[type[Message], dict[str, Any]] = {kind: {} for kind in SHOWN}

    def wants(self, message: type[Message]) -> bool:
        """Only messages that the console shows."""
        return message in SHOWN

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Store the message."""
        self._messages[type(message)][output.partition(".")[0]] = message

    def states_and_poses(self) -> list[tuple[str, str]]:
        """Texts of state and pose of each drone: of its fused pose, without one of its track and its last fix.

        Those of several drones begin with the name of the stage.
        """
        poses: dict[str, RelativePose] = self._messages[RelativePose]
        tracks: dict[str, TrackState] = self._messages[TrackState]
        fixes: dict[str, DroneFix] = self._messages[DroneFix]
        texts = {name: (f"{pose.state.name}: {pose.reason}", _pose(pose)) for name, pose in poses.items()}
        for name in () if poses else sorted(tracks.keys() | fixes.keys()):
            track, fix = tracks.get(name), fixes.get(name)
            state = "no drone yet" if track is None else f"{track.state.name}: {track.reason}"
            texts[name] = state, "" if fix is None else _position(fix.xyz_vehicle_m, fix.covariance_m2)
        if len(texts) > 1:
            return [(f"{name} {state}", pose) for name, (state, pose) in sorted(texts.items())]
        return list(texts.values()) or [("no drone yet", "")]


def _pose(pose: RelativePose) -> str:
    estimate = pose.estimate
    if estimate is None:
        return ""
    if isinstance(estimate, PositionEstimate):
        return _position(estimate.xyz_vehicle_m, estimate.covariance_vehicle_m2)
    text = _position(estimate.xyz_vehicle_m, estimate.covariance[3:, 3:])
    R = estimate.R_vehicle_drone
    return f"{text}  yaw {np.degrees(np.arctan2(R[1, 0], R[0, 0])):.1f} deg"


def _position(xyz_m: Any, covariance_m2: Any) -> str:
    x, y, z = xyz_m
    return f"x {x:.2f}  y {y:.2f}  z {z:.2f} m  sigma {float(np.trace(covariance_m2)) ** 0.5:.2f} m"


class Rates:
    """Rate and age of the records of each source, from their counts."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, int]] = {}  # time and count at the start of the measured time
        self._rates: dict[str, float] = {}
        self._changed: dict[str, tuple[float, int]] = {}  # time of the newest change, and the count then

    def add(self, now_s: float, counts: Mapping[str, int]) -> None:
        """Take the counts at a time [s]."""
        for name, count in counts.items():
            since_s, before = self._last.setdefault(name, (now_s, count))
            if now_s - since_s >= RATE_S:
                self._rates[name] = (count - before) / (now_s - since_s)
                self._last[name] = now_s, count
            if count != self._changed.get(name, (0.0, 0))[1]:
                self._changed[name] = now_s, count

    def texts(self, now_s: float, name: str) -> tuple[str, str]:
        """Rate [Hz] and time since the newest record [s]; empty while not known."""
        rate_hz, changed = self._rates.get(name), self._changed.get(name)
        return "" if rate_hz is None else f"{rate_hz:.1f}", "" if changed is None else f"{now_s - changed[0]:.1f}"


class LiveView:
    """`with LiveView() as view`: `view.latest` is a tap of the run, `view.show` displays its status."""

    def __init__(self, console: Console = out) -> None:
        self.latest = LatestMessages()
        self._console = console
        self._screen = Screen(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._next_s = 0.0
        self._rates = Rates()
        self._events: deque[str] = deque(maxlen=MAX_EVENTS)

    def __enter__(self) -> LiveView:
        if self._screen is not None:
            self._screen.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._screen is not None:
            with suppress(OSError):  # the terminal is gone
                self._screen.stop()

    def show(self, status: RunStatus) -> None:
        """Print new events at once; the status every SCREEN_PERIOD_S on a terminal, otherwise every LINE_PERIOD_S."""
        now_s = time.monotonic()
        for text in status.new_events:
            self._events.append(f"{status.elapsed_s:.1f} s  {text}")
            if self._screen is None:
                err.print(text, markup=False, style="yellow")
        if now_s < self._next_s:
            return
        if self._screen is not None:
            self._next_s = now_s + SCREEN_PERIOD_S
            self._screen.update(self._table(status, now_s), refresh=True)
        else:
            self._next_s = now_s + LINE_PERIOD_S
            self._console.print(self._line(status), markup=False)

    def _line(self, status: RunStatus) -> str:
        report = status.report()
        drones = [text for drone in self.latest.states_and_poses() for text in drone]
        closed = [f"{n} {link.state_text}" for n, link in report.links.items() if link.state is not LinkState.OPEN]
        parts = [f"{status.elapsed_s:.1f} s", *drones, _numbers(report), *closed]
        return "; ".join(part for part in parts if part)

    def _table(self, status: RunStatus, now_s: float) -> Group:
        report = status.report()
        self._rates.add(now_s, {name: link.records for name, link in report.links.items()})
        texts = [text for state, pose in self.latest.states_and_poses() for text in (state, pose or "no position")]
        texts += [*_to_autopilots(report), _numbers(report), status.used]
        times = [f"{status.elapsed_s:8.1f} s", *([""] * len(texts))]
        lines = [f"{time:10}   {text}" for time, text in zip(times, filter(None, texts), strict=False)]
        parts: list[RenderableType] = [Text(line, no_wrap=True) for line in lines]
        parts += [self._sources(report, now_s), *_edges(report)]
        others = [
            Text(f"{name}: {_counts(counts)}", overflow="ellipsis", no_wrap=True)
            for name, counts in report.counters.items()
            if name not in report.links and any(counts.values())
        ]
        events = [Text(text, style="yellow", overflow="ellipsis", no_wrap=True) for text in self._events]
        return Group(*parts, *others[:MAX_OTHERS], *events)

    def _sources(self, report: LiveReport, now_s: float) -> Table:
        table = Table("source", box=None, pad_edge=False)
        for name in ("rate [Hz]", "age [s]", "records"):
            table.add_column(Text(name), justify="right")
        table.add_column("status")
        for name, link in report.links.items():
            status = report.statuses.get(name)
            text = status or link.state_text
            bad = status is not None or link.state is not LinkState.OPEN
            known = Text(f"{text}  {_counts(report.counters.get(name, {}))}", overflow="ellipsis", no_wrap=True)
            style = "red" if bad else None
            table.add_row(name, *self._rates.texts(now_s, name), str(link.records), known, style=style)
        for name, status in report.statuses.items():
            if name not in report.links:
                table.add_row(name, "", "", "", Text(status, overflow="ellipsis", no_wrap=True), style="red")
        return table


def _edges(report: LiveReport) -> list[RenderableType]:
    """The edges that drop messages or are late, the worst first; nothing when there is none."""
    worst = sorted(report.edges.items(), key=lambda item: -(item[1].dropped + item[1].missed))
    bad = [(name, edge) for name, edge in worst if edge.dropped or edge.missed]
    if not bad:
        return []
    more = f"  (and {len(bad) - MAX_EDGES} more)" if len(bad) > MAX_EDGES else ""
    table = Table(f"edge{more}", "from", box=None, pad_edge=False)
    for name in ("lag [ms]", "p99", "max", "taken", "dropped", "late"):
        table.add_column(Text(name), justify="right")
    for name, edge in bad[:MAX_EDGES]:
        numbers = [f"{edge.lag_ms:.1f}", f"{edge.lag_p99_ms:.1f}", f"{edge.lag_max_ms:.0f}"]
        counts = [str(edge.taken), str(edge.dropped), str(edge.missed)]
        table.add_row(name, edge.source, *numbers, *counts, style="red")
    return [table]


def _to_autopilots(report: LiveReport) -> list[str]:
    """How many poses were sent to each autopilot, and how many held back, by reason."""
    texts: dict[str, str] = {}
    for name, counts in report.counters.items():
        sent = {kind: n for kind, n in counts.groups.get(SENT, {}).items() if kind in POSE_MESSAGES}
        rejected = counts.groups.get(POSE_REJECTED, {})
        if sent or rejected:
            texts[name] = f"{_counts(sent) or 'nothing sent'}; held back: {_counts(rejected) or 'none'}"
    return [f"to {name if len(texts) > 1 else 'the autopilot'}: {text}" for name, text in texts.items()]


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{key} {value}" for key, value in counts.items() if value)


def _numbers(report: LiveReport) -> str:
    worst = max((edge.lag_p99_ms for edge in report.edges.values()), default=0.0)
    text = f"{report.records} records, worst lag p99 {worst:.1f} ms, {report.dropped} dropped, {report.missed} late"
    return text + (f", OFF: {', '.join(report.switched_off)}" if report.switched_off else "")
