"""A hosts file: its hops, and every error at its line."""

from __future__ import annotations

import pytest

from flow.config.hosts import graph_of_host
from flow.config.hosts_file import load_hosts
from flow.config_error import ConfigError
from flow.graph import load_graph

CONFIG = """
stages:
  double: {use: tests.flow.toys.Double, inputs: {number: numbers.number}}
  add: {use: tests.flow.toys.Add, config: {name: x}, inputs: {left: double.number, right: double.number, words: words.text}}
links:
  numbers: {use: tests.flow.toys.Numbers}
  words: {use: tests.flow.toys.Words}
  printer: {use: tests.flow.toys.Printer, inputs: {sum: add.sum}}
"""
FILES = "certificate: c.pem, key: k.pem, authority: a.pem"
GOOD = f"""
hosts:
  vehicle: {{listen: "tls/192.168.7.1:7447", {FILES}}}
  drone: {{{FILES}}}
  base: {{connect: "tls/[fe80::1]:7447", {FILES}}}
placement: {{numbers: drone, double: drone, words: base, add: vehicle, printer: base}}
"""


@pytest.fixture
def load(tmp_path):
    def load(text, config=CONFIG):
        (tmp_path / "config.yaml").write_text(config)
        file = tmp_path / "hosts.yaml"
        file.write_text(text)
        return load_hosts(file, load_graph(tmp_path / "config.yaml"))

    return load


class NoEnds:
    """Any node in place of a sender or receiver."""

    def receiver(self, hosts, name, hops):
        return hosts.graph.nodes["add"]

    sender = receiver


def errors_of(load, text, config=CONFIG):
    with pytest.raises(ConfigError) as caught:
        load(text, config)
    return [
        str(p).split("/")[-1] if str(p).count("/") == 1 else str(p).rsplit("hosts.yaml:", 1)[-1]
        for p in caught.value.errors
    ]


def test_every_edge_that_crosses_is_one_hop_or_two_over_the_hub(load, tmp_path):
    hosts = load(GOOD)
    hops = {(h.producer, h.output, h.sender, h.receiver) for h in hosts.hops}
    assert hops == {
        ("double", "number", "drone", "vehicle"),
        ("words", "text", "base", "vehicle"),
        ("add", "sum", "vehicle", "base"),
    }
    assert hosts.hub == "vehicle"
    assert hosts.hosts["drone"].endpoint == "tls/192.168.7.1:7447"
    assert hosts.hosts["base"].endpoint == "tls/[fe80::1]:7447"
    assert hosts.hosts["drone"].key == tmp_path / "k.pem"


def test_every_error_is_reported_at_its_line(load):
    found = errors_of(
        load,
        f"""hosts:
  vehicle: {{listen: "tcp/192.168.7.1:7447", {FILES}}}
  drone: {{certificate: c.pem, authority: a.pem, pasword: x}}
placement:
  numbers: drohne
  doubel: drone
  words: vehicle
tap: {{}}
taps:
  printer: [add.sum]
""",
    )
    assert found == [
        """2: hosts.vehicle.listen: must read tls/ADDRESS:PORT, as in tls/192.168.7.1:7447, got 'tcp/192.168.7.1:7447'.""",
        """3: hosts.drone.pasword: unknown key 'pasword'; there is 'listen', 'connect', 'certificate', 'key' or 'authority'.""",
        """3: hosts.drone.key: is missing: the host's key as a PEM file, relative to this file.""",
        """4: placement: has no host for double, add, printer.""",
        """5: placement.numbers: no host 'drohne'; there is 'vehicle' or 'drone'. Did you mean 'drone'?""",
        """6: placement.doubel: no stage or link 'doubel'. Did you mean 'double'?""",
        """8: tap: unknown section 'tap'; there is 'hosts', 'placement' or 'taps'. Did you mean 'taps'?""",
        """10: taps.printer: no tap 'printer'; the graph has none.""",
    ]


def test_exactly_one_host_listens(load):
    two = GOOD.replace("drone: {", 'drone: {listen: "tls/10.0.0.2:1", ')
    none = GOOD.replace('listen: "tls/192.168.7.1:7447", ', "")
    assert "these do: 'vehicle' or 'drone'." in errors_of(load, two)[0]
    assert "none does." in errors_of(load, none)[0]


def test_no_node_has_the_name_of_a_sender(load):
    config = CONFIG.replace("double:", "to_drone:").replace("double.", "to_drone.")
    found = errors_of(load, GOOD.replace("double:", "to_drone:"), config)
    assert found == ["4: hosts.drone: a node has the name 'to_drone' already: rename it or the host."]


def test_a_file_that_is_no_hosts_file_is_an_error(load):
    assert errors_of(load, "hosts: [a]\nplacement: 3\n")[:2] == [
        "1: hosts: must be a mapping.",
        "1: hosts: one host, best the vehicle, must have 'listen: tls/ADDRESS:PORT'; none does.",
    ]


def test_a_node_that_is_left_out_may_have_a_host(load):
    config = CONFIG.replace(
        "words: {use: tests.flow.toys.Words}", "words: {use: tests.flow.toys.Words, needs: $rig.radio}"
    )
    hosts = load(GOOD, config)
    assert "words" not in hosts.placement
    assert hosts.graph.left_out_texts() == ["the configuration has no $rig.radio: words left out"]
    assert graph_of_host(hosts, "vehicle", NoEnds()).left_out_texts() == hosts.graph.left_out_texts()
    found = errors_of(load, GOOD.replace("words: base", "words: moon"), config)
    assert found == ["6: placement.words: no host 'moon'; there is 'vehicle', 'drone' or 'base'."]


def test_a_file_that_is_no_mapping_is_an_error_without_the_sections_of_other_files(load):
    with pytest.raises(ConfigError, match=r"hosts\.yaml:1: must be a mapping at the top, as in 'name: value'\.$"):
        load("- a\n")
