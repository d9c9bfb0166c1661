"""Preflight checks of the recorder: free disk space for the recording of a flight."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from flow.graph import Graph
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observations
from links.recording.recorder import Recorder

FLIGHT_H = 1.0  # a flight of this duration must fit
MIN_GB_H = 0.1  # logs, results and other files of a run
GB, MB = 1e9, 1e6


class RecorderChecks(LinkChecks):
    """Checks of the recorder."""

    link_class = Recorder

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """A recorder is optional."""
        if not declares(graph, Recorder):
            yield warning("recorder", "not in this configuration: the flight will not be recorded")

    def check_device(self, graph: Graph, observations: Observations, out_dir: Path) -> Iterator[CheckResult]:
        """Free disk space of a live run."""
        if observations.live:
            for recorder in (spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Recorder)):
                assert isinstance(recorder, Recorder)
                yield disk_check(recorder, observations, out_dir)


def disk_check(recorder: Recorder, observations: Observations, out_dir: Path) -> CheckResult:
    """Free space for the run's folder, against the recorder's reserve and the size of one hour."""
    name, folder = "disk", existing(out_dir)
    try:
        free_bytes = shutil.disk_usage(folder).free
    except OSError as error:
        return fail(name, f"{folder}: {error.strerror or error}: is the disk mounted? Nothing can be recorded")
    free = _amount(free_bytes)
    reserve_bytes = MB * recorder.settings.reserve_mb
    if free_bytes < reserve_bytes:
        return fail(
            name,
            f"{free} free at {folder}, and the recorder keeps {_amount(reserve_bytes)} free (reserve_mb): "
            "nothing will be recorded; free some space, or choose another disk with --out",
        )
    rates = {source.name: source.observation.recorded_gb_per_hour for source in observations.sources}
    rates_gb_h = {name: rate for name, rate in rates.items() if rate is not None}
    summary = ", ".join(f"{source} {rate:.1f}" for source, rate in rates_gb_h.items())
    if not rates_gb_h:
        return ok(name, f"{free} free at {folder}; no LiDAR and no camera to record")
    rate = max(sum(rates_gb_h.values()), MIN_GB_H)
    hours = (free_bytes - reserve_bytes) / GB / rate
    text = f"{free} free at {folder}; a flight needs {rate:.1f} GB/h ({summary})"
    if hours < FLIGHT_H:
        return warning(
            name,
            f"{text}, so it is full after {60 * hours:.0f} min: free some space, or choose another disk with --out",
        )
    return ok(name, f"{text}, enough for {hours:.1f} h")


def existing(folder: Path) -> Path:
    """The folder itself, or its nearest existing parent."""
    absolute = folder.absolute()
    return next((path for path in (absolute, *absolute.parents) if path.is_dir()), absolute)


def _amount(count: float) -> str:
    return f"{count / GB:.1f} GB" if count >= GB else f"{count / MB:.0f} MB"
