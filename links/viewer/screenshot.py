"""Screenshots of a run, and a viewer window: starts the installed Rerun viewer, on the loopback interface only.

Source: Rerun 0.41, `rerun --help` and `rerun.experimental.ViewerClient`. Its own `spawn` listens on all interfaces;
this module passes `--bind 127.0.0.1`. Without a display it needs a Vulkan driver (Debian: mesa-vulkan-drivers).
"""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rerun.experimental import ViewerClient, ViewerState

from flow.config_error import one_of
from flow.link import LinkError
from links.viewer.scene import TIMELINE
from links.viewer.stream import LOOPBACK

START_S = 20.0
WINDOW_S = 1.5  # a viewer without a display has exited by then
LOAD_S = 60.0
SETTLE_S = 0.5  # views need a few frames after a change
NOTIFICATION_S = 5.0  # the viewer's notifications cover the views this long


class ViewerMissing(LinkError):
    """The Rerun viewer is not installed, or it cannot draw on this machine."""


def show(url_or_file: str | Path) -> subprocess.Popen[bytes]:
    """Open a viewer window on a serving run (`Viewer.url`) or on an .rrd file; it outlives this process.

    Raises ViewerMissing when the window does not open, LinkError when there is no such file.
    """
    where = str(url_or_file)
    if where.startswith("rerun+"):
        target = ["--connect", where]
    else:
        _check_file(Path(where))
        target = [where]
    process = _start([*target, "--port", "auto"], new_session=True)
    try:
        process.wait(WINDOW_S)
    except subprocess.TimeoutExpired:
        return process
    raise ViewerMissing(
        f"the Rerun viewer could not open a window: is there a display? Open {where} on another machine, "
        "or take a screenshot of a run: grd view RUN.rrd --screenshot run.png"
    )


def screenshot(
    rrd: Path,
    png: Path,
    *,
    at: float = 0.9,
    size: str = "1920x1080",
    wait_s: float = NOTIFICATION_S,
    tab: str | None = None,
) -> list[str]:
    """Draw a recording off-screen, at fraction `at` of its duration, into a PNG. Returns the errors that views report.

    `tab`: name of the tab to draw, such as Fusion; None: the first one.
    Raises ViewerMissing when there is no viewer or no graphics driver, LinkError when the viewer cannot load the file.
    """
    _check_file(rrd)
    with _headless(rrd, size) as viewer:
        state = _wait_until_loaded(viewer, rrd)
        start, end, kind = _span(state, rrd)
        moment_ns = start + round(at * (end - start))
        if kind == "timestamp":
            viewer.set_time(TIMELINE, timestamp=np.datetime64(moment_ns, "ns"), play_state="paused")
        else:
            viewer.set_time(TIMELINE, duration=np.timedelta64(moment_ns, "ns"), play_state="paused")
        if tab is not None:
            _activate(viewer, tab)
        time.sleep(wait_s)
        png.write_bytes(viewer.take_screenshot())
        errors = _view_errors(viewer)
        for _ in _other_tabs(viewer):
            errors += _view_errors(viewer)
        return list(dict.fromkeys(errors))


def _check_file(rrd: Path) -> None:
    if not rrd.is_file():
        raise LinkError(f"{rrd}: no such file; `grd run` and `grd replay` write run.rrd into their folder")


def _view_errors(viewer: ViewerClient) -> list[str]:
    viewer.take_screenshot()  # a view reports on its last frame, and hidden tabs draw nothing
    return [
        f"{view.name}: {report.severity}: {report.summary}{f' ({report.details})' if report.details else ''}"
        for view in viewer.get_state().views
        for report in view.reports
    ]


def _activate(viewer: ViewerClient, tab: str) -> None:
    """Show the tab of this name. LinkError when there is none."""
    read = viewer.get_blueprint()
    containers = {
        key: part["ContainerBlueprint"] for key, part in read.blueprint.items() if "ContainerBlueprint" in part
    }
    names = {container["display_name"]: key for key, container in containers.items() if "display_name" in container}
    if tab not in names:
        raise LinkError(f"no tab '{tab}'; there is {one_of(sorted(names))}")
    for container in containers.values():
        if "active_tab" in container and names[tab] in container.get("contents", []):
            container["active_tab"] = names[tab]
    viewer.set_blueprint(read.blueprint, "recording")


def _other_tabs(viewer: ViewerClient) -> Iterator[int]:
    """Activate the second tab of every tab group, then the third, and so on; yields after each step."""
    read = viewer.get_blueprint()
    containers = [part["ContainerBlueprint"] for part in read.blueprint.values() if "ContainerBlueprint" in part]
    groups = [container for container in containers if "active_tab" in container and container.get("contents")]
    for index in range(1, max((len(group["contents"]) for group in groups), default=0)):
        for group in groups:
            group["active_tab"] = group["contents"][index % len(group["contents"])]
        viewer.set_blueprint(read.blueprint, "recording")
        time.sleep(SETTLE_S)
        yield index


@contextmanager
def _headless(rrd: Path, size: str) -> Iterator[ViewerClient]:
    port = _free_port()
    process = _start([str(rrd), "--headless", "--window-size", size, "--port", str(port)])
    try:
        yield _connect(process, port)
    except (
        ConnectionError,
        RuntimeError,
    ) as error:  # the viewer accepts connections before it looks for a graphics driver
        raise ViewerMissing(
            f"the Rerun viewer stopped ({error}): without a display it needs a Vulkan driver "
            "(Debian/Ubuntu: apt-get install mesa-vulkan-drivers)"
        ) from error
    finally:
        process.terminate()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _start(arguments: list[str], *, new_session: bool = False) -> subprocess.Popen[bytes]:
    package = importlib.util.find_spec("rerun_cli")
    binary = Path(package.origin).with_name("rerun") if package and package.origin else None
    if binary is None or not binary.is_file():
        raise ViewerMissing("the Rerun viewer is not installed: pip install rerun-sdk")
    return subprocess.Popen(
        [str(binary), "--bind", LOOPBACK, "--hide-welcome-screen", *arguments],
        env=os.environ | {"RERUN_APP_ONLY": "true"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=new_session,
    )


def _connect(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    deadline = time.monotonic() + START_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            client.get_state()
            return client
        except (ConnectionError, RuntimeError):
            if process.poll() is not None or time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def _wait_until_loaded(viewer: ViewerClient, rrd: Path) -> ViewerState:
    deadline = time.monotonic() + LOAD_S
    while True:
        state = viewer.get_state()
        if state.active_recording and state.views and not state.loading:
            return state
        errors = [entry.message for entry in viewer.get_logs() if entry.level == "ERROR"]
        if errors or time.monotonic() > deadline:
            why = errors[-1] if errors else f"not loaded within {LOAD_S:.0f} s"
            raise LinkError(
                f"{rrd}: the viewer cannot load it: {why}\n"
                f"If the file is truncated, recover the readable part: rerun rrd merge {rrd} -o recovered.rrd"
            )
        time.sleep(0.1)


def _span(state: ViewerState, rrd: Path) -> tuple[int, int, str]:
    for recording in state.recordings:
        for timeline in recording.timelines:
            if timeline.name == TIMELINE and timeline.start is not None and timeline.end is not None:
                return timeline.start, timeline.end, timeline.time_type
    raise LinkError(f"{rrd}: no data on the timeline {TIMELINE!r}: is the run empty?")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]
