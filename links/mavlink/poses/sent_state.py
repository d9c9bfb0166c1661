"""The newest pose that was sent, kept on disk: grd that restarts in flight has to know that poses were sent before.

The next session reports that pose once as a sent frame, with the time at which it was sent. So the decoder compares it
with the autopilot's boot, live and in replay alike (`independence.py`): until the autopilot reboots, its estimate is
not independent. Without a file every start is taken as the first one since the autopilot's boot.

With the pose the autopilot's local frame in `map` is kept (`odom_frame.py`). The next session reports it as the first
received frame, and a stage decides whether it still holds.

Times are host times, and the file has the time of the host's boot on the same clock: while the host has not rebooted,
the next session knows the time of the pose however the wall clock was set in between (`links/clock/host_boot.py`).

Source: ours.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

from links.clock.host_boot import HostBoot, on_own_clock
from links.mavlink.transport.framing import dialect

STALLED_S = 1.0  # a write that takes longer is reported
WRITE_PERIOD_NS = 100_000_000  # period of writing; after a source switch an older frame odom is another one


class SentState:
    """One per run. Reads the file when it is made; `write` is called regularly, by one thread, and may block."""

    def __init__(self, file: Path | None, now_ns: int, boot: HostBoot | None = None) -> None:
        """`boot` None: the clock of all runs is the same, as in virtual time."""
        self._status: str | None = None
        self._writing_s: float | None = None  # since when, on the monotonic clock
        self._file, self._boot = file, boot
        self._newest: tuple[int, bytes] | None = None
        self._odom: bytes | None = None
        self._odom_ns: int | None = None
        self._written_ns: int | None = None
        self._earlier = self._read(now_ns)

    @property
    def status(self) -> str | None:
        """Why the file cannot be read or written."""
        since_s = self._writing_s
        if since_s is not None and time.monotonic() - since_s > STALLED_S:
            return f"{self._file}: the disk does not answer. A restart would not know of sent poses"
        return self._status

    def take_earlier(self) -> tuple[int, bytes, bytes | None] | None:
        """Time and frame of the newest pose of earlier runs, and frame odom in `map` then; None: none, or taken before.

        A link that is reopened has another session of the same run: what this run knew then is not reported.
        """
        earlier, self._earlier = self._earlier, None
        return earlier

    def on_sent(self, frame: bytes, sent_ns: int, odom: Callable[[], bytes | None] = lambda: None) -> None:
        """A pose was sent; `odom`: makes frame odom in `map`, called when it will be written."""
        self._newest = sent_ns, frame
        before_ns = self._odom_ns if self._file is None else self._written_ns
        if before_ns is None or sent_ns - before_ns >= WRITE_PERIOD_NS:
            self._odom, self._odom_ns = odom(), sent_ns

    @property
    def odom(self) -> tuple[int, bytes] | None:
        """Time and frame odom in `map` of this run's newest pose that had one."""
        return None if self._odom is None or self._odom_ns is None else (self._odom_ns, self._odom)

    def write(self) -> None:
        """Write the newest pose, at most once each WRITE_PERIOD_NS. Until it succeeds it is repeated."""
        newest = self._newest
        if self._file is None or newest is None or newest[0] == self._written_ns:
            return
        if self._written_ns is not None and newest[0] - self._written_ns < WRITE_PERIOD_NS:
            return
        partial = self._file.with_suffix(".partial")
        self._writing_s = time.monotonic()
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            fields = {
                "sent_ns": newest[0],
                "boot": self._boot and [self._boot.id, self._boot.at_ns],
                "frame": newest[1].hex(),
                "odom": self._odom and self._odom.hex(),
            }
            partial.write_text(json.dumps(fields), encoding="ascii")
            os.replace(partial, self._file)
        except OSError as error:
            self._status = f"{self._file} cannot be written: {error.strerror}. A restart would not know of sent poses"
        else:
            self._written_ns, self._status = newest[0], None
        finally:
            self._writing_s = None

    def _read(self, now_ns: int) -> tuple[int, bytes, bytes | None] | None:
        """A file that cannot be read counts as a pose sent now."""
        if self._file is None:
            return None
        try:
            fields = json.loads(self._file.read_text(encoding="ascii"))
            sent_ns, frame = int(fields["sent_ns"]), bytes.fromhex(fields["frame"])
            odom, boot = fields.get("odom"), fields.get("boot")
            boot = None if boot is None else HostBoot(str(boot[0]), int(boot[1]))
            sent_ns = max(0, min(on_own_clock(sent_ns, boot, self._boot), now_ns))
            return sent_ns, frame, None if odom is None else bytes.fromhex(odom)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
            self._status = f"{self._file} cannot be read ({error!r}): delete it after a reboot of the autopilot"
            return now_ns, _unknown_pose(), None


def _unknown_pose() -> bytes:
    """An ODOMETRY frame without content."""
    nan = float("nan")
    message = dialect().MAVLink_odometry_message(
        0, 20, 12, nan, nan, nan, [nan] * 4, nan, nan, nan, nan, nan, nan, [nan] * 21, [nan] * 21, 0, 0, -1
    )
    return bytes(message.pack(dialect().MAVLink(None)))
