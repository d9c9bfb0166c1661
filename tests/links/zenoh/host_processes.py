"""Starts hosts as processes, in the network of this machine or in network namespaces, and reads their output."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parents[2]

CONFIG = """
stages:
  echo: {use: example_nodes.Echo, inputs: {beat: beats.beat}}
links:
  beats: {use: example_nodes.Beats, config: {rate_hz: RATE, every: EVERY, size_px: SIZE}}
  sink: {use: example_nodes.PrintSink, inputs: {beat: echo.beat, image: beats.image}}
"""


def write_config(folder: Path, rate_hz: float = 100.0, every: int = 10, size_px: int = 64) -> Path:
    file = folder / "config.yaml"
    file.write_text(CONFIG.replace("RATE", str(rate_hz)).replace("EVERY", str(every)).replace("SIZE", str(size_px)))
    return file


def write_hosts(
    folder: Path,
    listen: str,
    placement: dict[str, str],
    connect: str | None = None,
    name: str = "hosts.yaml",
    drone: str = "drone",
) -> Path:
    files = "certificate: {0}.pem, key: {0}.key, authority: {1}.pem"
    connecting = f", connect: 'tls/{connect}'" if connect else ""
    authority = "ca" if drone == "drone" else f"{drone}_ca"
    text = "hosts:\n"
    text += f"  vehicle: {{listen: 'tls/{listen}', {files.format('vehicle', 'ca')}}}\n"
    text += f"  drone: {{{files.format(drone, 'ca')}{connecting}}}\n".replace("CA", authority)
    text += f"  base: {{{files.format('base', 'ca')}}}\n"
    text += "placement: {" + ", ".join(f"{node}: {host}" for node, host in placement.items()) + "}\n"
    file = folder / name
    file.write_text(text)
    return file


class HostProcess:
    """One host; `lines` is its output so far."""

    def __init__(
        self, config: Path, hosts: Path, name: str, ahead_s: float = 0.0, namespace: str | None = None
    ) -> None:
        inside = ["ip", "netns", "exec", namespace] if namespace else []
        command = [*inside, sys.executable, str(HERE / "run_host.py"), str(config), str(hosts), name, str(ahead_s)]
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}", "OMP_NUM_THREADS": "1"}
        self.name = name
        self.lines: list[dict[str, Any]] = []
        self._unread: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> HostProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait(5)

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            self._unread.put(json.loads(line))
        self._unread.put(None)

    def until(self, condition: Callable[[dict[str, Any]], bool], within_s: float = 60.0) -> dict[str, Any]:
        """The first new line that satisfies the condition."""
        end_s = time.monotonic() + within_s
        while True:
            try:
                line = self._unread.get(timeout=max(end_s - time.monotonic(), 0.001))
            except queue.Empty:
                raise AssertionError(f"{self.name} did not print it within {within_s} s: {self.lines[-3:]}") from None
            if line is None:
                assert self._process.stderr
                raise AssertionError(f"{self.name} ended: {self._process.stderr.read()[-3000:]}")
            self.lines.append(line)
            if condition(line):
                return line

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Lines of one kind so far."""
        return [line for line in self.lines if line["kind"] == kind]

    def wait_for(self, kind: str, count: int = 1, within_s: float = 60.0) -> list[dict[str, Any]]:
        """The next `count` lines of a kind."""
        return [self.until(lambda line: line["kind"] == kind, within_s) for _ in range(count)]

    def report(self) -> dict[str, Any]:
        """Current counters, statuses and events."""
        assert self._process.stdin
        self._process.stdin.write("report\n")
        self._process.stdin.flush()
        return self.wait_for("report")[0]

    def until_status(self, node: str, wanted: str | None, within_s: float = 60.0) -> str | None:
        """The status of a node, once it contains `wanted`; None: once there is none."""
        end_s = time.monotonic() + within_s
        while True:
            status = self.report()["statuses"].get(node)
            if (status is None) == (wanted is None) and (wanted is None or wanted in status):
                return status
            assert time.monotonic() < end_s, f"{self.name}.{node}: {status}"
            time.sleep(0.1)

    def stop(self) -> float:
        """Stop the host as a user does; returns the time it took [s]."""
        assert self._process.stdin
        self._process.stdin.close()
        took_s = self.wait_for("stopped")[0]["took_s"]
        self._process.wait(5)
        return took_s


def can_make_namespaces() -> bool:
    if shutil.which("ip") is None or os.geteuid() != 0:
        return False
    made = (
        subprocess.run(["ip", "netns", "add", f"grd_probe_{os.getpid()}"], capture_output=True, check=False).returncode
        == 0
    )
    if made:
        subprocess.run(["ip", "netns", "del", f"grd_probe_{os.getpid()}"], capture_output=True, check=False)
    return made
