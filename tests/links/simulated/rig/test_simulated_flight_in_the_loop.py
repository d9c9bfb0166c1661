"""A whole flight in virtual time: the drone flies on what the graph sends; recorded, deterministic, without threads."""

from __future__ import annotations

import itertools
import json
import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flow.graph import load_graph
from flow.link import LinkError, Record, Tap
from flow.message import Message
from flow.replay import replay
from flow.taps import Digest
from links.mavlink.transport.framing import parse_frame
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.rig import closed_loop
from links.simulated.rig.closed_loop import load_loop
from links.simulated.rig.run import Simulation, simulate
from links.simulated.rig.scenario import Scenario, load_scenario
from stages.messages import DroneLocalPosition

ROOT = Path(__file__).parents[4]
CONFIG = ROOT / "configs/sim_flight_fixes.yaml"
FLIGHT = ROOT / "configs/scenarios/flight/hover_fixes.yaml"


def changed(scenario: Scenario, duration_s: float, stack: dict[str, Any] | None = None, **settings: Any) -> Scenario:
    assert scenario.autopilot is not None
    assert scenario.autopilot.flight_stack is not None
    autopilot = scenario.autopilot.model_dump()
    autopilot["flight_stack"] |= stack or {}
    return scenario.changed(duration_s=duration_s, autopilot=autopilot, **settings)


def stack_of(simulation: Simulation) -> FlightStack:
    assert simulation.flight is not None
    return simulation.flight.stack


class Positions(Tap):
    """Times and independence of the autopilot's positions as the graph gets them."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[int, bool]] = []

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        if isinstance(message, DroneLocalPosition):
            self.seen.append((arrival_ns, message.independent))


def fly(scenario: Scenario, *taps: Tap) -> tuple[list[Record], Simulation, str]:
    loop = load_loop(CONFIG, scenario.rig_yaml(), "test", scenario.closed_loop, taps)
    simulation = Simulation(scenario, loop=loop)
    return list(simulation.records()), simulation, loop.output_hash


@pytest.fixture(scope="module")
def flown() -> tuple[list[Record], Simulation, str]:
    """17 s: grd learns the yaw of the autopilot's axes and sends; the switch is at 14 s."""
    plan = [{"do": "path", "for_s": 14}, {"do": "use_sources", "set": 2}, {"do": "hold", "for_s": 40}]
    return fly(changed(load_scenario(FLIGHT), 17.0, {"plan": plan}))


def messages(records: list[Record], topic: str, kind: str) -> list[tuple[Record, Any]]:
    parsed = [(r, parse_frame(r.data)) for r in records if r.topic == topic]
    return [(record, message) for record, message in parsed if message.get_type() == kind]


def test_sent_poses_reach_the_autopilot_and_it_flies_on_them(flown) -> None:
    records, simulation, _ = flown
    assert len(messages(records, "/autopilot/tx", "ODOMETRY")) > 100
    core = stack_of(simulation).ekf.primary
    assert core.used_external_ns is not None
    assert core.active == 1
    assert not stack_of(simulation).quadrotor.crashed


def test_the_session_does_what_it_does_live_at_its_times(flown) -> None:
    """HEARTBEAT at 1 Hz, TIMESYNC at 4 Hz; replies to ours are stamped with the time of the request."""
    records, _, _ = flown
    assert len(messages(records, "/autopilot/tx", "HEARTBEAT")) == pytest.approx(17, abs=2)
    asked = [m.ts1 for _, m in messages(records, "/autopilot/tx", "TIMESYNC") if m.tc1 == 0]
    assert len(asked) == pytest.approx(68, abs=5)
    replies = [(r, m) for r, m in messages(records, "/autopilot/rx", "TIMESYNC") if m.tc1 != 0]
    assert len(replies) > 40
    assert all(record.stamp_ns == message.ts1 and message.ts1 in asked for record, message in replies)


def test_a_pose_leaves_after_the_compute_time(flown) -> None:
    records, simulation, _ = flown
    ages_s = [(r.arrival_ns / 1e3 - m.time_usec) * 1e-6 for r, m in messages(records, "/autopilot/tx", "ODOMETRY")]
    compute_s = simulation.scenario.closed_loop.compute_s
    assert min(ages_s) >= compute_s - 1e-6
    assert max(ages_s) < compute_s + 0.05


def test_records_are_in_order_of_arrival_and_the_outcome_is_the_last(flown) -> None:
    records, _, _ = flown
    arrivals = [r.arrival_ns for r in records[:-1]]
    assert arrivals == sorted(arrivals)
    assert [r.sequence for r in records] == list(range(len(records)))
    outcome = json.loads(records[-1].data)
    assert records[-1].topic == "/truth/flight"
    assert outcome["crashed"] is False
    assert outcome["sent_poses"] == len(messages(records, "/autopilot/tx", "ODOMETRY"))


def test_a_replay_of_the_recording_takes_the_same_steps(flown) -> None:
    records, simulation, output_hash = flown
    rig = simulation.scenario.rig_yaml(), "test"
    digest = Digest()
    received = [r for r in records if not r.topic.startswith("/truth")]
    replay(load_graph(CONFIG, sections={"rig": rig}), received, (digest,))
    assert digest.hexdigest() == output_hash


def test_the_same_seed_gives_the_same_bytes_however_far_it_looks_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    short = changed(load_scenario(FLIGHT), 4.0)
    records, _, output_hash = fly(short)
    monkeypatch.setattr(closed_loop, "LONGEST_BATCH_NS", 4_000_000)
    again, _, again_hash = fly(short)
    assert again == records
    assert again_hash == output_hash
    assert fly(short.changed(seed=2))[2] != output_hash


def test_a_take_off_below_an_obstacle_is_an_error() -> None:
    blocked = changed(load_scenario(FLIGHT), 1.0, {"on_ground": True})  # a car is parked there
    with pytest.raises(LinkError, match=r"drone.path: something stands where it takes off, \(7.0, 0.0\) m"):
        Simulation(blocked)


def test_no_thread_is_started() -> None:
    before = threading.active_count()
    fly(changed(load_scenario(FLIGHT), 1.0))
    assert threading.active_count() == before


def test_a_gap_of_the_lidar_stops_the_fixes() -> None:
    records, _, _ = fly(changed(load_scenario(FLIGHT), 5.0, lidar_gaps_s=((3.0, 4.0),)))
    start_ns = records[0].arrival_ns
    fixes = [
        json.loads(r.data) for r in records if r.topic == "/simulated/fixes" and 3.05e9 < r.stamp_ns - start_ns < 3.95e9
    ]
    assert fixes
    assert not any("xyz_m" in fix for fix in fixes)


def test_after_a_kill_grd_starts_again_and_the_flight_goes_on() -> None:
    scenario = changed(load_scenario(FLIGHT), 17.0, {"plan": [{"do": "path", "for_s": 20}]})
    scenario = scenario.changed(closed_loop={"killed_s": (13.0, 14.0)})
    positions = Positions()
    records, simulation, _ = fly(scenario, positions)
    start_ns = scenario.start_ns
    sent_s = np.array([(r.arrival_ns - start_ns) * 1e-9 for r in records if r.topic == "/autopilot/tx"])
    assert not ((sent_s > 13.05) & (sent_s < 14.0)).any()
    assert (sent_s > 14.0).any()
    first_ns = min(r.arrival_ns for r, _ in messages(records, "/autopilot/tx", "ODOMETRY"))
    assert first_ns < start_ns + 13e9
    assert all(independent == (at_ns < first_ns) for at_ns, independent in positions.seen if at_ns != first_ns)
    assert positions.seen[-1][0] > start_ns + 16e9
    counters = {m.reset_counter for _, m in messages(records, "/autopilot/tx", "ODOMETRY")}
    assert counters
    assert not stack_of(simulation).quadrotor.crashed


@pytest.mark.parametrize(
    ("config", "flight", "killed_s"),
    [
        ("sim_flight_yaw_fixes", "matrix/brisk", (22.0, 23.0)),
        pytest.param("sim_flight_fixes", "hover_fixes", (14.0, 15.0), marks=pytest.mark.slow),
    ],
)
def test_after_a_kill_with_a_state_file_poses_are_sent_again_within_5_s(
    config: str, flight: str, killed_s: tuple[float, float], tmp_path: Path
) -> None:
    """The autopilot's estimate is not independent any more; the heading is that of the run before."""
    state = f"links: {{autopilot: {{config: {{state_file: {tmp_path / 'sent.json'}}}}}}}"
    (tmp_path / "config.yaml").write_text(f"include: {ROOT / 'configs' / config}.yaml\n{state}\n", encoding="utf-8")
    plan = [{"do": "path", "for_s": killed_s[0] - 1}, {"do": "use_sources", "set": 2}, {"do": "hold", "for_s": 40}]
    own_set = "external_no_velocity" if "yaw" in config else "external_position"
    scenario = changed(
        load_scenario(ROOT / "configs/scenarios/flight" / f"{flight}.yaml"),
        killed_s[1] + 4,
        {"plan": plan, "source_sets": ["gps", own_set]},
    )
    scenario = scenario.changed(closed_loop={"killed_s": killed_s})
    loop = load_loop(tmp_path / "config.yaml", scenario.rig_yaml(), "test", scenario.closed_loop)
    records, start_ns = list(Simulation(scenario, loop=loop).records()), scenario.start_ns
    sent = messages(records, "/autopilot/tx", "ODOMETRY")
    after_s = [(r.arrival_ns - start_ns) * 1e-9 for r, _ in sent if r.arrival_ns == r.stamp_ns]
    assert max(s for s in after_s if s < killed_s[1]) == pytest.approx(killed_s[0], abs=0.1)
    assert min(s for s in after_s if s > killed_s[1]) - killed_s[0] < 5.0
    outcome = json.loads(records[-1].data)
    assert outcome["sent_poses"] > 100
    assert (outcome["wrong_poses"], outcome["sent_worst_m"] < 0.5) == (0, True)
    own = messages(records, "/autopilot/rx", "LOCAL_POSITION_NED")
    first, at_first = sent[0][1], next(m for r, m in own if r.arrival_ns >= sent[0][0].arrival_ns)
    assert math.dist((first.x, first.y, first.z), (at_first.x, at_first.y, at_first.z)) < 1.0
    steps_m = [math.dist((a.x, a.y, a.z), (b.x, b.y, b.z)) for (_, a), (_, b) in itertools.pairwise(own)]
    assert max(steps_m) < 2.0  # the switch moves the autopilot's position by the error of its GPS, not to `map`
    if outcome["sent_yaw_worst_deg"] is not None:
        assert outcome["sent_yaw_worst_deg"] < 10.0
        first_ns = sent[0][0].arrival_ns
        attitude = next(m for r, m in messages(records, "/autopilot/rx", "ATTITUDE") if r.arrival_ns >= first_ns)
        w, x, y, z = sent[0][1].q
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        assert abs(math.remainder(yaw - attitude.yaw, math.tau)) < math.radians(15.0)  # the axes are the autopilot's


def test_the_command_writes_the_flight_and_says_what_became_of_it(tmp_path: Path) -> None:
    report = simulate(FLIGHT, tmp_path / "flight.mcap", closed_loop=CONFIG, duration_s=1.0)
    assert "flight: flown to the end; no pose sent" in str(report)


def test_a_scenario_without_a_flight_stack_flies_as_before() -> None:
    scenario = load_scenario(FLIGHT).changed(autopilot={}, duration_s=1.0)
    assert "flight_stack" not in scenario.as_yaml()
    records, simulation, _ = fly(scenario)
    assert simulation.flight is None
    assert not any(r.topic == "/truth/flight" for r in records)
