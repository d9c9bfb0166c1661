"""Preflight checks of a camera: frames, their rate, their size against the rig's lens, readout and latency."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from flow.graph import Graph
from flow.link import LinkError, Record, Source
from links.camera.camera import Camera, jpeg_size
from links.camera.capture import is_device, is_url
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observation, Observations, ObservedSource
from links.recording import decode_compressed_image
from stages.geometry.rig import width_height_px

MIN_HZ = 1.0
SILENT_S = 1.0  # a camera without frames for longer has failed
MIN_RATE_SHARE = 0.5  # of the requested rate

DEFAULT_GB_PER_HOUR = 5.0  # of a camera that sent nothing: a 720 px fisheye at 10 Hz, JPEG


class CameraObservation(Observation):
    """Sizes of the images."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.sizes_px: Counter[tuple[int, int]] = Counter()

    @property
    def recorded_gb_per_hour(self) -> float:
        """See Observation."""
        received = self.records.data_gb_per_hour
        return DEFAULT_GB_PER_HOUR if received is None else received

    def add(self, record: Record) -> None:
        """See Observation. Records that hold no image are counted by the link."""
        super().add(record)
        try:
            self.sizes_px[jpeg_size(decode_compressed_image(record.data).data)] += 1
        except (ValueError, LinkError):
            return


class CameraChecks(LinkChecks):
    """Checks of a fisheye camera."""

    link_class = Camera

    def observation(self, source: Source) -> CameraObservation:
        """See LinkChecks."""
        return CameraObservation(source.topic)

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """Cameras are optional."""
        if not declares(graph, Camera):
            yield warning("cameras", "not in this configuration: the drone's rotation comes from its motion alone")

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        link, rig = source.link, observations.rig
        assert isinstance(link, Camera)
        return camera_checks(source, rig_size_px(rig, link), rig_readout_ms(rig, link))


def rig_size_px(rig: Mapping[str, Any], link: Camera) -> tuple[int, int] | None:
    """Width and height that a camera's lens was calibrated for: its own setting, or the rig's; None: neither is set."""
    size: Any = link.settings.size_px or _rig_camera(rig, link).get("size_px")
    return None if size is None else width_height_px(size if isinstance(size, int) else (int(size[0]), int(size[1])))


def rig_readout_ms(rig: Mapping[str, Any], link: Camera) -> float | None:
    """Readout time of a camera's rows: its own setting, or the rig's; None: neither is set (0 in a link: not set)."""
    return link.settings.readout_ms or _rig_camera(rig, link).get("readout_ms")


def _rig_camera(rig: Mapping[str, Any], link: Camera) -> Mapping[str, Any]:
    """The rig's entry for a camera: that with the last name of its topic."""
    cameras: Mapping[str, Any] = rig.get("cameras") or {}
    return cameras.get(link.topic.rpartition("/")[2]) or {}


def camera_checks(
    source: ObservedSource, rig_px: tuple[int, int] | None, readout_ms: float | None
) -> Iterator[CheckResult]:
    """All checks of one camera. `rig_px`: width and height of the lens calibration; None: not set in the rig."""
    link, observation = source.link, source.observation
    assert isinstance(link, Camera)
    assert isinstance(observation, CameraObservation)
    if not observation.sizes_px:
        rejected = (
            f"{observation.records.count} records without an image arrived; " if observation.records.count else ""
        )
        yield fail(f"{source.name} frames", f"{rejected}{source.no_data_reason}")
        return
    yield _rate(source, link)
    yield _size(source.name, observation, rig_px)
    yield _readout(source.name, link, readout_ms)
    if (
        source.live
        and link.settings.source is not None
        and (is_device(link.settings.source) or is_url(link.settings.source))
    ):
        yield _latency(source.name, link)


def _rate(source: ObservedSource, link: Camera) -> CheckResult:
    name, records = f"{source.name} frames", source.observation.records
    rejected = sum(source.counters.rejected.values())
    rate = f"{records.rate_hz:.1f} frames/s" if records.count > 1 else "one frame"
    text = rate + (f", {rejected} of {records.count} damaged" if rejected else "")
    if not records.rate_hz >= MIN_HZ or (source.live and source.status):
        why = source.status or "too slow for any motion"
        return fail(name, f"{text}: {why}")
    silent_s = records.longest_silence_s(source.end_ns)
    if source.live and silent_s > max(SILENT_S, 3.0 / records.rate_hz):
        return fail(name, f"{text}; then none for {silent_s:.1f} s: check its cable and power")
    if rejected > 0.01 * records.count:
        return warning(name, f"{text}: check cable and hub")
    if source.live and records.rate_hz < MIN_RATE_SHARE * link.settings.fps:
        return warning(
            name, f"{text}, {link.settings.fps:g} requested: is it too dark, is the bus shared, or this host too busy?"
        )
    return ok(name, text)


def _size(name: str, observation: CameraObservation, rig_px: tuple[int, int] | None) -> CheckResult:
    name = f"{name} size"
    found = ", ".join(f"{w} x {h}" for w, h in observation.sizes_px)
    if rig_px is None:
        return warning(name, f"{found}; the rig has no size_px of the lens calibration")
    if set(observation.sizes_px) != {rig_px}:
        return fail(
            name,
            f"{found}, but the lens is calibrated for {rig_px[0]} x {rig_px[1]}: set the camera's mode, or calibrate "
            "the lens in this one",
        )
    return ok(name, f"{found}, as in the rig")


def _readout(name: str, link: Camera, readout_ms: float | None) -> CheckResult:
    name = f"{name} readout"
    if readout_ms is None:
        key = f"cameras.{link.topic.rpartition('/')[2]}.readout_ms"
        return warning(
            name,
            f"no readout time in the rig, and most cameras have a rolling shutter: set {key} (0: global shutter)",
        )
    return ok(name, f"{readout_ms:g} ms from the first row to the last" if readout_ms else "global shutter")


def _latency(name: str, link: Camera) -> CheckResult:
    if link.settings.latency_s:
        return ok(f"{name} latency", f"{1e3 * link.settings.latency_s:g} ms from exposure to reception")
    return warning(
        f"{name} latency",
        "latency_s is 0: images are stamped as exposed at reception, and an error of 80 ms costs 18 cm and 1 deg; film "
        f"a clock on this host's screen, and set {name}.latency_s to the delay of the image (configs/field.yaml)",
    )
