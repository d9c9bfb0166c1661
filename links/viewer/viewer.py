"""Viewer: a tap that logs every message of every edge to Rerun, into a file and, when asked, to a loopback server.

`see` only puts the message into a bounded box; one thread draws. Nothing outside (a slow viewer, a full disk, a taken
port) stops the run: it is counted in `dropped` and `errors`, and said in the log when the run ends.

Source: ours. Rerun 0.41's traps: DESIGN, Links.
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
from links.viewer.draw import draw
from links.viewer.layout import Vision, layout
from links.viewer.lenses import Cameras
from links.viewer.mailbox import Mailbox
from links.viewer.scene import Mark, Scene, drone_sphere, opening, scenery, spheres
from links.viewer.slices import Slicer
from links.viewer.stream import LOOPBACK, Stream
from stages.geometry.frames import LidarMount
from stages.messages import CameraMount

PATIENCE_S = 10.0  # a lossless run waits this long for a stalled viewer
PICTURE_EVERY_S = {True: 0.0, False: 0.2}  # lossless: each; live: enough to look at
CLOSE_S = {True: 60.0, False: 1.5}  # lossless: the whole end; live: a stop takes two seconds in all

# What drawing raises for a message it cannot show; Rerun's own refusals (strict mode) are among them.
DRAWING_ERRORS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)

_log = logging.getLogger("grd.viewer")


class ViewerSettings(Settings):
    """Settings of `Viewer`."""

    file: str | None = "run.rrd"  # in the run's folder; null: no file
    serve: bool = False  # to viewers on this host; binds 127.0.0.1 only
    port: int = Field(9876, ge=1024, le=65535)
    memory_limit: str = Field("256MiB", pattern=r"^\d+(kB|MB|GB|KiB|MiB|GiB)$")  # the server's, for viewers coming late
    lossless: bool = False
    queue_size: int = Field(4096, ge=1)
    slice_s: float = Field(0.1, gt=0, le=10)  # messages that come per packet are joined to slices this long
    history_s: float = Field(3.0, gt=0, le=60)  # how much of the cloud is visible at a time: a whole sweep
    max_points_per_slice: int = Field(6000, ge=1)
    trail_s: float = Field(20.0, ge=0)  # how much of the drone's path is visible at a time
    mount: LidarMount | None = None  # shows the turntable, the LiDAR and the fan of its beams where they are
    cameras: Cameras | None = None  # the rig's: puts lines on the pictures


class Viewer(Tap[ViewerSettings]):
    """Log every edge to Rerun. `lossless: true`: a replay waits for the viewer, dropping nothing; a live run never."""

    def __init__(self, settings: ViewerSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._box: Mailbox[Message] | None = None
        self._thread: threading.Thread | None = None
        self._errors: Counter[str] = Counter()
        self._finished: bool = False
        self._waits: bool = False  # lossless, and not live

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that were not drawn because the viewer did not keep up, by output."""
        return dict(self._box.dropped) if self._box else {}

    @property
    def errors(self) -> dict[str, int]:
        """What went wrong, each text with how often."""
        return dict(self._errors)

    @property
    def counters(self) -> dict[str, int]:
        """Messages that were not drawn, and errors."""
        return {"not drawn": sum(self.dropped.values()), "errors": sum(self._errors.values())}

    @property
    def status(self) -> str | None:
        """What went wrong last, in words: the run goes on without it."""
        return f"not all is drawn: {next(reversed(self._errors))}" if self._errors else None

    @property
    def url(self) -> str:
        """Where a viewer finds a serving run: `rerun --connect URL`."""
        return f"rerun+http://{LOOPBACK}:{self.settings.port}/proxy"

    def open(self, run: Run) -> None:
        """Start the logging thread; Rerun is first touched there, which takes half a second.

        Without file and server there is nothing to draw for, and no thread.
        """
        settings = self.settings
        self._errors.clear()
        self._finished = False
        self._box = None
        if settings.file is None and not settings.serve:
            return
        self._waits = settings.lossless and not run.live
        self._box = Mailbox(settings.queue_size, lossless=self._waits, patience_s=PATIENCE_S)
        self._thread = threading.Thread(target=self._work, args=(run, self._box), name="viewer", daemon=True)
        self._thread.start()

    def wants(self, message: type[Message]) -> bool:
        """All, where there is a file or a server to draw for."""
        return self.settings.file is not None or self.settings.serve

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Put the message into the box; the time that counts is its stamp, not its arrival."""
        if self._box is not None:
            self._box.put(output, message)

    def close(self) -> None:
        """Draw what is left, end the file, and say what was lost."""
        if self._box is None or self._thread is None:
            return
        self._box.close()
        patience_s = CLOSE_S[self._waits]
        self._thread.join(patience_s)
        if self._thread.is_alive():
            self._errors[f"the viewer needs over {patience_s} s: the end of {self.settings.file} is missing"] += 1
        elif not self._finished:
            self._errors["the logging thread died, see its traceback; nothing after that is shown"] += 1
        for output, count in self.dropped.items():
            _log.warning("%d messages of %s are missing in the viewer", count, output)
        for text, count in self.errors.items():
            _log.warning("%s%s", text, f" ({count} times)" if count > 1 else "")

    def _work(self, run: Run, box: Mailbox[Message]) -> None:
        """The logging thread. However it ends, nobody waits for it any more."""
        try:
            self._log_all(run, box)
            self._finished = True
        finally:
            box.close()

    def _log_all(self, run: Run, box: Mailbox[Message]) -> None:
        settings = self.settings
        rr.set_strict_mode(True)  # what Rerun refuses is raised and counted, not warned about
        vision = self._vision(run)
        stream = Stream(
            run.out_dir / settings.file if settings.file is not None else None,
            settings.port if settings.serve else None,
            settings.memory_limit,
            self._errors,
            layout(
                images=_wired(run, "depth_image"),
                evidence=_wired(run, "candidates"),
                vision=vision,
            ),
        )
        for mark in (*_about(run), *scenery(settings.mount), *(spheres() if vision.directions else ())):
            stream.put(mark, static=True)
        scene = Scene(
            mount=settings.mount,
            history_s=settings.history_s,
            slice_s=settings.slice_s,
            max_points=settings.max_points_per_slice,
            trail_s=settings.trail_s,
            cameras=settings.cameras,
            picture_every_s=PICTURE_EVERY_S[self._waits],
        )
        opens = [*opening(settings.mount), *(drone_sphere(None) if vision.directions else ())]
        slicer = Slicer(settings.slice_s)
        dropped = 0
        while (batch := box.take()) is not None:
            for output, message in batch:
                self._draw(stream, scene, opens, slicer.add(output, message))
            if box.dropped.total() > dropped:
                dropped = box.dropped.total()
                stream.put(Mark("log/viewer", rr.TextLog(f"{dropped} messages dropped so far", level="WARN")))
        self._draw(stream, scene, opens, slicer.finish())
        stream.close()

    def _draw(
        self, stream: Stream, scene: Scene, opens: Iterable[Mark], ready: Iterable[tuple[str, int, Message]]
    ) -> None:
        for output, stamp_ns, message in ready:
            try:
                if stream.at(stamp_ns):
                    for mark in opens:
                        stream.put(mark)
                for mark in draw(message, output.replace(".", "/"), scene):
                    stream.put(mark)
            except DRAWING_ERRORS as error:
                self._errors[f"{output} could not be drawn: {type(error).__name__}: {error}"] += 1

    def _vision(self, run: Run) -> Vision:
        """What of the cameras and the fused pose there is to show."""
        directions = _made(run, "vanishing_directions")
        pictures = (self.settings.cameras and self.settings.cameras.named()) or [
            f"camera_{camera_mount.value}" for camera_mount in CameraMount
        ]
        return Vision(
            pictures=pictures if directions or _made(run, "image") else [],
            directions=directions,
            rotation=_made(run, "relative_rotation"),
            pose=_made(run, "relative_pose"),
            odometry=_made(run, "visual_motion"),
        )


def _wired(run: Run, output: str) -> bool:
    """Does any stage take this output?"""
    return f" -- {output} --> " in run.mermaid


def _made(run: Run, output: str) -> bool:
    """Is there this output, whether taken by a stage or not?"""
    return _wired(run, output) or f" -. {output} .-> " in run.mermaid


def _about(run: Run) -> Iterator[Mark]:
    markdown = rr.MediaType.MARKDOWN
    yield Mark("about/graph", rr.TextDocument(f"```mermaid\n{run.mermaid}\n```", media_type=markdown))
    yield Mark("about/settings", rr.TextDocument(f"```yaml\n{run.settings_yaml}\n```", media_type=markdown))
