"""The simulated rig in real time, beside a live run, as a link: it starts the rig's process, and ends it.

The process (`links.simulated.rig.live_process`) sends what the hardware would: VLP-16 packets and the vehicle's
odometry by UDP, the servo on a pty, the autopilot's MAVLink by UDP, all on this host. It hears nothing of the graph but
the
servo's goals and the poses that go to the autopilot. What was true goes to `truth.mcap` in the run's folder, how well
it kept up to `rig.json`. Cameras it cannot paint in time: it serves the images of a recording of the same flight.

Source: ours.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from flow.link import LinkError, Run, Tap
from flow.message import Message
from flow.stage import Settings

START_S = 120.0  # to build the world and, once, to compile
END_S = 1.0
READY, RIG_REPORT = "ready", "rig.json"

Carrier = Literal["vehicle", "drone"]
Port = Annotated[int, Field(ge=1, le=65535)]


class LiveRigSettings(Settings):
    """Settings of `LiveRig`."""

    scenario: Path  # as in configs/scenarios/, as seen from where grd is started
    seed: int | None = Field(None, ge=0)  # None: the scenario's
    duration_s: float | None = Field(None, gt=0, le=7200)  # None: the scenario's; longer, all stays where it ended
    servo: Path  # where the link to the servo's pty is made: `$links.servo.config.port`
    lidar_port: int = Field(2368, ge=1, le=65535)
    position_port: int | None = Field(None, ge=1, le=65535)  # of the LiDAR's position packets; None: it sends none
    autopilot_port: int | None = Field(None, ge=1, le=65535)  # where grd hears it; None: the drone has no radio
    armed: bool = True  # False: its autopilot says disarmed, as before a flight (`grd preflight` asks for that)
    odometry_port: int | None = Field(None, ge=1, le=65535)  # where grd hears the vehicle; None: it has no odometry
    images: Path | None = None  # a recording of the scenario, made by `grd simulate`; None: no cameras
    camera_ports: dict[Carrier, Port] = Field(default_factory=dict[Carrier, Port])  # http://127.0.0.1:PORT/ of each
    batch_packets: int = Field(8, ge=1, le=64)  # cast together: fewer come sooner, more cost less


class LiveRig(Tap[LiveRigSettings]):
    """A simulated rig, for the time of a live run."""

    def __init__(self, settings: LiveRigSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._process: subprocess.Popen[str] | None = None

    def wants(self, message: type[Message]) -> bool:
        """Nothing."""
        return False

    @property
    def trouble(self) -> str | None:
        """That the rig has ended, by itself or not."""
        process = self._process
        if process is None or process.poll() is None:
            return None
        return "the simulated rig has ended: its scenario is over, or see its message above"

    def open(self, run: Run) -> None:
        """Start the rig and wait until it is ready. LinkError when it does not come up; nothing in a replay."""
        if not run.live:
            return
        settings = self.settings
        if not settings.scenario.is_file():
            raise LinkError(f"{settings.scenario}: no such scenario; its name is as seen from here, {Path.cwd()}")
        if settings.images is not None and not settings.images.is_file():
            raise LinkError(
                f"{settings.images}: no such recording, and fisheyes cannot be painted in real time. Paint them "
                f"once, in some minutes: grd simulate {settings.scenario} -o {settings.images}"
            )
        asked = json.dumps({**settings.model_dump(mode="json"), "folder": str(run.out_dir)})
        command = [sys.executable, "-m", "links.simulated.rig.live_process", asked]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for the run, which ends the rig in order
        )
        assert self._process.stdout is not None
        deadline_s = time.monotonic() + START_S
        while self._process.poll() is None and time.monotonic() < deadline_s:
            if select.select([self._process.stdout], [], [], 0.1)[0]:
                if self._process.stdout.readline().strip() == READY:
                    return
                break
        self.close()
        raise LinkError(f"the simulated rig for {settings.scenario} did not start; see its message above")

    def close(self) -> None:
        """End the rig: its standard input ends, and it writes what was true."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()
