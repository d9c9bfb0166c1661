"""The field configuration against the simulated rig for an hour: no growth of memory, no stop.

    python -m pytest -m slow -s tests/links/test_live_soak.py

GRD_SOAK_S: duration in seconds, 3600 by default. It writes about 2 GB to the temporary folder. GRD_SOAK_IMAGES adds both
cameras: the recording that configs/scenarios/live_street_cameras.yaml describes; then about 12 GB. GRD_SOAK_PACKETS has
the packets and the motion of the servo, so that the rig casts no rays, which takes a core; for 1800 s:

    grd simulate configs/scenarios/live_street.yaml -o out/live_street.mcap --duration 1860 --set 'script=[{do: sweep,
        times: 2}, {do: vibrate, duration_s: 1860, follow_drone: true}]'
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.links.ports import free_ports

pytestmark = pytest.mark.slow
pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")

ROOT = Path(__file__).resolve().parents[2]
SOAK_S = float(os.environ.get("GRD_SOAK_S", "3600"))
IMAGES = os.environ.get("GRD_SOAK_IMAGES")
PACKETS = os.environ.get("GRD_SOAK_PACKETS")
OVERLAY = """\
links:
  sim: {{config: {{duration_s: {duration_s}, autopilot_port: {autopilot}}}}}
  lidar: {{config: {{port: {lidar}, position_port: {position}}}}}
  servo: {{config: {{port: {servo}}}}}
  odometry: {{config: {{port: {odometry}}}}}
  autopilot: {{config: {{connection: "udpin:127.0.0.1:{autopilot}"}}}}
  viewer: {{config: {{port: {viewer}}}}}
"""
WITH_CAMERAS = """\
  camera_vehicle: {{config: {{source: "http://127.0.0.1:{vehicle}/"}}}}
  camera_drone: {{config: {{source: "http://127.0.0.1:{drone}/"}}}}
  sim: {{config: {{images: {images}, camera_ports: {{vehicle: {vehicle}, drone: {drone}}}}}}}
"""
RECORDED_PACKETS = """\
links:
  sim: {{config: {{packets: {packets}, position_port: null}}}}
  lidar: {{config: {{clock: free, position_port: null}}}}
"""


def test_one_hour_without_growth_or_stop(tmp_path):
    names = ("lidar", "position", "odometry", "autopilot", "viewer", "vehicle", "drone")
    ports = dict(zip(names, free_ports(len(names)), strict=True))
    config, overlays = "configs/sim_live.yaml", [OVERLAY]
    if IMAGES is not None:
        config, overlays = "configs/sim_live_cameras.yaml", [OVERLAY, "links:\n" + WITH_CAMERAS]
    if PACKETS is not None:
        overlays.append(RECORDED_PACKETS)
    command = [sys.executable, "-c", "from links.cli import main; main()", "run", config]
    for number, text in enumerate(overlays):
        overlay = tmp_path / f"soak_{number}.yaml"
        values = {
            **ports,
            "servo": tmp_path / "servo",
            "images": IMAGES,
            "packets": PACKETS,
            "duration_s": SOAK_S + 60.0,
        }
        overlay.write_text(text.format(**values))
        command += ["--overlay", str(overlay)]
    command += ["--for", str(SOAK_S), "--out", str(tmp_path / "soak")]
    with (tmp_path / "log.txt").open("w") as log:
        code = subprocess.run(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, check=False).returncode
    assert code == 0, (tmp_path / "log.txt").read_text()[-2_000:]
    summary = json.loads((tmp_path / "soak" / "summary.json").read_text())
    usage = np.array([summary["live"]["usage"][name] for name in ("elapsed_s", "rss_mb", "threads", "files")]).T
    begin, end = usage[usage[:, 0] > 0.25 * SOAK_S][0], usage[-1]
    poses = np.loadtxt(tmp_path / "soak" / "pose_vehicle_drone.tum", usecols=0)
    gaps_s = np.diff(poses)
    lags = {
        name: [edge[f"lag_{key}_ms"] for key in ("p50", "p99", "max")]
        for name, edge in summary["live"]["edges"].items()
        if name.startswith(("autopilot.", "track.pulses", "detect.pulses", "vp", "align"))
    }
    sys.stdout.write(
        f"\n{SOAK_S:.0f} s: {begin[1]:.0f} MB after a quarter, {end[1]:.0f} MB at the end; threads {begin[2]:.0f}, "
        f"{end[2]:.0f}; files {begin[3]:.0f}, {end[3]:.0f}; {len(poses)} poses, gaps p99 "
        f"{1e3 * np.percentile(gaps_s, 99):.0f}, max {1e3 * gaps_s.max():.0f} ms; {summary['poses']['states']}; "
        f"cpu {summary['live']['cpu_s']} s; lag p50, p99, max [ms] {lags}; "
        f"dropped {summary['live']['dropped']}; {summary['truth_errors']}; rig {json.loads((tmp_path / 'soak' / 'rig.json').read_text())}\n"
    )
    assert end[1] < 1.05 * begin[1] + 10.0
    assert end[2] <= begin[2]
    assert end[3] <= begin[3] + 2
    assert len(poses) > 0.98 * 50 * (SOAK_S - 5.0)
