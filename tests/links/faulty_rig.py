"""The simulated rig as a process with faults on demand: python -m tests.links.faulty_rig SETTINGS

Each line on standard input starts or ends a fault: `lidar off`, `servo late 0.05 20`, `autopilot reboot`. The process
prints `ready` when it sends, ends with its input, and writes truth.mcap in its folder.
"""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path

from links.simulated.rig.live_process import SWITCH_S, LiveAutopilot, RealTimeRig
from links.simulated.rig.live_rig import LiveRigSettings


class RestartedAutopilot(LiveAutopilot):
    """An autopilot that can reboot, which resets its clock."""

    booted_ns = 0

    def reboot(self) -> None:
        """Reset the clock; `silent` stops the messages meanwhile."""
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
    """A rig with faults: `do("lidar off")` from any thread."""

    def __init__(self, rig: LiveRigSettings, folder: Path) -> None:
        super().__init__(rig, folder)
        self.lidar_off = False
        self.radio: RestartedAutopilot | None = None
        simulate = self.simulation.batch

        def batch(first_ns: int, packets: int):
            records, true = simulate(first_ns, packets)
            return ([] if self.lidar_off else records), true

        self.simulation.batch = batch

    def _autopilot(self, simulation):
        radio = super()._autopilot(simulation)
        if radio is not None:
            radio.__class__ = RestartedAutopilot
        self.radio = radio
        return radio

    def do(self, line: str) -> None:
        device, action, *numbers = line.split()
        if device == "lidar":
            self.lidar_off = action == "off"
        elif device == "autopilot":
            self.radio.silent = action == "off"
            if action == "reboot":
                self.radio.reboot()
        else:
            emulator = self.simulation.emulator
            if action in ("garbage", "bad_crc"):
                getattr(emulator, action)(count=int(numbers[0]))
            elif action == "late":
                emulator.late(float(numbers[0]), int(numbers[1]))
            else:
                getattr(emulator, action)(*map(float, numbers))


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
