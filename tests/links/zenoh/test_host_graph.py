"""The graph that one host runs: which nodes stand at the ends of the edges that cross, and who may say what."""

from __future__ import annotations

import json

import pytest
from crossing_toys import Beat
from hosts_running import write_config, write_hosts

from flow.config.edge import QueueSettings
from flow.config_error import ConfigError
from flow.graph import load_graph
from flow.link import LinkError, Record, Source
from flow.remote.codec import encode
from flow.stage import input_ports, output_ports
from links.zenoh import Receiver, Sender, host_graph
from links.zenoh.session import Session, access_control, config_of
from links.zenoh.wire import RECORD_HEAD

PLACE = {"beats": "drone", "echo": "vehicle", "teller": "base"}


@pytest.fixture
def files(tmp_path):
    config = write_config(tmp_path)
    return load_graph(config), write_hosts(tmp_path, "192.168.7.1:7447", PLACE)


def wires(graph):
    return sorted(f"{e.producer}.{e.output} -> {e.consumer}.{e.port}" for e in graph.edges)


def test_the_drone_runs_its_own_nodes_and_one_sender(files):
    part = host_graph(*files, "drone")
    assert list(part.nodes) == ["beats", "to_vehicle"]
    assert wires(part) == ["beats.beat -> to_vehicle.beats__beat", "beats.picture -> to_vehicle.beats__picture"]
    assert {port: cls.__name__ for port, cls in input_ports(part.nodes["to_vehicle"].cls).items()} == {
        "beats__beat": "Beat",
        "beats__picture": "Picture",
    }
    assert isinstance(part.nodes["to_vehicle"].build(), Sender)
    assert output_ports(part.nodes["to_vehicle"].cls) == {}


def test_the_hub_stands_between_the_others_with_every_edge_under_its_own_name(files):
    part = host_graph(*files, "vehicle")
    assert list(part.nodes) == ["beats", "echo", "to_base"]
    assert wires(part) == [
        "beats.beat -> echo.beat",
        "beats.picture -> to_base.beats__picture",
        "echo.beat -> to_base.echo__beat",
    ]
    receiver = part.nodes["beats"]
    assert {port: cls.__name__ for port, cls in output_ports(receiver.cls).items()} == {
        "beat": "Beat",
        "picture": "Picture",
    }
    assert receiver.config["topic"] == "/hosts/beats"
    assert isinstance(receiver.build(), Receiver)
    assert isinstance(receiver.build(), Source)


def test_a_receiver_stands_for_each_node_that_is_listened_to(files):
    part = host_graph(*files, "base")
    assert set(part.nodes) == {"beats", "echo", "teller"}
    assert wires(part) == ["beats.picture -> teller.picture", "echo.beat -> teller.beat"]
    assert list(output_ports(part.nodes["beats"].cls)) == ["picture"]
    assert part.values["host"] == "base"
    assert set(part.values["links"]) == {"teller"}
    assert part.values["stages"] == {}


def test_how_messages_wait_is_the_edge_s_own(files):
    graph, hosts = files
    part = host_graph(graph, hosts, "drone")
    waiting = {edge.port: edge.queue for edge in part.edges}
    assert waiting["beats__picture"] == QueueSettings("latest", 1)
    assert waiting["beats__beat"].policy == "drop_oldest"


def test_a_host_that_there_is_not_is_named(files):
    with pytest.raises(ConfigError, match=r"no host 'drohne'; there is .* Did you mean 'drone'\?"):
        host_graph(*files, "drohne")


def allowed(config, host, flow, what):
    rules = {rule["id"]: rule for rule in config["rules"]}
    mine = [rules[name] for policy in config["policies"] if policy["subjects"] == [host] for name in policy["rules"]]
    return [key for rule in mine if rule["flows"] == [flow] and rule["messages"] == [what] for key in rule["key_exprs"]]


def test_the_hub_lets_each_host_say_its_own_nodes_outputs_and_nothing_else(files):
    session = host_graph(*files, "vehicle").nodes["beats"].config["session"]
    control = access_control(session)
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    assert {rule["permission"] for rule in control["rules"]} == {"allow"}
    assert control["subjects"] == [{"id": h, "cert_common_names": [h]} for h in ("drone", "base")]
    assert allowed(control, "drone", "ingress", "put") == [
        "grd/drone/vehicle/beats/beat",
        "grd/drone/vehicle/beats/picture",
    ]
    assert allowed(control, "drone", "ingress", "declare_subscriber") == []
    assert allowed(control, "drone", "egress", "put") == []
    assert allowed(control, "base", "ingress", "put") == []
    assert allowed(control, "base", "ingress", "declare_subscriber") == allowed(control, "base", "egress", "put")
    assert set(allowed(control, "base", "egress", "put")) == {
        "grd/vehicle/base/echo/beat",
        "grd/vehicle/base/beats/picture",
    }
    assert allowed(control, "drone", "ingress", "query") == ["grd/clock/vehicle/drone"]
    assert allowed(control, "drone", "ingress", "reply") == ["grd/clock/drone/vehicle"]
    assert not any("*" in key for rule in control["rules"] for key in rule["key_exprs"])


def test_a_host_that_connects_believes_the_hub_alone(files):
    session = host_graph(*files, "drone").nodes["to_vehicle"].config["session"]
    control = access_control(session)
    assert [subject["cert_common_names"] for subject in control["subjects"]] == [["vehicle"]]
    assert allowed(control, "vehicle", "ingress", "put") == []


def test_tls_shows_certificates_both_ways_and_only_the_hub_listens(files, tmp_path):
    graph, hosts = files
    hub = config_of(host_graph(graph, hosts, "vehicle").nodes["beats"].config["session"])
    drone = config_of(host_graph(graph, hosts, "drone").nodes["to_vehicle"].config["session"])
    for config, name in ((hub, "vehicle"), (drone, "drone")):
        link = config["transport"]["link"]
        assert link["protocols"] == ["tls"]
        assert link["tls"]["enable_mtls"]
        assert link["tls"]["verify_name_on_connect"]
        assert link["tls"]["connect_private_key"] == str(tmp_path / f"{name}.key")
        assert not config["scouting"]["multicast"]["enabled"]
        assert not config["scouting"]["gossip"]["enabled"]
        json.dumps(config)
    assert (hub["mode"], hub["listen"]["endpoints"]) == ("router", ["tls/192.168.7.1:7447"])
    assert (drone["mode"], drone["listen"]["endpoints"]) == ("client", [])
    assert drone["connect"]["endpoints"] == ["tls/192.168.7.1:7447"]


def test_a_recorded_message_is_decoded_with_the_difference_of_its_moment(files):
    """A replay knows no other host: all that it needs stands in the record."""
    receiver = host_graph(*files, "vehicle").nodes["beats"].build()
    sent = Beat(stamp_ns=1000, number=3, monotonic=5, earlier_ns=900)
    record = Record("/hosts/beats", 2000, 1500, RECORD_HEAD.pack(500, 7) + encode(sent))
    got = receiver.decode(record)
    assert isinstance(got, Beat)
    assert (got.stamp_ns, got.earlier_ns, got.number, got.monotonic) == (1500, 1400, 3, 5)


def test_bytes_that_are_no_message_are_refused_in_words(files):
    receiver = host_graph(*files, "vehicle").nodes["beats"].build()
    assert isinstance(receiver, Receiver)
    for data in (b"", b"x" * 15, b"\0" * 16, b"\0" * 400):
        with pytest.raises(LinkError, match="/hosts/beats: what drone sent is refused"):
            receiver.decode(Record("/hosts/beats", 1, 1, data))


def test_a_missing_key_is_said_in_words(files, tmp_path):
    pytest.importorskip("zenoh", reason="needs Eclipse Zenoh: pip install -e '.[hosts]'")
    (tmp_path / "drone.pem").touch()
    with (
        pytest.raises(
            LinkError, match=r"drone\.key: No such file .*; links/zenoh/README\.md says how to make certificates"
        ),
        host_graph(*files, "drone").nodes["to_vehicle"].build().listen(),
    ):
        raise AssertionError("it opened without a key")


def test_a_session_s_settings_are_what_connections_are_shared_by(files):
    graph, hosts = files
    sessions = {spec.config["session"] for n, spec in host_graph(graph, hosts, "vehicle").nodes.items() if n != "echo"}
    assert len(sessions) == 1
    assert isinstance(sessions.pop(), Session)
