"""The graph of one host: senders and receivers at the edges between hosts, and access control."""

from __future__ import annotations

import json

import pytest
from example_nodes import Beat
from host_processes import write_config, write_hosts

from flow.config.edge import QueueSettings
from flow.config_error import ConfigError
from flow.graph import load_graph
from flow.link import LinkError, Record, Source
from flow.remote.codec import encode
from flow.stage import input_ports, output_ports
from links.zenoh import Receiver, Sender, host_graph
from links.zenoh.envelope import RECORD_HEAD
from links.zenoh.session_settings import SessionSettings, access_control, config_of

PLACEMENT = {"beats": "drone", "echo": "vehicle", "sink": "base"}


@pytest.fixture
def files(tmp_path):
    config = write_config(tmp_path)
    return load_graph(config), write_hosts(tmp_path, "192.168.7.1:7447", PLACEMENT)


def edges(graph):
    return sorted(f"{e.producer}.{e.output} -> {e.consumer}.{e.port}" for e in graph.edges)


def test_drone_runs_its_nodes_and_one_sender(files):
    part = host_graph(*files, "drone")
    assert list(part.nodes) == ["beats", "to_vehicle"]
    assert edges(part) == ["beats.beat -> to_vehicle.beats__beat", "beats.image -> to_vehicle.beats__image"]
    assert {port: cls.__name__ for port, cls in input_ports(part.nodes["to_vehicle"].cls).items()} == {
        "beats__beat": "Beat",
        "beats__image": "Image",
    }
    assert isinstance(part.nodes["to_vehicle"].build(), Sender)
    assert output_ports(part.nodes["to_vehicle"].cls) == {}


def test_hub_forwards_between_the_other_hosts(files):
    part = host_graph(*files, "vehicle")
    assert list(part.nodes) == ["beats", "echo", "to_base"]
    assert edges(part) == [
        "beats.beat -> echo.beat",
        "beats.image -> to_base.beats__image",
        "echo.beat -> to_base.echo__beat",
    ]
    receiver = part.nodes["beats"]
    assert {port: cls.__name__ for port, cls in output_ports(receiver.cls).items()} == {
        "beat": "Beat",
        "image": "Image",
    }
    assert receiver.config["topic"] == "/hosts/beats"
    assert isinstance(receiver.build(), Receiver)
    assert isinstance(receiver.build(), Source)


def test_one_receiver_per_node_of_another_host(files):
    part = host_graph(*files, "base")
    assert set(part.nodes) == {"beats", "echo", "sink"}
    assert edges(part) == ["beats.image -> sink.image", "echo.beat -> sink.beat"]
    assert list(output_ports(part.nodes["beats"].cls)) == ["image"]
    assert part.values["host"] == "base"
    assert set(part.values["links"]) == {"sink"}
    assert part.values["stages"] == {}


def test_sender_inputs_have_the_queue_settings_of_the_edge(files):
    graph, hosts = files
    part = host_graph(graph, hosts, "drone")
    waiting = {edge.port: edge.queue for edge in part.edges}
    assert waiting["beats__image"] == QueueSettings("latest", 1)
    assert waiting["beats__beat"].policy == "drop_oldest"


def test_unknown_host_is_an_error(files):
    with pytest.raises(ConfigError, match=r"no host 'drohne'; there is .* Did you mean 'drone'\?"):
        host_graph(*files, "drohne")


def allowed(config, host, flow, what):
    rules = {rule["id"]: rule for rule in config["rules"]}
    mine = [rules[name] for policy in config["policies"] if policy["subjects"] == [host] for name in policy["rules"]]
    return [key for rule in mine if rule["flows"] == [flow] and rule["messages"] == [what] for key in rule["key_exprs"]]


def test_hub_accepts_only_the_outputs_of_nodes_of_each_host(files):
    session = host_graph(*files, "vehicle").nodes["beats"].config["session"]
    control = access_control(session)
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    assert {rule["permission"] for rule in control["rules"]} == {"allow"}
    assert control["subjects"] == [{"id": h, "cert_common_names": [h]} for h in ("drone", "base")]
    assert allowed(control, "drone", "ingress", "put") == [
        "grd/drone/vehicle/beats/beat",
        "grd/drone/vehicle/beats/image",
    ]
    assert allowed(control, "drone", "ingress", "declare_subscriber") == []
    assert allowed(control, "drone", "egress", "put") == []
    assert allowed(control, "base", "ingress", "put") == []
    assert allowed(control, "base", "ingress", "declare_subscriber") == allowed(control, "base", "egress", "put")
    assert set(allowed(control, "base", "egress", "put")) == {
        "grd/vehicle/base/echo/beat",
        "grd/vehicle/base/beats/image",
    }
    assert allowed(control, "drone", "ingress", "query") == ["grd/clock/vehicle/drone"]
    assert allowed(control, "drone", "ingress", "reply") == ["grd/clock/drone/vehicle"]
    assert not any("*" in key for rule in control["rules"] for key in rule["key_exprs"])


def test_client_accepts_only_the_hub(files):
    session = host_graph(*files, "drone").nodes["to_vehicle"].config["session"]
    control = access_control(session)
    assert [subject["cert_common_names"] for subject in control["subjects"]] == [["vehicle"]]
    assert allowed(control, "vehicle", "ingress", "put") == []


def test_mutual_tls_and_only_the_hub_listens(files, tmp_path):
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


def test_recorded_message_is_decoded_with_the_recorded_clock_offset(files):
    """A replay has no connection: the record contains the clock offset."""
    receiver = host_graph(*files, "vehicle").nodes["beats"].build()
    sent = Beat(stamp_ns=1000, number=3, monotonic=5, earlier_ns=900)
    record = Record("/hosts/beats", 2000, 1500, RECORD_HEAD.pack(500, 7) + encode(sent))
    got = receiver.decode(record)
    assert isinstance(got, Beat)
    assert (got.stamp_ns, got.earlier_ns, got.number, got.monotonic) == (1500, 1400, 3, 5)


def test_invalid_message_is_an_error(files):
    receiver = host_graph(*files, "vehicle").nodes["beats"].build()
    assert isinstance(receiver, Receiver)
    for data in (b"", b"x" * 15, b"\0" * 16, b"\0" * 400):
        with pytest.raises(LinkError, match="/hosts/beats: invalid message from drone"):
            receiver.decode(Record("/hosts/beats", 1, 1, data))


def test_missing_key_file_is_an_error(files, tmp_path):
    pytest.importorskip("zenoh", reason="needs Eclipse Zenoh: pip install -e '.[hosts]'")
    (tmp_path / "drone.pem").touch()
    with (
        pytest.raises(
            LinkError, match=r"drone\.key: No such file .*; links/zenoh/README\.md explains how to create certificates"
        ),
        host_graph(*files, "drone").nodes["to_vehicle"].build().listen(),
    ):
        raise AssertionError("opened without a key")


def test_all_senders_and_receivers_share_one_session(files):
    graph, hosts = files
    sessions = {spec.config["session"] for n, spec in host_graph(graph, hosts, "vehicle").nodes.items() if n != "echo"}
    assert len(sessions) == 1
    assert isinstance(sessions.pop(), SessionSettings)
