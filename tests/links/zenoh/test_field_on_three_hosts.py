"""The field configuration against the simulated rig on three hosts: vehicle, drone with autopilot, and a base station.

    python -m pytest -m slow -s tests/links/zenoh/test_field_on_three_hosts.py

Three processes of this machine with separate certificates, each started by `grd run`. The autopilot's messages are sent
to the vehicle, the fused poses back to the drone, and the tapped messages to the base. With both cameras, the drone's
vanishing points and odometry on the drone's host: GRD_SOAK_IMAGES, as in tests/links/test_live_soak.py.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from flow.graph import load_graph
from tests.links.ports import free_port, free_ports
from tests.links.zenoh.certificates import make_all, need_openssl

pytestmark = pytest.mark.slow
pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")
pytest.importorskip("zenoh", reason="several hosts need eclipse-zenoh: pip install -e '.[hosts]'")

ROOT = Path(__file__).resolve().parents[3]
IMAGES = os.environ.get("GRD_SOAK_IMAGES")
FLIGHT_S, TIMEOUT_S = 45.0, 240.0
ON_DRONE = {"autopilot", "camera_drone", "vp_drone", "drone_odometry"}


def overlay(folder: Path) -> dict:
    names = ("lidar", "position", "odometry", "autopilot", "viewer", "vehicle", "drone")
    ports = dict(zip(names, free_ports(len(names)), strict=True))
    links = {
        "sim": {"autopilot_port": ports["autopilot"], "duration_s": TIMEOUT_S},
        "lidar": {"port": ports["lidar"], "position_port": ports["position"]},
        "servo": {"port": str(folder / "servo")},
        "odometry": {"port": ports["odometry"]},
        "autopilot": {"connection": f"udpin:127.0.0.1:{ports['autopilot']}"},
        "viewer": {"port": ports["viewer"], "file": "run.rrd"},
    }
    if IMAGES is not None:
        cameras = {name: ports[name] for name in ("vehicle", "drone")}
        links["sim"] |= {"images": str(Path(IMAGES).resolve()), "camera_ports": cameras}
        links |= {f"camera_{name}": {"source": f"http://127.0.0.1:{port}/"} for name, port in cameras.items()}
    return {"links": {name: {"config": config} for name, config in links.items()}}


def test_field_configuration_on_three_hosts(tmp_path):
    need_openssl()
    make_all(tmp_path)
    config = ROOT / "configs" / ("sim_live.yaml" if IMAGES is None else "sim_live_cameras.yaml")
    (tmp_path / "overlay.yaml").write_text(yaml.safe_dump(overlay(tmp_path)))
    host = {
        name: {"certificate": f"{name}.pem", "key": f"{name}.key", "authority": "ca.pem"}
        for name in ("vehicle", "drone", "base")
    }
    host["vehicle"]["listen"] = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    nodes = load_graph(config, overlays=[tmp_path / "overlay.yaml"]).nodes
    placement = {name: "drone" if name in ON_DRONE else "base" if name == "viewer" else "vehicle" for name in nodes}
    taps = {"viewer": ["fuse.relative_pose", "track.track_state", "track.drone_fix"]}
    (tmp_path / "hosts.yaml").write_text(yaml.safe_dump({"hosts": host, "placement": placement, "taps": taps}))
    running = {}
    for name in host:
        command = [sys.executable, "-c", "from links.cli import main; main()", "run", str(config)]
        command += ["--overlay", str(tmp_path / "overlay.yaml"), "--out", str(tmp_path / f"on_{name}")]
        command += ["--hosts", str(tmp_path / "hosts.yaml"), "--host", name]
        with (tmp_path / f"{name}.txt").open("w") as log:
            running[name] = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)
    flight, deadline_s = tmp_path / "on_vehicle" / "pose_vehicle_drone.tum", time.monotonic() + TIMEOUT_S
    while not (flight.exists() and flight.stat().st_size > 2000):  # the first position
        assert all(process.poll() is None for process in running.values()), logs(tmp_path)
        assert time.monotonic() < deadline_s, logs(tmp_path)
        time.sleep(0.2)
    time.sleep(FLIGHT_S)
    for process in running.values():
        process.send_signal(signal.SIGINT)
    assert [process.wait(60) for process in running.values()] == [0, 0, 0], logs(tmp_path)
    summaries = {name: json.loads((tmp_path / f"on_{name}" / "summary.json").read_text()) for name in running}
    poses, sent = summaries["vehicle"]["poses"]["states"], summaries["drone"]["counters"]["autopilot"]
    counters = {name: summaries[name]["counters"] for name in running}
    sys.stdout.write(f"\n{poses}\n{summaries['vehicle']['truth_errors']}\n{json.dumps(counters, indent=1)}\n")
    assert poses.get("FULL", 0) > 300
    assert summaries["vehicle"]["truth_errors"]["rmse_3d_m"] < 0.15
    assert sent["sent: ODOMETRY"] > 200, "accurate poses are sent to the autopilot"
    assert summaries["base"]["counters"]["fuse"]["received"] > 1000
    assert (tmp_path / "on_base" / "run.rrd").stat().st_size > 10_000


def logs(folder: Path) -> str:
    return "\n".join(f"{file.name}: {file.read_text()[-1500:]}" for file in sorted(folder.glob("*.txt")))
