"""Preflight of one host of several: connections that are open, absent, or too slow to know the other clock."""

from __future__ import annotations

import dataclasses
import importlib.util
from socket import SOCK_STREAM

import pytest
from certificates import make_all, need_openssl
from host_processes import HostProcess, write_config, write_hosts
from typer.testing import CliRunner

from flow.counters import Counters
from flow.graph import load_graph
from links.cli.app import app
from links.preflight.check_result import Level
from links.zenoh import host_graph
from links.zenoh.checks import connection_check
from links.zenoh.peer_clock import CLOCK_OFFSET, CLOCK_UNCERTAINTY
from tests.links.ports import free_port
from tests.links.preflight.observed import observe

DRONE_SIDE = {"beats": "drone", "echo": "vehicle", "sink": "vehicle"}


@pytest.mark.parametrize(("host", "node"), [("vehicle", "beats"), ("drone", "to_vehicle")])
def test_the_level_follows_the_status_and_the_clock(tmp_path, host, node):
    hosts = write_hosts(tmp_path, "127.0.0.1:7447", DRONE_SIDE)
    link = host_graph(load_graph(write_config(tmp_path)), hosts, host).nodes[node].build()
    source = observe(link, [])

    def checked(status=None, **counters):
        totals = {name.replace("_", " ") + " [us]": value for name, value in counters.items()}
        return connection_check(dataclasses.replace(source, status=status, counters=Counters(totals, {})), "other")

    assert {CLOCK_OFFSET, CLOCK_UNCERTAINTY} == {"clock offset [us]", "clock uncertainty [us]"}
    good = checked(clock_offset=-3_600_000_000, clock_uncertainty=800)
    assert good.level is Level.OK
    assert good.sentence == "other replies; its clock differs by -3600000.0 ms, known to 0.8 ms"
    assert checked(clock_offset=0, clock_uncertainty=25_000).level is Level.OK
    assert checked(clock_offset=0, clock_uncertainty=25_001).level is Level.FAIL
    assert checked().level is Level.FAIL
    assert "run it there too" in checked().sentence
    assert checked("other has not replied for 4 s", clock_offset=0, clock_uncertainty=800).level is Level.FAIL


@pytest.mark.skipif(importlib.util.find_spec("zenoh") is None, reason="needs Eclipse Zenoh: pip install -e '.[hosts]'")
def test_preflight_of_a_host_reports_whether_the_other_one_runs(tmp_path):
    need_openssl()
    make_all(tmp_path)
    config = write_config(tmp_path)
    hosts = write_hosts(tmp_path, f"127.0.0.1:{free_port(SOCK_STREAM)}", DRONE_SIDE)

    def preflight(host):
        options = ["--hosts", str(hosts), "--host", host, "--for", "3.5", "--no-motion"]
        output = CliRunner().invoke(app, ["preflight", str(config), *options]).output
        return {line[:5].strip(): line for line in output.splitlines() if "beats" in line or "to_vehicle" in line}

    alone = preflight("vehicle")
    assert "NO GO beats: drone has not replied for" in " ".join(alone.values()).replace("  ", " ")
    with HostProcess(config, hosts, "vehicle"):
        assert "to_vehicle: vehicle replies; its clock differs by" in preflight("drone")["ok"]
    with HostProcess(config, hosts, "drone", ahead_s=-5.0):
        assert "beats: drone replies; its clock differs by 5000." in preflight("vehicle")["ok"].replace(
            "4999.", "5000."
        )


def test_host_and_recording_contradict_each_other(tmp_path):
    config, hosts = write_config(tmp_path), write_hosts(tmp_path, "127.0.0.1:7447", DRONE_SIDE)
    for options in (["--hosts", str(hosts)], ["--hosts", str(hosts), "--host", "drone", "--recording", "x.mcap"]):
        done = CliRunner().invoke(app, ["preflight", str(config), *options])
        assert done.exit_code == 2, done.output
