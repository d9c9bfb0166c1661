"""Several drones at once, each with its own ground truth, and their lines of sight."""

from __future__ import annotations

import json
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flow.link import LinkError, Record
from links.lidar import Lidar
from links.mavlink import Autopilot
from links.runs.request import RunRequest
from links.runs.results import TRUTH_FILE, TRUTH_RETURNS_FILE, TRUTH_VEHICLE_FILE, TRUTH_VISIBLE_FILE
from links.runs.run_folder import replay_into
from links.runs.truth import TruthLog
from links.simulated.kernels.lidar import echoes
from links.simulated.rig import run
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.rig.truth_records import TruthRecords
from links.simulated.world.drone import DroneModel
from links.simulated.world.mesh import RayScene, box
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.scene import Scene, Truth, drone_shapes
from links.simulated.world.vehicle import vehicle_mesh
from stages.messages import DroneLocalPosition

STREET = FilePath(__file__).parents[4] / "configs/scenarios/street_sweep.yaml"
ASIDE = {"span_m": 0.8, "model": {"shape": "hexa"}, "path": {"waypoints": [{"t_s": 0, "xyz_m": [-4.0, -2.0, 7.0]}]}}


def path_through(*points: tuple[float, tuple[float, float, float]]) -> Path:
    return Path(waypoints=tuple(Waypoint(t_s=t, xyz_m=xyz) for t, xyz in points))


STILL = path_through((0, (0.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def pair() -> Scenario:
    """The first drone above the vehicle's front left, the second in the same plane, behind it on the right."""
    street = load_scenario(STREET)
    return street.with_drone(path_through((0, (6.0, 3.0, 9.0)))).changed(
        duration_s=0.6,
        other_drones=[ASIDE],
        truth_visible=True,
        servo={"start_deg": 26.57},
        script=[{"do": "vibrate", "duration_s": 60.0, "azimuth_table": [[0.0, 26.57]]}],
    )


@pytest.fixture(scope="module")
def own_telemetry(pair: Scenario) -> Scenario:
    """The same, each drone with an autopilot."""
    return pair.changed(autopilot={}, other_drones=[{**ASIDE, "autopilot": {"boot_s": 50.0}}], truth_visible=False)


def content(records: list[Record], topic: str) -> list[dict[str, Any]]:
    return [json.loads(record.data) for record in records if record.topic == topic]


def plain(records: list[Record], without: str = "/truth") -> list[tuple[str, int, int, bytes]]:
    return [(r.topic, r.arrival_ns, r.stamp_ns, r.data) for r in records if not r.topic.startswith(without)]


def test_each_drone_has_its_own_ground_truth_and_its_hits_are_on_it(pair: Scenario) -> None:
    simulation = Simulation(pair)
    records = list(simulation.records())
    hits = {n: [t for row in content(records, f"/truth/hits{n}") for t in row["pulse_stamp_ns"]] for n in ("", "_2")}
    assert min(len(stamps) for stamps in hits.values()) > 10
    assert not set(hits[""]) & set(hits["_2"])
    assert sorted(hits[""] + hits["_2"]) == simulation.drone_return_ns
    away_m = {name: [] for name in hits}
    lidar = Lidar(slice_ms=0.1)  # a message per packet
    for record in records:
        firings = lidar.decode(record) if record.topic == "/lidar/packets" else None
        if firings is None:
            continue
        for name, stamps in hits.items():
            late_ns = np.abs(firings.pulse_stamp_ns[:, None] - np.array(stamps)).min(axis=1)
            away_m[name] += firings.range_m[late_ns < 1000].tolist()  # a packet's stamp is in whole microseconds
    for name, number in (("", 1), ("_2", 2)):
        position = content(records, f"/truth/drone{name}")[0]["xyz_m"]
        assert position == simulation.truth.T_world_drone(np.array([pair.start_ns]), number)[1][0].tolist()
        assert len(away_m[name]) == len(hits[name])
        assert np.median(away_m[name]) == pytest.approx(np.linalg.norm(np.array(position) - [0, 0, 0.35]), abs=0.35)
    assert np.linalg.norm(simulation.truth.T_world_drone(np.array([0]), 2)[1][0] - [-4.0, -2.0, 7.0]) == 0
    with pytest.raises(LookupError, match="no drone 3"):
        simulation.truth.T_world_drone(np.array([0]), 3)


def test_batches_do_not_change_a_byte_of_two_drones(pair: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = plain(list(Simulation(pair).records()), without="-")
    monkeypatch.setattr(run, "BATCH_PACKETS", 7)
    assert plain(list(Simulation(pair).records()), without="-") == whole


def test_a_drone_out_of_range_and_sight_records_leave_the_sensors_bytes(pair: Scenario) -> None:
    far = ASIDE | {"path": {"waypoints": [{"t_s": 0, "xyz_m": [0.0, 0.0, 200.0]}]}}
    alone = pair.changed(duration_s=0.3, other_drones=[], truth_visible=False)
    joined = alone.changed(other_drones=[far], truth_visible=True)
    assert plain(list(Simulation(alone).records())) == plain(list(Simulation(joined).records()))
    assert {r.topic for r in Simulation(alone).records() if r.topic.startswith("/truth")} == {
        "/truth/vehicle",
        "/truth/drone",
        "/truth/hits",
    }


def test_a_scenario_file_has_optional_settings_only_where_they_are_used(pair: Scenario) -> None:
    assert "other_drones" in pair.as_yaml()
    assert "truth_visible: true" in pair.as_yaml()
    old = load_scenario(STREET).as_yaml()
    assert "other_drones" not in old
    assert "truth_visible" not in old


def test_a_hit_has_the_number_of_its_drone() -> None:
    shapes = drone_shapes(0.5, DroneModel())
    others = (path_through((0, (0.0, 10.0, 5.0))), path_through((0, (20.0, 0.0, 10.0))))
    truth = Truth(0, path_through((0, (0.0, 0.0, -9.0))), path_through((0, (10.0, 0.0, 5.0))), others)
    brick, larger = box((100, -1, -1), (101, 1, 1), "brick"), drone_shapes(0.8, DroneModel())
    scene = Scene(brick, vehicle_mesh(1.8), shapes, truth, others=[larger, larger])
    at_m = np.array([(10.0, 0.0, 5.0), (0.0, 10.0, 5.0), (-10.0, 0.0, 5.0)])
    directions = (at_m / np.linalg.norm(at_m, axis=1, keepdims=True)).astype(np.float32)[:, None]
    ranges, _, drone = scene.cast(np.zeros(3, dtype=np.int64), np.zeros_like(directions), directions, 90.0)
    assert drone[:, 0].tolist() == [1, 2, 0]  # the first blocks the third
    assert ranges[:2, 0] == pytest.approx(np.sqrt(125.0), abs=0.15)


def test_an_echo_has_the_number_of_the_drone_with_most_of_its_power() -> None:
    ranges = np.array([[8.0, 8.0, 20.0, 20.0]] * 2, dtype=np.float32)
    fractions = np.array([[0.2] * 4] * 2, dtype=np.float32)
    drone = np.array([[2, 2, 1, 1], [0, 0, 3, 0]], dtype=np.uint8)
    _, power, from_drone, which = echoes(ranges, fractions, drone, np.full(4, 0.25), np.full(2, 1e-12), 0.5, "dual")
    assert which.tolist() == [[2, 0], [1, 3]]
    assert from_drone[:, 0].tolist() == power[:, 0].tolist()
    assert from_drone[1, 1] == pytest.approx(power[1, 1] / 2)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"drone": None, "truth_visible": False},
            "other_drones: the scenario has no drone; add 'drone', the first one",
        ),
        ({"drone": None, "other_drones": []}, "truth_visible: the scenario has no drone"),
        (
            {"other_drones": [{"path": path_through((0, (5.0, 0.0, -1.7)))}]},
            r"other_drones\.0\.path: 0\.10 m above the road",
        ),
        (
            {"other_drones": [{"path": path_through((0, (6.0, 3.3, 9.2)))}]},
            r"other_drones\.0\.path: collides with drone at 0\.00 s",
        ),
        ({"other_drones": [ASIDE, ASIDE]}, r"other_drones\.1\.path: collides with other_drones\.0 at"),
    ],
)
def test_impossible_drones_are_rejected(pair: Scenario, change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        pair.changed(**change)


def test_another_drone_through_a_wall_is_rejected_by_name(pair: Scenario) -> None:
    inside = {"path": {"waypoints": [{"t_s": 0, "xyz_m": [0.0, 14.0, 3.0]}]}}
    with pytest.raises(LinkError, match=r"other_drones\.1\.path: "):
        Simulation(pair.changed(other_drones=[ASIDE, inside]))


def test_the_line_of_sight_is_recorded_at_the_start_and_at_each_change() -> None:
    """A wall blocks y in [-5, 5] at x = 20 from the origin: on x = 40 that is y in [-10, 10], crossed at 10 m/s."""
    wall = RayScene(box((20.0, -5.0, -5.0), (20.1, 5.0, 30.0), "brick"))
    start_ns = 7_000_000_000
    truth = Truth(
        start_ns,
        STILL,
        path_through((0, (40.0, -21.0, 5.0)), (4, (40.0, 19.0, 5.0))),
        (path_through((0, (10.0, 0.0, 5.0))),),
    )

    def sight_changes(steps_ns: list[int]) -> list[tuple[str, float, bool]]:
        records = TruthRecords(truth, wall, lambda stamps_ns: np.zeros((len(stamps_ns), 3)))
        rows = [row for step in steps_ns for row in records.records(start_ns + step)]
        sights = [row for row in rows if row.topic.startswith("/truth/visible")]
        assert all(row.arrival_ns == row.stamp_ns for row in sights)
        return [(r.topic, (r.stamp_ns - start_ns) / 1e9, json.loads(r.data)["visible"]) for r in sights]

    sights = sight_changes([4_000_000_000])
    assert [row for row in sights if row[0] == "/truth/visible_2"] == [("/truth/visible_2", 0.0, True)]
    first = [row[1:] for row in sights if row[0] == "/truth/visible"]
    assert [seen for _, seen in first] == [True, False, True]
    assert [at for at, _ in first] == pytest.approx([0.0, 1.15, 3.15], abs=0.051)  # 21 - 9.95 m, then 19.9 m more
    in_steps = sight_changes([*range(30_000_000, 4_000_000_000, 42_000_000), 4_000_000_000])
    assert sorted(in_steps) == sorted(sights)


def test_the_recorded_truth_is_what_a_run_is_evaluated_with(pair: Scenario, tmp_path: FilePath) -> None:
    log = TruthLog()
    assert not [r for r in log.without_truth(Simulation(pair).records()) if r.topic.startswith("/truth")]
    log.write(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    of_a_drone = {
        name.replace(".", f"{number}.")
        for name in (TRUTH_FILE, TRUTH_RETURNS_FILE, TRUTH_VISIBLE_FILE)
        for number in ("", "_2")
    }
    assert names == {TRUTH_VEHICLE_FILE} | of_a_drone
    assert (tmp_path / "truth_visible.csv").read_text() == "stamp_s,visible\n1748773230.000000000,1\n"
    last = (tmp_path / "truth_vehicle_drone_2.tum").read_text().splitlines()[-1].split()
    assert [float(v) for v in last[1:4]] == [-4.0, -2.0, 7.0]


def test_each_drone_with_an_autopilot_has_topics_of_its_own(own_telemetry: Scenario) -> None:
    alone = own_telemetry.changed(other_drones=[ASIDE])
    both, first = (
        [record for record in Simulation(s).records() if record.topic.startswith("/autopilot/")]
        for s in (own_telemetry, alone)
    )
    second = [record for record in both if record.topic.endswith("_2")]
    assert {record.topic for record in second} == {"/autopilot/rx_2", "/autopilot/tx_2"}
    assert plain([record for record in both if record not in second]) == plain(first)
    links = {number: Autopilot(topic=f"/autopilot/rx{number}") for number in ("", "_2")}
    heights_m: dict[str, list[float]] = {number: [] for number in links}
    for record in both:
        for number, link in links.items():
            message = link.decode(record) if record.topic in link.replay_topics else None
            if isinstance(message, DroneLocalPosition):
                heights_m[number].append(message.xyz_odom_m[2])
    assert min(len(heights) for heights in heights_m.values()) > 5
    assert heights_m[""] != heights_m["_2"]


def test_only_the_first_drone_flies_on_what_grd_sends(pair: Scenario) -> None:
    with pytest.raises(ValidationError, match="only the first drone flies on what grd sends"):
        pair.changed(other_drones=[{**ASIDE, "autopilot": {"flight_stack": {}}}])


def test_a_run_with_two_chains_has_a_folder_for_each(own_telemetry: Scenario, tmp_path: FilePath) -> None:
    recording, request = (
        tmp_path / "pair.mcap",
        RunRequest(FilePath("configs/two_drones.yaml"), (), ("viewer.file=null",)),
    )
    run.simulate_into(recording, own_telemetry)
    result = replay_into(tmp_path / "run", recording, request)
    own, other = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("run", "run/fuse_2"))
    assert sum(own["poses"]["states"].values()) == result.report.messages["fuse.relative_pose"]
    assert sum(other["poses"]["states"].values()) == result.report.messages["fuse_2.relative_pose"] > 10
    assert "fuse_2." not in (tmp_path / "run/run.log").read_text()
