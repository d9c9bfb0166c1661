"""The simulated rig in real time, for a live run, as a link: it starts the process of the rig, and ends it.

The process (`links.simulated.rig.live_process`) sends what the hardware would: the LiDAR's packets and the vehicle's
odometry by UDP, the servo on a pty, the autopilot's MAVLink by UDP, all on this host. From the graph it receives only
the goals of the servo and the poses for the autopilot. It writes the ground truth to `truth.mcap` and its timing to
`rig.json`, in the folder of the run. It cannot render camera images in real time: it serves those of a recording of the
same flight.

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
from links.runs.shipped import shipped
from stages.geometry.lidar_models import LidarModel
from stages.geometry.rig_lidar import LidarBeams

START_S = 120.0  # limit for building the world and, once, compiling
END_S = 1.0
READY, RIG_REPORT = "ready", "rig.json"

CameraMount = Literal["vehicle", "drone"]
Port = Annotated[int, Field(ge=1, le=65535)]


class LiveRigSettings(Settings):
    """Settings of `LiveRig`."""

    scenario: Path  # as in configs/scenarios/, relative to the working directory
    seed: int | None = Field(None, ge=0)  # None: that of the scenario
    duration_s: float | None = Field(None, gt=0, le=7200)  # None: that of the scenario; after it, motions stand still
    servo: Path  # link to the servo's pty that is created: `$links.servo.config.port`
    lidar_port: int = Field(2368, ge=1, le=65535)
    position_port: int | None = Field(
        None, ge=1, le=65535
    )  # of the LiDAR's position packets; None: none are sent. Only a Velodyne has them
    autopilot_port: int | None = Field(None, ge=1, le=65535)  # where grd receives MAVLink; None: no radio
    lidar_model: LidarModel | None = None  # None: that of the scenario; the mount is the scenario's
    lidar_beams: LidarBeams | None = None  # of one Ouster or Hesai, as in the rig file
    armed: bool = True  # False: its autopilot reports disarmed, as before a flight (`grd preflight` requires that)
    odometry_port: int | None = Field(None, ge=1, le=65535)  # where grd receives odometry; None: none is sent
    images: Path | None = None  # a recording of the scenario, made by `grd simulate`; None: no cameras
    # A recording of the scenario whose LiDAR packets are sent, with their recorded stamps (`clock: free`), in place of
    # cast ones; the servo then moves as recorded. Most of the rig's computing time is ray casting. None: rays are cast.
    packets: Path | None = None
    camera_ports: dict[CameraMount, Port] = Field(
        default_factory=dict[CameraMount, Port]
    )  # http://127.0.0.1:PORT/ of each
    batch_s: float = Field(0.01, gt=0, le=0.1)  # of packets cast together: long batches have more latency, cost less


class LiveRig(Tap[LiveRigSettings]):
    """A simulated rig for the duration of a live run."""

    def __init__(self, settings: LiveRigSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._process: subprocess.Popen[str] | None = None

    def wants(self, message: type[Message]) -> bool:
        """Nothing."""
        return False

    @property
    def status(self) -> str | None:
        """Error text when the rig has ended."""
        process = self._process
        if process is None or process.poll() is None:
            return None
        return "the simulated rig has ended: its scenario is over, or see its message above"

    def open(self, run: Run) -> None:
        """Start the rig and wait until it is ready. LinkError when it does not start. A replay starts nothing."""
        if not run.live:
            return
        settings = self.settings
        scenario = shipped(settings.scenario)
        if not scenario.is_file():
            raise LinkError(f"{settings.scenario}: no such scenario; the path is relative to {Path.cwd()}")
        if settings.images is not None and not settings.images.is_file():
            raise LinkError(
                f"{settings.images}: no such recording, and fisheyes cannot be rendered in real time. Render them "
                f"once, in some minutes: grd simulate {settings.scenario} -o {settings.images}"
            )
        arguments = json.dumps(
            {**settings.model_dump(mode="json"), "scenario": str(scenario), "folder": str(run.out_dir)}
        )
        command = [sys.executable, "-m", "links.simulated.rig.live_process", arguments]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C must reach the run only, which then ends the rig
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
        """End the rig: close its standard input and wait until it has written the ground truth."""
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
