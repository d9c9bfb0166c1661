"""Viewer: a tap that logs every message of every edge to Rerun, into a file and optionally to a loopback server.

`see` puts a message into a bounded queue, and one logging thread draws it. A slow viewer, a full disk or a port in use
does not stop the run: such failures are counted in `dropped` and `errors`, and logged when the run ends.

Source: ours, for the API of Rerun 0.41; DESIGN, Links.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import rerun as rr
from pydantic import Field

from flow.link import Run, Tap
from flow.message import Message
from flow.stage import Settings
from links.viewer import draw_pose
from links.viewer.draw import draw
from links.viewer.draw_pose import TrueTrack
from links.viewer.entities import Entity
from links.viewer.layout import Vision, layout
from links.viewer.message_queue import MessageQueue, Slicer
from links.viewer.scene import Gate, ViewerScene, drone_sphere, initial_frames, spheres, static_entities
from links.viewer.stream import LOOPBACK, Stream
from stages.geometry.frames import LidarMount
from stages.geometry.rig import RigCameras
from stages.messages import CameraMount

PUT_TIMEOUT_S = 10.0  # a lossless run waits this long for a stalled viewer
IMAGE_PERIOD_S = {True: 0.0, False: 0.2}  # lossless: every image; live: five per second
TRUTH_PERIOD_NS = 50_000_000  # between drawn true positions
CLOSE_TIMEOUT_S = {True: 60.0, False: 1.5}  # lossless: all messages; live: a run stops within two seconds

# Errors of drawing a message, including those of Rerun in strict mode.
DRAWING_ERRORS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)

_log = logging.getLogger("grd.viewer")


class ViewerSettings(Settings):
    """Settings of `Viewer`."""

    file: str | None = Field("run.rrd", pattern=r"^[\w.-]+\.rrd$")  # in the folder of the run; null: no file
    serve: bool = False  # serve viewers on this host; binds 127.0.0.1 only
    port: int = Field(9876, ge=1024, le=65535)
    memory_limit: str = Field(
        "256MiB", pattern=r"^\d+(kB|MB|GB|KiB|MiB|GiB)$"
    )  # of the server, for viewers that connect later
    lossless: bool = False
    queue_size: int = Field(4096, ge=1)
    slice_s: float = Field(0.1, gt=0, le=10)  # duration of the slices to which messages of packets are joined
    history_s: float = Field(3.0, gt=0, le=60)  # duration of the visible cloud: one sweep
    max_points_per_slice: int = Field(6000, ge=1)
    trail_s: float = Field(20.0, ge=0)  # duration of the visible trail of a drone
    mount: LidarMount | None = None  # with it, the turntable, the LiDAR and the fan of its beams are drawn
    cameras: RigCameras | None = None  # of the rig; with it, lines are drawn on the images


class Viewer(Tap[ViewerSettings]):
    """Logs every edge to Rerun. With `lossless: true` a replay waits for the viewer; a live run drops messages."""

    def __init__(self, settings: ViewerSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._queue: MessageQueue[Message] | None = None
        self._thread: threading.Thread | None = None
        self._errors: Counter[str] = Counter()
        self._finished: bool = False
        self._blocks: bool = False  # lossless, and not live
        self.gate: Gate | None = None
        """The autopilot link's gate, set before `open`."""
        self.truths: list[TrueTrack] = []
        """True positions of the drones, set before `close`; drawn at the end."""

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that were dropped because the logging thread was too slow, by output."""
        return dict(self._queue.dropped) if self._queue else {}

    @property
    def errors(self) -> dict[str, int]:
        """Error texts with the number of their occurrences."""
        return dict(self._errors)

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of dropped messages and of errors."""
        return {"not drawn": sum(self.dropped.values()), "errors": sum(self._errors.values())}

    @property
    def status(self) -> str | None:
        """The newest error, None without one. The run continues."""
        return f"not all is drawn: {next(reversed(self._errors))}" if self._errors else None

    @property
    def url(self) -> str:
        """The address of a serving run: `rerun --connect URL`."""
        return f"rerun+http://{LOOPBACK}:{self.settings.port}/proxy"

    def open(self, run: Run) -> None:
        """Start the logging thread, which initialises Rerun; that takes half a second.

        Without file and server there is no thread.
        """
        settings = self.settings
        self._errors.clear()
        self._finished = False
        self._queue = None
        if settings.file is None and not settings.serve:
            return
        self._blocks = settings.lossless and not run.live
        self._queue = MessageQueue(settings.queue_size, lossless=self._blocks, timeout_s=PUT_TIMEOUT_S)
        self._thread = threading.Thread(target=self._work, args=(run, self._queue), name="viewer", daemon=True)
        self._thread.start()

    def wants(self, message: type[Message]) -> bool:
        """Every type, if there is a file or a server."""
        return self.settings.file is not None or self.settings.serve

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Queue a message. It is drawn at its stamp, not at its arrival."""
        if self._queue is not None:
            self._queue.put(output, message)

    def close(self) -> None:
        """Draw the queued messages, close the file, and log errors and dropped messages."""
        if self._queue is None or self._thread is None:
            return
        self._queue.close()
        timeout_s = CLOSE_TIMEOUT_S[self._blocks]
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._errors[
                f"the viewer did not finish within {timeout_s} s: the end of {self.settings.file} is missing"
            ] += 1
        elif not self._finished:
            self._errors["the logging thread died, see its traceback; later messages are not drawn"] += 1
        for output, count in self.dropped.items():
            _log.warning("%d messages of %s are missing in the viewer", count, output)
        for text, count in self.errors.items():
            _log.warning("%s%s", text, f" ({count} times)" if count > 1 else "")

    def _work(self, run: Run, queue: MessageQueue[Message]) -> None:
        """The logging thread. It closes the queue however it ends, so that `put` never blocks afterwards."""
        try:
            self._log_all(run, queue)
            self._finished = True
        finally:
            queue.close()

    def _log_all(self, run: Run, queue: MessageQueue[Message]) -> None:
        settings = self.settings
        rr.set_strict_mode(True)  # Rerun raises errors, which are counted, instead of warnings
        vision = self._vision(run)
        stream = Stream(
            run.out_dir / settings.file if settings.file is not None else None,
            settings.port if settings.serve else None,
            settings.memory_limit,
            self._errors,
            layout(
                depth_images=_wired(run, "depth_image"),
                candidates=_wired(run, "candidates"),
                vision=vision,
                truth=not run.live,
                gate=self.gate is not None,
            ),
        )
        for entity in (*_about(run), *static_entities(settings.mount), *(spheres() if vision.directions else ())):
            stream.put(entity, static=True)
        scene = ViewerScene(
            mount=settings.mount,
            history_s=settings.history_s,
            slice_s=settings.slice_s,
            max_points=settings.max_points_per_slice,
            trail_s=settings.trail_s,
            cameras=settings.cameras,
            image_period_s=IMAGE_PERIOD_S[self._blocks],
            gate=self.gate,
        )
        initial = [*initial_frames(settings.mount), *(drone_sphere(None) if vision.directions else ())]
        slicer = Slicer(settings.slice_s)
        dropped = 0
        while (batch := queue.take()) is not None:
            for output, message in batch:
                self._draw(stream, scene, initial, slicer.add(output, message))
            if queue.dropped.total() > dropped:
                dropped = queue.dropped.total()
                stream.put(Entity("log/viewer", rr.TextLog(f"{dropped} messages dropped so far", level="WARN")))
        self._draw(stream, scene, initial, slicer.finish())
        self._draw_truths(stream, scene)
        stream.close()

    def _draw_truths(self, stream: Stream, scene: ViewerScene) -> None:
        """The true drones and the errors against them, at their own times."""
        for number, (stamps_ns, xyz_m) in enumerate(self.truths, 1):
            last_ns = -TRUTH_PERIOD_NS
            for stamp_ns, position_m in zip(stamps_ns.tolist(), xyz_m, strict=True):
                if stamp_ns - last_ns >= TRUTH_PERIOD_NS:
                    last_ns = stamp_ns
                    stream.at(stamp_ns)
                    for entity in draw_pose.truth(number, stamp_ns, position_m):
                        stream.put(entity)
        for stamp_ns, entity in draw_pose.errors_against(self.truths, scene) if self.truths else ():
            stream.at(stamp_ns)
            stream.put(entity)

    def _draw(
        self, stream: Stream, scene: ViewerScene, initial: Iterable[Entity], ready: Iterable[tuple[str, int, Message]]
    ) -> None:
        for output, stamp_ns, message in ready:
            try:
                if stream.at(stamp_ns):
                    for entity in initial:
                        stream.put(entity)
                for entity in draw(message, output.replace(".", "/"), scene):
                    stream.put(entity)
            except DRAWING_ERRORS as error:
                self._errors[f"{output} could not be drawn: {type(error).__name__}: {error}"] += 1

    def _vision(self, run: Run) -> Vision:
        """The camera outputs of the graph that have views."""
        directions = _has_output(run, "vanishing_directions")
        images = (self.settings.cameras and self.settings.cameras.frame_ids()) or [
            f"camera_{camera_mount.value}" for camera_mount in CameraMount
        ]
        return Vision(
            images=images if directions or _has_output(run, "image") else [],
            directions=directions,
            rotation=_has_output(run, "relative_rotation"),
            pose=_has_output(run, "relative_pose"),
            odometry=_has_output(run, "visual_motion"),
        )


def _wired(run: Run, output: str) -> bool:
    """Whether an input is connected to an output of this name."""
    return f" -- {output} --> " in run.mermaid


def _has_output(run: Run, output: str) -> bool:
    """Whether the graph has an output of this name, connected or not."""
    return _wired(run, output) or f" -. {output} .-> " in run.mermaid


def _about(run: Run) -> Iterator[Entity]:
    markdown = rr.MediaType.MARKDOWN
    yield Entity("about/graph", rr.TextDocument(f"```mermaid\n{run.mermaid}\n```", media_type=markdown))
    yield Entity("about/settings", rr.TextDocument(f"```yaml\n{run.settings_yaml}\n```", media_type=markdown))
