"""The simulated rig in a process of its own, with faults on demand: python -m tests.links.faulty_rig SETTINGS

Each line on standard input is a fault, or its end: `lidar off`, `servo late 0.05 20`, `autopilot reboot`. It says
`ready` when it sends; it ends with its input, and leaves truth.mcap in its folder.
"""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path

from links.simulated.rig.live_process import SWITCH_S, LiveAutopilot, RealTimeRig
from links.simulated.rig.live_rig import LiveRigSettings


class RestartedAutopilot(LiveAutopilot):
    """An autopilot that can boot again: its clock begins anew."""

    booted_ns = 0

    def reboot(self) -> None:
        """Off, and on again at once; `silent` is how long it takes."""
        self.booted_ns = super().device_ns()

    def device_ns(self) -> int:
        return super().device_ns() - self.booted_ns

    def _send(self, message) -> None:
        if self.booted_ns and message.get_type() in ("ATTITUDE", "LOCAL_POSITION_NED"):
            message.time_boot_ms = max(message.time_boot_ms - self.booted_ns // 1_000_000, 0)
        elif self.booted_ns and message.get_type() in ("ODOMETRY", "RAW_IMU"):
            message.time_usec = max(message.time_usec - self.booted_ns // 1_000, 0)
        super()._send(message)


class FaultyRig(RealTimeRig):
    """`do("lidar off")` and so on, from any thread."""

    def __init__(self, rig: LiveRigSettings, folder: Path) -> None:
        super().__init__(rig, folder)
        self.lidar_off = False
        self.radio: RestartedAutopilot | None = None
        cast = self.simulation.batch

        def batch(first_ns: int, packets: int):
            records, true = cast(first_ns, packets)
            return ([] if self.lidar_off else records), true

        self.simulation.batch = batch

    def _autopilot(self, simulation):
        radio = super()._autopilot(simulation)
        if radio is not None:
            radio.__class__ = RestartedAutopilot
        self.radio = radio
        return radio

    def do(self, line: str) -> None:
        who, what, *numbers = line.split()
        if who == "lidar":
            self.lidar_off = what == "off"
        elif who == "autopilot":
            self.radio.silent = what == "off"
            if what == "reboot":
                self.radio.reboot()
        else:
            emulator = self.simulation.emulator
            if what in ("garbage", "bad_crc"):
                getattr(emulator, what)(count=int(numbers[0]))
            elif what == "late":
                emulator.late(float(numbers[0]), int(numbers[1]))
            else:
                getattr(emulator, what)(*map(float, numbers))


def main(settings: str) -> None:
    given = json.loads(settings)
    folder = Path(given.pop("folder"))
    sys.setswitchinterval(SWITCH_S)
    rig, ready = FaultyRig(LiveRigSettings.model_validate(given), folder), threading.Event()
    sending = threading.Thread(target=rig.run, args=(ready,))
    sending.start()
    ready.wait()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in sys.stdin:
        rig.do(line)
    rig.stop.set()
    sending.join()


if __name__ == "__main__":
    main(sys.argv[1])
