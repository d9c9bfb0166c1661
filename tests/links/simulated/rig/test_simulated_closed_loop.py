"""The pipeline drives the servo in virtual time: causal, deterministic, and replayed to the same messages."""

from __future__ import annotations

import json
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
import yaml

from flow.config_error import ConfigError
from flow.graph import load_graph
from flow.link import LinkError, Record, Tap
from flow.message import Message
from flow.replay import replay
from flow.stage import Settings
from flow.taps import Digest
from links.recording import RecordingReader
from links.simulated.rig import closed_loop
from links.simulated.rig.closed_loop import load_loop
from links.simulated.rig.run import Simulation, simulate
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.world.path import Path, Waypoint
from stages.messages import ServoGoal

ROOT = FilePath(__file__).parents[4]
SIM = ROOT / "configs/sim.yaml"
STREET = ROOT / "configs/scenarios/street_sweep.yaml"
GRAPH = (ROOT / "tests/links/simulated/fast_loop.yaml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> FilePath:
    """A graph that sweeps in 0.75 s."""
    file = tmp_path_factory.mktemp("closed_loop") / "fast.yaml"
    file.write_text(GRAPH, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """A drone 9 m away over a parked vehicle, 1.6 s: a fast sweep, then vibration."""
    drone = Path(waypoints=(Waypoint(t_s=0, xyz_m=(4.0, 3.0, 7.0)), Waypoint(t_s=2.0, xyz_m=(4.5, 3.5, 7.0))))
    servo = {"command_latency_s": 0.002, "command_jitter_s": 5e-4, "encoder_error_deg": 0.3, "backlash_deg": 0.2}
    return load_scenario(STREET).with_drone(drone).changed(duration_s=1.6, servo=servo)


def run(scenario: Scenario, config: FilePath) -> tuple[list[Record], str]:
    loop = load_loop(config, scenario.rig_yaml(), "test", scenario.closed_loop)
    records = list(Simulation(scenario, None, loop).records())
    return records, loop.output_hash


@pytest.fixture(scope="module")
def ran(scenario: Scenario, config: FilePath) -> tuple[list[Record], str]:
    return run(scenario, config)


def states(records: list[Record]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrival [ns], goal and position [rad] of the servo's readings."""
    read = [(r.arrival_ns, json.loads(r.data)) for r in records if r.topic == "/servo/state"]
    goal, position = ([s[key] for _, s in read] for key in ("goal_rad", "position_rad"))
    return np.array([t for t, _ in read]), np.array(goal), np.array(position)


class Goals(Tap):
    """Collects the goals of a replay with the time of the record that caused them."""

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._seen: list[tuple[int, float]] = []

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        if isinstance(message, ServoGoal):
            self._seen.append((arrival_ns, message.position_rad))


def replayed(records: list[Record], scenario: Scenario, config: FilePath) -> tuple[str, list[tuple[int, float]]]:
    """Output hash and goals of an open-loop replay."""
    digest, goals = Digest(), Goals()
    graph = load_graph(config, sections={"rig": (scenario.rig_yaml(), "test")})
    replay(graph, [r for r in records if not r.topic.startswith("/truth")], (digest, goals))
    return digest.hexdigest(), goals._seen


def test_goals_of_the_graph_move_the_servo_to_the_drone(ran, scenario: Scenario) -> None:
    """It sweeps to 180 deg, finds the drone in that sweep, and vibrates about azimuth atan2(3.4, 4.4) +- 5 deg."""
    arrival, _, position = states(ran[0])
    assert np.degrees(position).max() > 175
    late = np.degrees(position[arrival > scenario.start_ns + 1_300_000_000])
    azimuth = np.degrees(np.arctan2(3.4, 4.4))
    assert late.min() == pytest.approx(azimuth - 5, abs=1.5)
    assert late.max() == pytest.approx(azimuth + 5, abs=1.5)


def test_a_replay_of_the_recording_takes_the_same_steps(ran, scenario: Scenario, config: FilePath) -> None:
    records, output_hash = ran
    assert replayed(records, scenario, config)[0] == output_hash
    assert replayed(records, scenario, config)[0] == output_hash


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(scenario: Scenario, config: FilePath) -> None:
    short = scenario.changed(duration_s=0.4)
    records, output_hash = run(short, config)
    assert run(short, config) == (records, output_hash)
    assert run(short.changed(seed=8), config)[1] != output_hash


def test_the_look_ahead_does_not_change_a_byte(scenario, config, monkeypatch: pytest.MonkeyPatch) -> None:
    short = scenario.changed(duration_s=0.9)
    records, output_hash = run(short, config)
    monkeypatch.setattr(closed_loop, "LONGEST_BATCH_NS", 1_400_000)
    assert run(short, config) == (records, output_hash)


def test_no_goal_is_executed_before_its_cause_plus_compute_time_and_latency(ran, scenario: Scenario, config) -> None:
    """Each change of the servo's goal comes 20 ms + 2 ms after the arrival that caused it, and at the next reading."""
    arrival, goal, _ = states(ran[0])
    changed = np.nonzero(np.diff(goal))[0] + 1
    sent = replayed(ran[0], scenario, config)[1]
    delays_s = []
    for obeyed_ns, obeyed_rad in zip(arrival[changed], goal[changed], strict=True):
        caused_ns = max(t for t, rad in sent if t < obeyed_ns and abs(rad - obeyed_rad) < 0.001)
        delays_s.append((obeyed_ns - caused_ns) * 1e-9)
    delays = np.array(delays_s)
    assert len(delays) > 5
    assert delays.min() >= 0.022
    assert delays.max() < 0.022 + 0.0015 + 0.001 + 0.008  # jitter, a step, the wait for the next reading


def test_a_slower_host_turns_the_servo_later(scenario: Scenario, config: FilePath) -> None:
    turned_s = []
    for compute_s in (0.01, 0.06):
        records, _ = run(scenario.changed(duration_s=0.3, closed_loop={"compute_s": compute_s}), config)
        arrival, _, position = states(records)
        turned_s.append((arrival[np.argmax(position > 0.01)] - scenario.start_ns) * 1e-9)
    assert turned_s[1] - turned_s[0] == pytest.approx(0.05, abs=0.006)


def test_truth_reaches_no_stage_in_closed_loop(scenario: Scenario, config: FilePath) -> None:
    """A change of the ground truth alone changes no goal: here the drone is hidden, or missing."""
    far = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0.0, 0.0, 500.0)),))
    short = scenario.changed(duration_s=0.5)
    with_truth = states(run(short.with_drone(far).changed(duration_s=0.5), config)[0])
    without = states(run(short.changed(drone=None, script=()), config)[0])
    for a, b in zip(with_truth, without, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_recording_states_how_it_was_made_and_is_replayed_from_disk(tmp_path: FilePath, config: FilePath) -> None:
    file = tmp_path / "loop.mcap"
    report = simulate(STREET, file, closed_loop=config, duration_s=0.3)
    assert report.output_hash is not None
    assert report.output_hash in str(report)
    with RecordingReader(file) as reader:
        assert reader.metadata["closed_loop"] == "fast.yaml"
        assert yaml.safe_load(reader.config_yaml or "")["duration_s"] == 0.3
        written = list(reader.records())
    assert replayed(written, load_scenario(STREET), config)[0] == report.output_hash


def test_sim_yaml_closes_the_loop_and_a_graph_without_servo_commands_is_rejected(tmp_path: FilePath) -> None:
    scenario = load_scenario(STREET)
    load_loop(SIM, scenario.rig_yaml(), "test", scenario.closed_loop)
    bare = tmp_path / "bare.yaml"
    bare.write_text(GRAPH.replace(", inputs: {goal: aim.servo_goal}", ""), encoding="utf-8")
    with pytest.raises(LinkError, match=r"this graph has 0: wire it as 'servo: .*as in configs/sim.yaml"):
        load_loop(bare, scenario.rig_yaml(), "test", scenario.closed_loop)


@pytest.mark.parametrize("topic", ["/truth/drone", "/truth/vehicle", "/truth"])
@pytest.mark.parametrize("link", ["links.lidar.Lidar", "links.dynamixel.Servo"])
def test_no_stage_can_be_wired_to_truth(tmp_path: FilePath, topic: str, link: str) -> None:
    """Every path from a record to a stage starts at a source, and no source may have such a topic."""
    text = GRAPH.replace("links:\n", f"links:\n  spy: {{use: {link}, config: {{topic: {topic}}}}}\n")
    file = tmp_path / "spy.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_loop(file, load_scenario(STREET).rig_yaml(), "test", load_scenario(STREET).closed_loop)
    assert [str(p).partition(": ")[2] for p in caught.value.errors] == [
        f"links.spy.config.topic: truth is for evaluation only: no source may bring in '{topic}'."
    ]
