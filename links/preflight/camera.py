"""Is a camera as it must be: frames, their size against the rig's lens, their rate, and when they were exposed.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator

from links.camera import Camera
from links.camera.capture import is_device, is_url
from links.preflight.heard import Heard
from links.preflight.seen import CameraSeen
from links.preflight.verdict import Verdict, fail, ok, warning

LEAST_HZ = 1.0
SILENT_S = 1.0  # a camera that gave pictures and then none for so long has died
FULL_RATE = 0.5  # of what was asked of the device


def camera_checks(heard: Heard, rig_px: tuple[int, int] | None, readout_ms: float | None) -> Iterator[Verdict]:
    """All checks of one camera; `rig_px`: width, height that the lens was calibrated for; None: the rig is silent."""
    link, seen = heard.link, heard.seen
    assert isinstance(link, Camera)
    assert isinstance(seen, CameraSeen)
    if not seen.sizes_px:
        refused = f"{seen.arrivals.count} records came that hold no picture; " if seen.arrivals.count else ""
        yield fail(f"{heard.name} frames", f"{refused}{heard.silence}")
        return
    yield _rate(heard, link)
    yield _size(heard.name, seen, rig_px)
    yield _readout(heard.name, link, readout_ms)
    if (
        heard.live
        and link.settings.source is not None
        and (is_device(link.settings.source) or is_url(link.settings.source))
    ):
        yield _latency(heard.name, link)


def _rate(heard: Heard, link: Camera) -> Verdict:
    name, arrivals = f"{heard.name} frames", heard.seen.arrivals
    refused = heard.counters.get("refused", 0)
    told = f"{arrivals.rate_hz:.1f} a second" if arrivals.count > 1 else "one frame"
    text = told + (f", {refused} of {arrivals.count} damaged" if refused else "")
    if not arrivals.rate_hz >= LEAST_HZ or (heard.live and heard.status):
        why = heard.status or "too slow for any motion"
        return fail(name, f"{text}: {why}")
    silent_s = arrivals.longest_silence_s(heard.end_ns)
    if heard.live and silent_s > max(SILENT_S, 3.0 / arrivals.rate_hz):
        return fail(name, f"{text}; then none came for {silent_s:.1f} s: check its cable and power")
    if refused > 0.01 * arrivals.count:
        return warning(name, f"{text}: check cable and hub")
    if heard.live and arrivals.rate_hz < FULL_RATE * link.settings.fps:
        return warning(
            name, f"{text}, {link.settings.fps:g} were asked for: is it too dark, the bus shared, this host too busy?"
        )
    return ok(name, text)


def _size(name: str, seen: CameraSeen, rig_px: tuple[int, int] | None) -> Verdict:
    name = f"{name} size"
    found = ", ".join(f"{w} x {h}" for w, h in seen.sizes_px)
    if rig_px is None:
        return warning(name, f"{found}; the rig does not say what the lens was calibrated for (size_px)")
    if set(seen.sizes_px) != {rig_px}:
        return fail(
            name,
            f"{found}, but the lens is calibrated for {rig_px[0]} x {rig_px[1]}: set the camera's mode, or calibrate "
            "the lens in this one",
        )
    return ok(name, f"{found}, as the rig says")


def _readout(name: str, link: Camera, readout_ms: float | None) -> Verdict:
    name = f"{name} readout"
    if readout_ms is None:
        key = f"cameras.{link.topic.rpartition('/')[2]}.readout_ms"
        return warning(
            name, f"the rig does not say how long the rows take: most shutters roll; set {key} in it (0: all at once)"
        )
    return ok(name, f"{readout_ms:g} ms from the first row to the last" if readout_ms else "all rows at once")


def _latency(name: str, link: Camera) -> Verdict:
    if link.settings.latency_s:
        return ok(f"{name} latency", f"{1e3 * link.settings.latency_s:g} ms from a picture's exposure to its arrival")
    return warning(
        f"{name} latency",
        "latency_s is 0: pictures count as exposed when they arrive, and 80 ms of it cost 18 cm and 1 deg; film a "
        f"clock on this host's screen, and set {name}.latency_s to how far its picture is behind (configs/field.yaml)",
    )
