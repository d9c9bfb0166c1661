"""Is there room on the disk for the recording of a flight.

Source: ours; the LiDAR's rate is measured on live recordings of an hour.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from links.camera import Camera
from links.preflight.heard import AllHeard, Heard
from links.preflight.verdict import Verdict, fail, ok, warning
from links.recording import Recorder
from links.velodyne import Lidar

FLIGHT_H = 1.0  # a flight that shall fit
LIDAR_KEPT = 0.43  # of the packets' bytes, zstd: 0.91 MB/s come, 1.4 GB an hour stay
LIDAR_GB_H, CAMERA_GB_H = 1.4, 5.0  # of one that was not heard; a 720 px fisheye at 10 Hz, JPEG
LEAST_GB_H = 0.1  # orders, results and what else a run writes
GB, MB = 1e9, 1e6


def disk_check(recorder: Recorder, heard: AllHeard, out_dir: Path) -> Verdict:
    """The free room where a run's folder would be, against what the recorder keeps free and what an hour takes."""
    name, folder = "disk", existing(out_dir)
    try:
        free_bytes = shutil.disk_usage(folder).free
    except OSError as error:
        return fail(name, f"{folder}: {error.strerror or error}: is the disk there? Nothing could be recorded")
    free = _amount(free_bytes)
    reserve_bytes = MB * recorder.settings.reserve_mb
    if free_bytes < reserve_bytes:
        return fail(
            name,
            f"{free} free at {folder}, and the recorder leaves {_amount(reserve_bytes)} free (reserve_mb): "
            "nothing would be recorded; make room, or give another disk with --out",
        )
    rates_gb_h = {part.name: rate_gb_h(part) for part in heard.of(Lidar) + heard.of(Camera)}
    told = ", ".join(f"{source} {rate:.1f}" for source, rate in rates_gb_h.items())
    if not rates_gb_h:
        return ok(name, f"{free} free at {folder}; no LiDAR and no camera fills it")
    rate = max(sum(rates_gb_h.values()), LEAST_GB_H)
    hours = (free_bytes - reserve_bytes) / GB / rate
    text = f"{free} free at {folder}; a flight takes {rate:.1f} GB an hour ({told})"
    if hours < FLIGHT_H:
        return warning(
            name, f"{text}, so it is full after {60 * hours:.0f} min: make room, or give another disk with --out"
        )
    return ok(name, f"{text}, so it lasts {hours:.1f} h")


def rate_gb_h(part: Heard) -> float:
    """What a source's records take on the disk in an hour [GB]: as heard, or as taken of its kind."""
    lidar, arrivals = isinstance(part.link, Lidar), part.seen.arrivals
    span_ns = arrivals.last_ns - arrivals.first_ns
    if arrivals.count < 2 or span_ns <= 0:
        return LIDAR_GB_H if lidar else CAMERA_GB_H
    came_gb_h = arrivals.data_bytes * (arrivals.count - 1) / arrivals.count / GB * 3600e9 / span_ns
    return LIDAR_KEPT * came_gb_h if lidar else came_gb_h


def existing(folder: Path) -> Path:
    """The folder itself, or the nearest above it that is there."""
    whole = folder.absolute()
    return next((place for place in (whole, *whole.parents) if place.is_dir()), whole)


def _amount(count: float) -> str:
    return f"{count / GB:.1f} GB" if count >= GB else f"{count / MB:.0f} MB"
