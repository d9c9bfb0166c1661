"""`grd check` and `grd graph` with a hosts file."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from flow.graph import load_graph
from links.cli.app import app

PAPER = Path(__file__).resolve().parents[3] / "configs" / "paper.yaml"
FILES = "certificate: c.pem, key: k.pem, authority: a.pem"
HOSTS = f"""
hosts:
  vehicle: {{listen: "tls/192.168.7.1:7447", {FILES}}}
  base: {{{FILES}}}
place:
PLACES
see: {{viewer: [track.drone_fix, detect.detections]}}
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


def test_check_tells_what_each_host_runs_and_sends(hosts):
    done = grd("check", PAPER, "--hosts", hosts)
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert lines[1].startswith("vehicle, the hub: runs ")
    assert lines[2:4] == [
        "  to base: track.drone_fix (drop_oldest 512)",
        "  to base: detect.detections (drop_oldest 512)",
    ]
    assert lines[4] == "base: runs viewer"


def test_check_says_at_its_line_what_is_wrong_with_the_hosts_file(hosts):
    hosts.write_text(hosts.read_text().replace("  viewer: base", "  viewer: bas"))
    done = grd("check", PAPER, "--hosts", hosts)
    assert done.exit_code == 1
    assert "place.viewer: no host 'bas'; there is 'vehicle' or 'base'. Did you mean 'base'?" in done.output


def test_graph_draws_a_box_for_each_host_or_the_part_of_one(hosts):
    whole = grd("graph", PAPER, "--hosts", hosts).output
    assert "    subgraph base\n        viewer\n    end\n" in whole
    base = grd("graph", PAPER, "--hosts", hosts, "--host", "base").output
    assert "links.zenoh.Receiver" in base
    assert "stages." not in base
    assert "<svg" in grd("graph", PAPER, "--hosts", hosts, "--host", "vehicle", "--format", "svg").output


def test_graph_says_which_option_is_missing(hosts):
    assert grd("graph", PAPER, "--host", "base").exit_code == 2
    assert grd("graph", PAPER, "--hosts", hosts, "--format", "svg").exit_code == 2


def test_run_says_which_option_is_missing_and_that_a_replay_has_one_host(hosts):
    for options in (["--hosts", hosts], ["--host", "base"]):
        done = grd("run", PAPER, *options)
        assert done.exit_code == 2
        assert "--hosts FILE and --host NAME go together" in done.output
    done = grd("run", PAPER.with_name("quickstart.yaml"), "--hosts", hosts, "--host", "base")
    assert done.exit_code == 2
    assert "--hosts is of live runs" in done.output


def test_run_refuses_a_host_whose_certificates_are_not_there(hosts, tmp_path):
    done = grd("run", PAPER, "--hosts", hosts, "--host", "base", "--no-warm-up", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "c.pem" in done.output
