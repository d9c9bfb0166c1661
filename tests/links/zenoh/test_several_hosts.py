"""Edges between hosts, with processes, TLS and the live runner: transfer, rejection, recovery."""

from __future__ import annotations

import importlib.util
import shutil
from socket import SOCK_STREAM

import pytest
from certificates import make_all, need_openssl
from host_processes import HostProcess, write_config, write_hosts
from proxy import Proxy

from tests.links.ports import free_port

needs_zenoh = pytest.mark.skipif(
    importlib.util.find_spec("zenoh") is None, reason="needs Eclipse Zenoh: pip install -e '.[hosts]'"
)
pytestmark = needs_zenoh
DRONE_SIDE = {"beats": "drone", "echo": "vehicle", "sink": "vehicle"}


@pytest.fixture(scope="module")
def signed(tmp_path_factory):
    """A folder with certificates."""
    need_openssl()
    folder = tmp_path_factory.mktemp("certificates")
    make_all(folder)
    return folder


@pytest.fixture
def folder(signed, tmp_path):
    for file in signed.iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path


def test_cycle_through_two_hosts_with_clocks_one_hour_apart(folder):
    """Drone: beats and sink; vehicle: echo. All times are correct in the local time of the reading host."""
    config = write_config(folder)
    hosts = write_hosts(
        folder, f"127.0.0.1:{free_port(SOCK_STREAM)}", {"beats": "drone", "echo": "vehicle", "sink": "drone"}
    )
    with (
        HostProcess(config, hosts, "vehicle", ahead_s=-3600.0) as vehicle,
        HostProcess(config, hosts, "drone") as drone,
    ):
        beats = drone.wait_for("beat", 100)
        there, back = vehicle.report()["counters"]["beats"], drone.report()["counters"]["echo"]
        assert [b["number"] for b in beats] == list(range(beats[0]["number"], beats[0]["number"] + 100))
        wrong_ms = [abs(b["late_ms"] - b["true_late_ms"]) for b in beats]
        assert max(wrong_ms) < 50.0  # two conversions, each within 25 ms
        assert wrong_ms[-1] * 1000 < there["clock uncertainty [us]"] + back["clock uncertainty [us]"] + 1000
        assert {round(b["earlier_ms"], 6) for b in beats} == {1.0}
        assert abs(there["clock offset [us]"] + 3_600_000_000) < 2_000_000
        assert abs(back["clock offset [us]"] - 3_600_000_000) < 2_000_000
        assert there["lost"] == back["lost"] == 0
        assert vehicle.stop() < 4.0
        assert drone.stop() < 4.0


def test_hub_forwards_between_two_hosts(folder):
    config = write_config(folder, every=1)
    hosts = write_hosts(
        folder, f"127.0.0.1:{free_port(SOCK_STREAM)}", {"beats": "drone", "echo": "drone", "sink": "base"}
    )
    with (
        HostProcess(config, hosts, "vehicle", ahead_s=100.0) as vehicle,
        HostProcess(config, hosts, "drone", ahead_s=-50.0),
        HostProcess(config, hosts, "base") as base,
    ):
        beat, image = base.wait_for("beat", 20)[-1], base.wait_for("image")[0]
        assert abs(beat["late_ms"] - beat["true_late_ms"]) < 50.0
        assert abs(image["late_ms"]) < 5000.0
        assert {"echo", "beats", "to_base"} <= set(vehicle.report()["counters"])


def test_certificate_of_another_authority_is_rejected(folder):
    config = write_config(folder)
    listen = f"127.0.0.1:{free_port(SOCK_STREAM)}"
    honest = write_hosts(folder, listen, DRONE_SIDE)
    rogue = write_hosts(folder, listen, DRONE_SIDE, name="rogue.yaml", drone="rogue")
    with HostProcess(config, honest, "vehicle") as vehicle, HostProcess(config, rogue, "drone") as intruder:
        intruder.wait_for("started")
        status = intruder.until_status("to_vehicle", "does not accept the connection")
        assert "of the same authority (ca.pem)?" in status
        assert vehicle.report()["counters"]["beats"]["received"] == 0
        assert vehicle.of("beat") == []
        with HostProcess(config, honest, "drone"):  # the hub still works
            vehicle.wait_for("beat", 3)
        assert intruder.stop() < 4.0


def test_host_cannot_publish_messages_of_another_host(folder):
    """The drone has a valid certificate, but its hosts file places a node of the base on it."""
    config = write_config(folder)
    listen = f"127.0.0.1:{free_port(SOCK_STREAM)}"
    honest = write_hosts(folder, listen, {"beats": "base", "echo": "vehicle", "sink": "vehicle"})
    taken_over = write_hosts(folder, listen, DRONE_SIDE, name="taken_over.yaml")
    posing = write_hosts(folder, listen, {**DRONE_SIDE, "beats": "base"}, name="posing.yaml")
    posing.write_text(posing.read_text().replace("base.pem", "drone.pem").replace("base.key", "drone.key"))
    with HostProcess(config, honest, "vehicle") as vehicle:
        with HostProcess(config, taken_over, "drone") as drone, HostProcess(config, posing, "base") as poser:
            drone.wait_for("started")
            poser.wait_for("started")
            drone.until_status("to_vehicle", "vehicle")
            poser.until_status("to_vehicle", "vehicle")
            assert vehicle.report()["counters"]["beats"]["received"] == 0
            assert vehicle.of("beat") == []
        with HostProcess(config, honest, "base"):
            vehicle.wait_for("beat", 3)


def test_interrupted_connection_recovers(folder):
    """Interrupted longer than Zenoh's lease, during an image. Afterwards only new messages are sent; old ones are counted."""
    config = write_config(folder, rate_hz=50.0, every=5, size_px=512)
    port = free_port(SOCK_STREAM)
    with Proxy(port) as proxy:
        hosts = write_hosts(folder, f"127.0.0.1:{port}", DRONE_SIDE, connect=f"127.0.0.1:{proxy.port}")
        with (
            HostProcess(config, hosts, "vehicle", ahead_s=-3600.0) as vehicle,
            HostProcess(config, hosts, "drone") as drone,
        ):
            vehicle.wait_for("image", 3)
            proxy.interrupt()
            vehicle.until_status("beats", "has not replied for")
            before = drone.report()["counters"]["to_vehicle"]
            proxy.restore()
            newest = vehicle.lines[-1].get("number", 0)
            vehicle.until(lambda line: line["kind"] == "image" and line["number"] > newest + 50)
            beat = vehicle.wait_for("beat", 10)[-1]
            assert before["dropped: beats.image"] >= 10
            assert before["late: beats.beat"] > 0
            assert beat["true_late_ms"] < 2000.0
            assert abs(beat["late_ms"] - beat["true_late_ms"]) < 50.0
            numbers = [line["number"] for line in vehicle.of("beat")]
            assert numbers == sorted(set(numbers))
            vehicle.until_status("beats", None)
            assert drone.stop() < 4.0


def test_restarted_host_is_received(folder):
    """Its clock and message numbers restart: no state of the first run is used."""
    config = write_config(folder)
    hosts = write_hosts(folder, f"127.0.0.1:{free_port(SOCK_STREAM)}", DRONE_SIDE)
    with HostProcess(config, hosts, "vehicle") as vehicle:
        with HostProcess(config, hosts, "drone", ahead_s=1000.0):
            vehicle.until(lambda line: line.get("number", 0) > 200)
        with HostProcess(config, hosts, "drone", ahead_s=-2.0):
            vehicle.until(lambda line: line.get("number", 200) < 200)
            beat = vehicle.wait_for("beat", 20)[-1]
            assert abs(beat["late_ms"] - beat["true_late_ms"]) < 50.0
            assert vehicle.report()["counters"]["beats"]["peer restarts"] == 1


def test_second_hub_on_the_same_port_has_a_status(folder):
    config = write_config(folder)
    hosts = write_hosts(folder, f"127.0.0.1:{free_port(SOCK_STREAM)}", DRONE_SIDE)
    with HostProcess(config, hosts, "vehicle") as first:
        first.wait_for("started")
        with HostProcess(config, hosts, "drone"):
            first.wait_for("beat")
            with HostProcess(config, hosts, "vehicle") as second:
                second.wait_for("started")
                status = second.until_status("beats", "cannot open tls/127.0.0.1:")
    assert "Address already in use" in status
