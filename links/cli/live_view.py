"""Console display of a live run: a table on a terminal, a line every few seconds otherwise (a log file, systemd).

Source: ours.
"""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live as Screen
from rich.table import Table
from rich.text import Text

from flow.link import Tap
from flow.live.report import LinkState, LiveReport
from flow.message import Message
from links.cli.console import err, out
from links.runs.live_run import RunStatus
from stages.messages import DroneFix, PositionEstimate, RelativePose, TrackState

SCREEN_PERIOD_S, LINE_PERIOD_S = 0.25, 5.0
SHOWN = (RelativePose, DroneFix, TrackState)


class LatestMessages(Tap):
    """Keeps the newest message of each kind that the console shows."""

    def __init__(self) -> None:
        super().__init__()
        self._messages: dict[type[Message], Any] = {}

    def wants(self, message: type[Message]) -> bool:
        """Only messages that the console shows."""
        return message in SHOWN

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Store the message."""
        self._messages[type(message)] = message

    def state_and_pose(self) -> tuple[str, str]:
        """Texts of the state and the pose: those of the fused pose, without one those of the track and its last fix."""
        pose: RelativePose | None = self._messages.get(RelativePose)
        if pose is not None:
            return f"{pose.state.name}: {pose.reason}", _pose(pose)
        track: TrackState | None = self._messages.get(TrackState)
        fix: DroneFix | None = self._messages.get(DroneFix)
        state = "no drone yet" if track is None else f"{track.state.name}: {track.reason}"
        return state, "" if fix is None else _position(fix.xyz_vehicle_m, fix.covariance_m2)


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


class LiveView:
    """`with LiveView() as view`: `view.latest` is a tap of the run, `view.show` displays its status."""

    def __init__(self, console: Console = out) -> None:
        self.latest = LatestMessages()
        self._console = console
        self._screen = Screen(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._next_s = 0.0

    def __enter__(self) -> LiveView:
        if self._screen is not None:
            self._screen.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._screen is not None:
            self._screen.stop()

    def show(self, status: RunStatus) -> None:
        """Print new events at once; the status every SCREEN_PERIOD_S on a terminal, otherwise every LINE_PERIOD_S."""
        for text in status.new_events:
            (self._console if self._screen is not None else err).print(text, markup=False, style="yellow")
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        if self._screen is not None:
            self._next_s = now_s + SCREEN_PERIOD_S
            self._screen.update(self._table(status), refresh=True)
        else:
            self._next_s = now_s + LINE_PERIOD_S
            self._console.print(self._line(status), markup=False)

    def _line(self, status: RunStatus) -> str:
        report = status.report()
        state, pose = self.latest.state_and_pose()
        closed = [f"{n} {link.state_text}" for n, link in report.links.items() if link.state is not LinkState.OPEN]
        parts = [f"{status.elapsed_s:.1f} s", state, pose, _numbers(report), *closed]
        return "; ".join(part for part in parts if part)

    def _table(self, status: RunStatus) -> Group:
        report = status.report()
        state, pose = self.latest.state_and_pose()
        head = Text(f"{status.elapsed_s:8.1f} s   {state}\n             {pose}\n             {_numbers(report)}")
        edges = Table("edge", "from", box=None, pad_edge=False)
        for name in ("lag [ms]", "p99", "max", "taken", "dropped", "late"):
            edges.add_column(Text(name), justify="right")
        for name, edge in report.edges.items():
            bad = "red" if edge.dropped or edge.missed else None
            numbers = [f"{edge.lag_ms:.1f}", f"{edge.lag_p99_ms:.1f}", f"{edge.lag_max_ms:.0f}"]
            counts = [str(edge.taken), str(edge.dropped), str(edge.missed)]
            edges.add_row(name, edge.source, *numbers, *counts, style=bad)
        links = Table("link", "records", "state", box=None, pad_edge=False)
        for name, link in report.links.items():
            counts = ", ".join(f"{key} {value}" for key, value in report.counters.get(name, {}).items() if value)
            links.add_row(
                name, str(link.records), Text(f"{link.state_text}  {counts}", overflow="ellipsis", no_wrap=True)
            )
        others = Table("others", "counts", box=None, pad_edge=False)
        for name, counted in report.counters.items():
            if name not in report.links and any(counted.values()):
                others.add_row(name, ", ".join(f"{key} {value}" for key, value in counted.items() if value))
        return Group(head, edges, links, others) if others.row_count else Group(head, edges, links)


def _numbers(report: LiveReport) -> str:
    worst = max((edge.lag_p99_ms for edge in report.edges.values()), default=0.0)
    text = f"{report.records} records, worst lag p99 {worst:.1f} ms, {report.dropped} dropped, {report.missed} late"
    return text + (f", OFF: {', '.join(report.switched_off)}" if report.switched_off else "")
