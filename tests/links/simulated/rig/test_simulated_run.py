"""Whole scenarios: the bytes agree with the ground truth and are reproducible."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path as FilePath

import numpy as np
import pytest
import yaml

from flow.config_error import ConfigError
from flow.link import LinkError, Record
from links.lidar import Lidar
from links.recording import RecordingReader
from links.simulated.rig import run
from links.simulated.rig.run import Simulation, simulate
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.world.path import Path, Waypoint
from stages.geometry.frames import LidarMount, Pose, rotation_from_quaternion_xyzw, rotation_z

ROOT = FilePath(__file__).parents[4]
SCENARIOS = sorted((ROOT / "configs/scenarios").glob("*.yaml"))
STREET = ROOT / "configs/scenarios/street_sweep.yaml"


@pytest.fixture(scope="module")
def short() -> Scenario:
    """0.8 s of vibration about a drone moving at 8 m/s, the vehicle driving at 5 m/s, the servo 40 ms off."""
    drone = Path(waypoints=(Waypoint(t_s=0, xyz_m=(4.0, 3.0, 6.0)), Waypoint(t_s=0.8, xyz_m=(9.6, 3.0, 9.2))))
    vehicle = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, 0)), Waypoint(t_s=0.8, xyz_m=(4.0, 0, 0), yaw_deg=8)))
    mount = LidarMount(
        T_vehicle_turntable=Pose(xyz_m=(0.1, 0.0, 0.25), rpy_deg=(1.0, 2.0, 3.0)),
        T_turntable_lidar=Pose(xyz_m=(0.01, 0.0, 0.1), rpy_deg=(90.0, 0.5, 0.0)),
        servo_zero_deg=5.0,
        servo_time_offset_s=0.04,
    )
    scenario = load_scenario(STREET)
    return scenario.with_drone(drone).changed(
        duration_s=0.8,
        vehicle={"path": vehicle},
        rig={"mount": mount},
        servo={"start_deg": 42.0},
        script=({"do": "vibrate", "duration_s": 5.0, "follow_drone": True, "aim_latency_s": 0.05},),
    )


def _hash(records: list[Record]) -> str:
    digest = hashlib.sha256()
    for r in records:
        digest.update(f"{r.topic} {r.arrival_ns} {r.stamp_ns} {r.sequence} ".encode() + r.data)
    return digest.hexdigest()


def _T(record: Record) -> tuple[np.ndarray, np.ndarray]:
    pose = json.loads(record.data)
    return rotation_from_quaternion_xyzw(tuple(pose["quaternion_xyzw"])), np.array(pose["xyz_m"])


def test_the_bytes_put_the_drone_where_the_truth_has_it(short: Scenario) -> None:
    """Decode packets, transform them with the recorded servo and the rig's mount, and compare: all frames, all times."""
    simulation = Simulation(short)
    records = list(simulation.records())
    mount = short.rig.mount
    servo = [
        (r.stamp_ns + 40_000_000, json.loads(r.data)["position_rad"]) for r in records if r.topic == "/servo/state"
    ]
    servo_ns, position = (np.array(column) for column in zip(*servo, strict=True))
    truth = {
        topic: {r.stamp_ns: _T(r) for r in records if r.topic == topic} for topic in ("/truth/vehicle", "/truth/drone")
    }
    lidar, near = Lidar(slice_ms=0.1), []  # a message per packet
    hits = np.array([*simulation.drone_return_ns, 2**62])
    for record in records:
        if record.topic != "/lidar/packets":
            continue
        firings = lidar.decode(record)
        assert firings is not None
        assert firings.lost_packets == 0
        late_ns = hits[np.searchsorted(hits, firings.pulse_stamp_ns)] - firings.pulse_stamp_ns
        for row in np.nonzero(late_ns < 1000)[0]:  # the packet's stamp is rounded down to a microsecond
            stamp = int(firings.pulse_stamp_ns[row])
            angle = mount.turntable_rad(np.interp([stamp], servo_ns, position))[0]
            T_vt, T_tl = mount.T_vehicle_turntable.matrix(), mount.T_turntable_lidar.matrix()
            p_lidar = firings.xyz_lidar_m[row].astype(np.float64)
            p_vehicle = T_vt[:3, :3] @ rotation_z(angle) @ (T_tl[:3, :3] @ p_lidar + T_tl[:3, 3]) + T_vt[:3, 3]
            at = (stamp - short.start_ns) // 10_000_000 * 10_000_000 + short.start_ns
            R_wv, t_wv = truth["/truth/vehicle"][at]
            R_wd, t_wd = truth["/truth/drone"][at]
            near.append(R_wd.T @ (R_wv @ p_vehicle + t_wv - t_wd))
    assert len(near) > 15
    offsets = np.linalg.norm(near, axis=1)
    assert offsets.max() < 0.25 + 0.1 + 0.1  # half the span, 10 ms of flight at 9 m/s, noise and a mixed pixel
    assert np.abs(np.mean(near, axis=0)).max() < 0.12


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(short: Scenario) -> None:
    first = _hash(list(Simulation(short, 3).records()))
    assert _hash(list(Simulation(short, 3).records())) == first
    assert _hash(list(Simulation(short, 4).records())) != first


def test_how_pulses_are_batched_does_not_change_a_byte(short: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _hash(list(Simulation(short).records()))
    monkeypatch.setattr(run, "BATCH_PACKETS", 7)
    assert _hash(list(Simulation(short).records())) == whole


def test_records_are_in_order_of_arrival_and_packets_have_their_own_time(short: Scenario) -> None:
    records = list(Simulation(short).records())
    arrivals = [r.arrival_ns for r in records]
    assert arrivals == sorted(arrivals)
    assert [r.sequence for r in records] == list(range(len(records)))
    packets = [r for r in records if r.topic == "/lidar/packets"]
    assert len(packets) == -(-800_000_000 // 1_327_104)
    for record in packets:
        past_hour_us = int.from_bytes(record.data[1200:1204], "little")
        assert record.stamp_ns // 1000 % 3_600_000_000 == past_hour_us
        assert record.stamp_ns % 1000 == 0
        assert 300_000 <= record.arrival_ns - record.stamp_ns - (23 * 55_296 + 15 * 2_304) < 801_000
    assert len([r for r in records if r.topic == "/truth/drone"]) == 81


def test_dual_return_packets_hold_half_the_firings(short: Scenario) -> None:
    dual = short.changed(duration_s=0.1, lidar={"return_mode": "dual"})
    packets = [r for r in Simulation(dual).records() if r.topic == "/lidar/packets"]
    assert len(packets) == -(-100_000_000 // 663_552)
    lidar = Lidar(slice_ms=0.1)
    kinds = [set(firings.return_kind) for r in packets if (firings := lidar.decode(r)) is not None]
    assert len(kinds) == len(packets)
    assert {0, 1} in kinds


def test_packets_closer_than_their_delays_differ_arrive_in_order(short: Scenario) -> None:
    fast = short.changed(duration_s=0.2, rig={"mount": short.mount, "model": "XT32"})  # a packet every 0.4 ms
    stamps_ns = [r.stamp_ns for r in Simulation(fast).records() if r.topic == "/lidar/packets"]
    assert len(stamps_ns) == 500
    assert stamps_ns == sorted(stamps_ns)


def test_an_empty_sky_has_no_drone_in_truth_or_returns() -> None:
    scenario = load_scenario(ROOT / "configs/scenarios/empty_street.yaml").changed(duration_s=0.2)
    simulation = Simulation(scenario)
    topics = {r.topic for r in simulation.records()}
    assert topics == {"/lidar/packets", "/servo/state", "/truth/vehicle"}
    assert simulation.drone_return_ns == []
    assert simulation.returns > 0.4 * simulation.pulses


def test_a_simulation_is_written_with_its_rig_and_scenario(tmp_path: FilePath) -> None:
    text = STREET.read_text(encoding="utf-8").replace("\nduration_s: ", "\nduration_s: 0.1  # was ")
    source, out, fractions = tmp_path / "s.yaml", tmp_path / "s.mcap", []
    source.write_text(text, encoding="utf-8")
    report = simulate(source, out, seed=5, progress=fractions.append)
    assert fractions[-1] == 1.0
    assert report.seed == 5
    with RecordingReader(out) as reader:
        assert reader.config_yaml == load_scenario(source).changed(seed=5).as_yaml()
        assert reader.metadata["seed"] == "5"
        rig = yaml.safe_load(reader.rig_yaml)
        count = sum(1 for _ in reader.records())
    assert count == report.records
    assert LidarMount.model_validate(rig["lidar"]["mount"]) == load_scenario(source).rig.mount
    assert rig["drone"] == {"span_m": 0.5}
    first = out.read_bytes()
    simulate(source, out, seed=5, overwrite=True)
    assert out.read_bytes() == first
    with pytest.raises(LinkError, match="exists already"):
        simulate(source, out)


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda p: p.stem)
def test_committed_scenarios_are_valid_and_named_after_their_file(path: FilePath) -> None:
    assert load_scenario(path).name == path.stem


def test_the_committed_recording_is_small_and_states_its_origin() -> None:
    path = ROOT / "recordings/street_sweep.mcap"
    assert path.stat().st_size < 3_000_000
    with RecordingReader(path) as reader:
        assert reader.warnings == []
        assert reader.metadata["scenario"] == "street_sweep"
        assert reader.config_yaml == load_scenario(STREET).as_yaml()
        assert set(reader.topics) - {"/truth/hits"} == {
            "/lidar/packets",
            "/servo/state",
            "/truth/vehicle",
            "/truth/drone",
        }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"duration": 3}, "duration: unknown setting 'duration'. Did you mean 'duration_s'?"),
        ({"duration_s": -1}, "duration_s: must be greater than 0, got -1."),
        ({"drone": None}, "follow_drone is set but the scenario has no drone"),
        ({"start_utc": "2025-06-01T10:20:30"}, "give the time zone"),
        ({"drone": {"path": {"waypoints": [{"t_s": 0, "xyz_m": [5, 0, -1.6]}]}}}, "0.20 m above the road at 0.00 s"),
        ({"script": [{"do": "spin"}]}, "script.0: 'do' must be 'sweep' or 'vibrate', not 'spin'"),
        (
            {"rig": {"model": "OS0-32"}, "lidar": {"return_mode": "dual"}},
            "packets hold strongest returns: set strongest",
        ),
    ],
)
def test_a_wrong_scenario_is_an_error_with_the_file_and_the_key(
    change: dict[str, object], message: str, tmp_path: FilePath
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(STREET.read_text(encoding="utf-8")) | change), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    assert str(caught.value).startswith(f"{path}:")  # and the line
    assert message in str(caught.value)


def test_a_file_that_is_missing_or_not_yaml_is_an_error(tmp_path: FilePath) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file\."):
        load_scenario(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"bad\.yaml:1: is not YAML"):
        load_scenario(tmp_path / "bad.yaml")
    (tmp_path / "list.yaml").write_text("- a", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"list\.yaml:1: must be a mapping at the top, as in 'name: value'\.$"):
        load_scenario(tmp_path / "list.yaml")
    with pytest.raises(ConfigError, match=r"--set x: must read KEY=VALUE, as in --set autopilot\.imu_hz=25\.$"):
        load_scenario(STREET, ["x"])


def test_a_scenario_may_include_another_and_change_it(tmp_path: FilePath) -> None:
    (tmp_path / "short.yaml").write_text(f"include: {STREET}\nname: short\nduration_s: 1.5\n", encoding="utf-8")
    short = load_scenario(tmp_path / "short.yaml")
    assert (short.name, short.duration_s) == ("short", 1.5)
    assert short.drone == load_scenario(STREET).drone
