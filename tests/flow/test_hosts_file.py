"""A hosts file: all that is wrong with it at once, each at its line."""

from __future__ import annotations

import pytest

from flow.graph import load_graph
from flow.hosts import part_of
from flow.hosts_file import load_hosts
from flow.problem import ConfigError

CONFIG = """
stages:
  double: {use: toys.Double, inputs: {number: numbers.number}}
  add: {use: toys.Add, config: {name: x}, inputs: {left: double.number, right: double.number, words: words.text}}
links:
  numbers: {use: toys.Numbers}
  words: {use: toys.Words}
  printer: {use: toys.Printer, inputs: {sum: add.sum}}
"""
FILES = "certificate: c.pem, key: k.pem, authority: a.pem"
GOOD = f"""
hosts:
  vehicle: {{listen: "tls/192.168.7.1:7447", {FILES}}}
  drone: {{{FILES}}}
  base: {{connect: "tls/[fe80::1]:7447", {FILES}}}
place: {{numbers: drone, double: drone, words: base, add: vehicle, printer: base}}
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
    """Some node stands for what sends and receives."""

    def receiver(self, hosts, name, hops):
        return hosts.graph.nodes["add"]

    sender = receiver


def problems(load, text, config=CONFIG):
    with pytest.raises(ConfigError) as caught:
        load(text, config)
    return [
        str(p).split("/")[-1] if str(p).count("/") == 1 else str(p).rsplit("hosts.yaml:", 1)[-1]
        for p in caught.value.problems
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


def test_all_that_is_wrong_is_said_at_once_each_at_its_line(load):
    found = problems(
        load,
        f"""hosts:
  vehicle: {{listen: "tcp/192.168.7.1:7447", {FILES}}}
  drone: {{certificate: c.pem, authority: a.pem, pasword: x}}
place:
  numbers: drohne
  doubel: drone
  words: vehicle
sea: {{}}
see:
  printer: [add.sum]
""",
    )
    assert found == [
        """2: hosts.vehicle.listen: must read tls/ADDRESS:PORT, as in tls/192.168.7.1:7447, got 'tcp/192.168.7.1:7447'.""",
        """3: hosts.drone.pasword: unknown key 'pasword'; there is 'listen', 'connect', 'certificate', 'key' or 'authority'.""",
        """3: hosts.drone.key: is missing: the host's key as a PEM file, as seen from this file.""",
        """4: place: say on which host double, add, printer run.""",
        """5: place.numbers: no host 'drohne'; there is 'vehicle' or 'drone'. Did you mean 'drone'?""",
        """6: place.doubel: no stage or link 'doubel'. Did you mean 'double'?""",
        """8: sea: unknown section 'sea'; there is 'hosts', 'place' or 'see'. Did you mean 'see'?""",
        """10: see.printer: no tap 'printer'; the graph has none.""",
    ]


def test_one_host_listens(load):
    two = GOOD.replace("drone: {", 'drone: {listen: "tls/10.0.0.2:1", ')
    none = GOOD.replace('listen: "tls/192.168.7.1:7447", ', "")
    assert "these do: 'vehicle' or 'drone'." in problems(load, two)[0]
    assert "none does." in problems(load, none)[0]


def test_a_name_that_a_sender_needs_is_not_taken(load):
    config = CONFIG.replace("double:", "to_drone:").replace("double.", "to_drone.")
    found = problems(load, GOOD.replace("double:", "to_drone:"), config)
    assert found == ["4: hosts.drone: a node is called 'to_drone' already: rename it or the host."]


def test_a_file_that_is_no_hosts_file_is_refused_in_words(load):
    assert problems(load, "hosts: [a]\nplace: 3\n")[:2] == [
        "1: hosts: must be a mapping.",
        "1: hosts: one host must say 'listen: tls/ADDRESS:PORT', best the vehicle; none does.",
    ]


def test_a_node_that_is_left_out_may_be_placed_and_the_parts_say_so(load):
    config = CONFIG.replace("words: {use: toys.Words}", "words: {use: toys.Words, needs: $rig.radio}")
    hosts = load(GOOD, config)
    assert "words" not in hosts.place
    assert hosts.graph.said_left_out() == ["left out, as nothing stands for $rig.radio: words"]
    assert part_of(hosts, "vehicle", NoEnds()).said_left_out() == hosts.graph.said_left_out()
    nowhere = problems(load, GOOD.replace("words: base", "words: moon"), config)
    assert nowhere == ["6: place.words: no host 'moon'; there is 'vehicle', 'drone' or 'base'."]
