"""`grd check` and `grd graph` with a hosts file."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flow.graph import load_graph
from links.cli.app import app
from tests.links.ports import free_port
from tests.links.zenoh.certificates import make_all, need_openssl

ROOT = Path(__file__).resolve().parents[3]
PAPER = ROOT / "configs" / "paper.yaml"
PATIENCE_S = 120.0
FILES = "certificate: c.pem, key: k.pem, authority: a.pem"
HOSTS = f"""
hosts:
  vehicle: {{listen: "tls/192.168.7.1:7447", {FILES}}}
  base: {{{FILES}}}
placement:
PLACES
taps: {{viewer: [track.drone_fix, detect.detections]}}
"""


@pytest.fixture
def hosts(tmp_path):
    file = tmp_path / "hosts.yaml"
    nodes = load_graph(PAPER).nodes
    places = "\n".join(f"  {node}: {'base' if node == 'viewer' else 'vehicle'}" for node in nodes)
    file.write_text(HOSTS.replace("PLACES", places))
    return file


def grd(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_check_lists_what_each_host_runs_and_sends(hosts):
    done = grd("check", PAPER, "--hosts", hosts)
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert lines[1].startswith("vehicle, the hub: runs ")
    assert lines[2:4] == [
        "  to base: track.drone_fix (drop_oldest 512)",
        "  to base: detect.detections (drop_oldest 512)",
    ]
    assert lines[4] == "base: runs viewer"


def test_check_reports_errors_of_the_hosts_file_with_their_line(hosts):
    hosts.write_text(hosts.read_text().replace("  viewer: base", "  viewer: bas"))
    done = grd("check", PAPER, "--hosts", hosts)
    assert done.exit_code == 1
    assert "placement.viewer: no host 'bas'; there is 'vehicle' or 'base'. Did you mean 'base'?" in done.output


def test_graph_draws_a_box_for_each_host_or_the_part_of_one(hosts):
    whole = grd("graph", PAPER, "--hosts", hosts).output
    assert "    subgraph base\n        viewer\n    end\n" in whole
    base = grd("graph", PAPER, "--hosts", hosts, "--host", "base").output
    assert "links.zenoh.Receiver" in base
    assert "stages." not in base
    assert "<svg" in grd("graph", PAPER, "--hosts", hosts, "--host", "vehicle", "--format", "svg").output


def test_graph_reports_a_missing_option(hosts):
    assert grd("graph", PAPER, "--host", "base").exit_code == 2
    assert grd("graph", PAPER, "--hosts", hosts, "--format", "svg").exit_code == 2


def test_run_reports_a_missing_option_and_that_a_replay_has_one_host(hosts):
    for options in (["--hosts", hosts], ["--host", "base"]):
        done = grd("run", PAPER, *options)
        assert done.exit_code == 2
        assert "--hosts FILE and --host NAME go together" in done.output
    done = grd("run", PAPER.with_name("quickstart.yaml"), "--hosts", hosts, "--host", "base")
    assert done.exit_code == 2
    assert "--hosts is for live runs" in done.output


def test_run_rejects_a_host_without_certificates(hosts, tmp_path):
    done = grd("run", PAPER, "--hosts", hosts, "--host", "base", "--no-warm-up", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "c.pem" in done.output


CROSSING = """\
stages:
  ticker: {use: tests.flow.live_toys.Ticker, inputs: {tick: clock.tick}}
  order: {use: tests.flow.live_toys.Order, inputs: {left: ticker.number, right: ticker.number}}
links:
  clock: {use: links.clock.Clock, config: {rate_hz: 50}}
  recorder: {use: links.recording.Recorder}
"""
PLACE = "placement: {clock: vehicle, ticker: vehicle, order: base, recorder: base}\n"


def test_two_commands_run_one_graph_on_two_hosts(tmp_path):
    """The user's own way: the same files, a command on each host; here both are processes of this one."""
    pytest.importorskip("zenoh", reason="several hosts need eclipse-zenoh: pip install -e '.[hosts]'")
    need_openssl()
    make_all(tmp_path)
    files = "certificate: {0}.pem, key: {0}.key, authority: ca.pem"
    vehicle = f"vehicle: {{listen: 'tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}', {files.format('vehicle')}}}"
    (tmp_path / "hosts.yaml").write_text(f"hosts:\n  {vehicle}\n  base: {{{files.format('base')}}}\n{PLACE}")
    (tmp_path / "ticks.yaml").write_text(CROSSING)
    running = {}
    for host in ("vehicle", "base"):
        command = [sys.executable, "-c", "from links.cli import main; main()", "run", str(tmp_path / "ticks.yaml")]
        command += ["--hosts", str(tmp_path / "hosts.yaml"), "--host", host, "--no-warm-up"]
        running[host] = subprocess.Popen(
            [*command, "--out", str(tmp_path / host)], cwd=ROOT, env={**os.environ, "PYTHONPATH": "."},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
    wait_for_numbers(tmp_path / "base" / "flight.mcap", running)
    for child in running.values():
        child.send_signal(signal.SIGINT)
    output = {host: child.communicate(timeout=PATIENCE_S)[0] for host, child in running.items()}
    assert [child.returncode for child in running.values()] == [0, 0], output
    summary = {host: json.loads((tmp_path / host / "summary.json").read_text()) for host in running}
    assert summary["vehicle"]["messages"]["ticker.number"] > 10
    assert summary["base"]["messages"]["order.number"] > 10
    assert summary["base"]["counters"]["ticker"]["received"] > 10
    again = grd("replay", tmp_path / "base" / "flight.mcap", "--as-live", "--trust", "--out", tmp_path / "again")
    assert again.exit_code == 2
    assert "was recorded on host 'base' of a run on several hosts" in again.output.replace("\n", " ")


def wait_for_numbers(recording, running):
    """Until the base has recorded some that came over the line."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        for host, child in running.items():
            assert child.poll() is None, f"{host}: {child.communicate()[0]}"
        if recording.is_file() and recording.stat().st_size > 4000:
            return
        threading.Event().wait(0.1)
    pytest.fail("nothing came over the line")


def test_the_committed_hosts_file_assigns_all_nodes_of_the_field_configuration():
    field = PAPER.with_name("field.yaml")
    done = grd("check", field, "--hosts", ROOT / "deploy" / "hosts.yaml")
    assert done.exit_code == 0, done.output
    assert "drone: runs camera_drone, drone_odometry, vp_drone" in done.output
    assert "image" not in done.output.partition("vehicle, the hub")[2], "no images cross"
