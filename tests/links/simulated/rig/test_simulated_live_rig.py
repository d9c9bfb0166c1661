"""The simulated rig in real time: real packets, a real pty, and rays that follow the servo."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from flow.link import LinkError, Run
from links.clock import host_time
from links.dynamixel import Servo
from links.lidar import Lidar
from links.recording import RecordingReader
from links.simulated import LiveRig
from stages.messages import ServoGoal
from tests.links.ports import free_ports

ROOT = Path(__file__).resolve().parents[4]
PATIENCE_S = 120.0
SCENARIO = """\
version: 1
name: live_small
start_utc: 2025-06-01T10:20:30Z
duration_s: 60.0
scene: {kind: open_lot}
drone:
  path: {waypoints: [{t_s: 0.0, xyz_m: [5.0, 2.0, 9.0]}]}
vehicle_odometry: {}
"""


@pytest.fixture
def ports():
    return tuple(free_ports(2))


def run_of(folder: Path, live: bool = True) -> Run:
    return Run(folder, "sim", "", "", live)


def test_a_replay_starts_no_rig(tmp_path):
    rig = LiveRig(scenario=tmp_path / "none.yaml", servo=tmp_path / "servo")
    rig.open(run_of(tmp_path, live=False))
    assert rig.status is None
    rig.close()


def test_a_missing_or_wrong_scenario_is_an_error(tmp_path, capfd):
    with pytest.raises(LinkError, match=r"none.yaml: no such scenario; the path is relative to"):
        LiveRig(scenario=tmp_path / "none.yaml", servo=tmp_path / "servo").open(run_of(tmp_path))
    (tmp_path / "bad.yaml").write_text(SCENARIO.replace("open_lot", "moon"))
    with pytest.raises(LinkError, match=r"the simulated rig for .*bad.yaml did not start; see its message above"):
        LiveRig(scenario=tmp_path / "bad.yaml", servo=tmp_path / "servo").open(run_of(tmp_path))
    assert "scene.kind: must be 'street'" in capfd.readouterr().err


def test_the_rig_sends_current_packets_and_its_rays_follow_the_servo(tmp_path, ports):
    pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")
    from links.simulated.rig.live_process import RealTimeRig
    from links.simulated.rig.live_rig import LiveRigSettings

    (tmp_path / "small.yaml").write_text(SCENARIO)
    lidar_port, odometry_port = ports
    settings = LiveRigSettings(
        scenario=tmp_path / "small.yaml", servo=tmp_path / "servo", lidar_port=lidar_port, odometry_port=odometry_port
    )
    rig, ready = RealTimeRig(settings, tmp_path), threading.Event()
    sending = threading.Thread(target=rig.run, args=(ready,), daemon=True)
    lidar, servo = (
        Lidar(port=lidar_port, timeout_s=60, slice_ms=0.1),
        Servo(port=str(tmp_path / "servo"), start_timeout_s=60),
    )
    with lidar.listen() as packets:
        sending.start()
        assert ready.wait(PATIENCE_S)
        firings = [lidar.decode(next(packets)) for _ in range(30)]
        assert all(f is not None and len(f.pulse_stamp_ns) == 384 for f in firings)
        with servo.listen() as states:
            goal = ServoGoal(stamp_ns=0, position_rad=math.pi / 2, speed_radps=5.0)
            began_s = sent_s = time.monotonic()
            servo.on_goal(goal)
            while abs(servo.decode(next(states)).position_rad - math.pi / 2) > 0.01:
                if time.monotonic() > sent_s + 1.0:  # a busy host stops the servo by its watchdog: send again
                    sent_s = time.monotonic()
                    servo.on_goal(goal)
                assert sent_s < began_s + PATIENCE_S
            now_ns = rig.simulation.now_ns()
            angle_rad = rig.simulation.emulator.output_rad(np.array([now_ns]))
            R_now, _ = rig.simulation.T_world_lidar(np.array([now_ns]))
    rig.stop.set()
    sending.join(PATIENCE_S)
    R_start, _ = rig.simulation.T_world_lidar_at(np.array([now_ns]), np.zeros(1))
    output_rad = math.acos((np.trace(R_start[0].T @ R_now[0]) - 1) / 2)
    assert output_rad == pytest.approx(math.pi / 2, abs=0.02)
    assert angle_rad[0] == pytest.approx(math.pi / 2, abs=0.02)
    report = json.loads((tmp_path / "rig.json").read_text())
    assert report["packets"] >= 30
    with RecordingReader(tmp_path / "truth.mcap") as truth:
        poses = list(truth.records(["/truth/drone"]))
    assert abs(poses[-1].stamp_ns - host_time.now_ns()) < 3600 * 10**9, "ground truth has the host's time"
    assert json.loads(poses[0].data)["xyz_m"] == [5.0, 2.0, 9.0]


OS1_32, OS0_32_DUAL = (
    yaml.safe_load((ROOT / "configs" / "rigs" / f"{name}_example.yaml").read_text())["rig"]["lidar"]
    for name in ("os1_32", "os0_32")
)


@pytest.mark.parametrize("unit", [{"model": "XT16"}, OS1_32, OS0_32_DUAL], ids=lambda unit: unit["model"])
def test_the_rig_sends_the_packets_of_another_lidar(unit, tmp_path, ports):
    pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")
    from links.simulated.rig.live_process import RealTimeRig
    from links.simulated.rig.live_rig import LiveRigSettings

    (tmp_path / "small.yaml").write_text(SCENARIO)
    settings = LiveRigSettings(
        scenario=tmp_path / "small.yaml",
        servo=tmp_path / "servo",
        lidar_port=ports[0],
        lidar_model=unit["model"],
        lidar_beams=unit.get("beams"),
    )
    rig, ready = RealTimeRig(settings, tmp_path), threading.Event()
    sending = threading.Thread(target=rig.run, args=(ready,), daemon=True)
    lidar = Lidar(port=ports[0], timeout_s=60, slice_ms=0.1, unit=unit)
    with lidar.listen() as packets:
        sending.start()
        assert ready.wait(PATIENCE_S)
        records = [next(packets) for _ in range(260)]  # a turn: 2000 columns, 8 in a packet of the XT16
        firings = [f for record in records if (f := lidar.decode(record)) is not None]
    rig.stop.set()
    sending.join(PATIENCE_S)
    assert lidar.counters.rejected == {}
    assert len(firings) > 30
    assert np.concatenate([f.range_m for f in firings]).max() > 5.0
    now_ns = host_time.now_ns()
    assert all(abs(f.pulse_stamp_ns[-1] - now_ns) < 60 * 10**9 for f in firings)
    truth = rig_of(tmp_path / "truth.mcap")
    assert truth["lidar"]["model"] == unit["model"]


def rig_of(recording):
    with RecordingReader(recording) as reader:
        return yaml.safe_load(reader.rig_yaml)


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["xt16", "os1_32_example"])
def test_the_field_stack_finds_the_drone_with_another_lidar(rig, tmp_path):
    """Needs a machine that simulates this LiDAR in real time: two idle cores."""
    pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")
    config = tmp_path / "live.yaml"
    text = (ROOT / "configs" / "sim_live_xt16.yaml").read_text().replace("rigs/xt16.yaml", f"rigs/{rig}.yaml")
    config.write_text(text.replace("[sim_live.yaml, rigs/", f"[{ROOT}/configs/sim_live.yaml, {ROOT}/configs/rigs/"))
    grd = [sys.executable, "-c", "from links.cli import main; main()"]
    flight = tmp_path / "flight"
    run = [*grd, "run", str(config), "--for", "15", "--hash", "--out", str(flight)]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)
    report, live = json.loads((flight / "rig.json").read_text()), json.loads((flight / "summary.json").read_text())
    print(report, live["live"]["edges"]["track.pulses"], done.stdout)  # noqa: T201
    assert done.returncode == 0, done.stdout + done.stderr
    if report["packets_skipped"] >= 0.05 * report["packets"]:
        pytest.skip(f"this machine is too slow for the simulator: {report['packets_skipped']} packets were skipped")
    assert live["messages"]["track.drone_fix"] > 20


@pytest.mark.slow
def test_the_field_stack_flies_with_the_simulated_rig_and_is_replayed_to_its_hash(tmp_path):
    pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")
    grd = [sys.executable, "-c", "from links.cli import main; main()"]
    flight = tmp_path / "flight"
    run = [*grd, "run", "configs/sim_live.yaml", "--for", "15", "--hash", "--out", str(flight)]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((flight / "summary.json").read_text())
    live = summary["live"]
    assert summary["messages"]["fuse.relative_pose"] > 0
    assert summary["messages"]["servo.servo_state"] > 0
    assert live["switched_off"] == []
    assert live["edges"]["track.pulses"]["taken"] > 0
    assert json.loads((flight / "rig.json").read_text())["mavlink_received"] > 0
    again = [*grd, "replay", str(flight / "flight.mcap"), "--as-live", "--out", str(tmp_path / "again")]
    done = subprocess.run(again, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert "the live run's hash is the same" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
def test_the_sweep_of_a_real_servo_calibrates_the_rig(tmp_path):
    """As in the README: the sweep is driven, recorded and used for a calibration. The rig file is exact."""
    pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")
    grd = [sys.executable, "-c", "from links.cli import main; main()"]
    sweep, rig = tmp_path / "sweep", tmp_path / "mine.yaml"
    for words in (
        ["run", "configs/sim_calibrate_sweep.yaml", "--for", "20", "--out", sweep],
        ["calibrate", sweep / "flight.mcap", "-o", rig],
    ):
        done = subprocess.run(
            [*grd, *map(str, words)], cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
    mount = yaml.safe_load(rig.read_text())["rig"]["lidar"]["mount"]
    assert abs(mount["servo_time_offset_s"]) < 2e-4
    assert abs(mount["servo_play_deg"]) < 0.02
    assert 0.1 <= mount["pointing_sigma_deg"] < 0.12
