"""The simulated LiDAR: wall time for one second of simulation, on one core. Below 1 s it is faster than real time.

    python -m pytest tests/benchmarks/bench_simulated.py --benchmark-columns=min,median,iqr,rounds
    (on a busy machine add --benchmark-timer=time.process_time: the time this process had a core)

Rows: the default street in batches of 42 ms and of 5 ms (as a closed loop needs), the other kinds of scene with all that
moves in them, rain, and `embree alone`: only the same rays against the street's triangles, without sensor, packets,
truth or moving bodies; the difference is the simulator's own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from links.simulated.rig import run
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.world.procedural.build import KINDS

STREET = Path(__file__).parents[2] / "configs/scenarios/street_sweep.yaml"
ROUNDS = 7


@pytest.fixture(scope="module")
def street() -> Scenario:
    scenario = load_scenario(STREET).changed(duration_s=1.0)
    list(Simulation(scenario.changed(duration_s=0.1)).records())  # compiles
    return scenario


def _second(benchmark, scenario: Scenario) -> None:
    def simulate(simulation: Simulation) -> None:
        for _ in simulation.records():
            pass

    benchmark.pedantic(simulate, setup=lambda: ((Simulation(scenario),), {}), rounds=ROUNDS)


def test_street(benchmark, street) -> None:
    _second(benchmark, street)


@pytest.mark.parametrize("packets", [4, 8], ids=["5ms", "11ms"])
def test_street_in_small_batches(benchmark, street, monkeypatch, packets) -> None:
    monkeypatch.setattr(run, "BATCH_PACKETS", packets)
    _second(benchmark, street)


def test_street_in_rain(benchmark, street) -> None:
    _second(benchmark, street.changed(weather={"rain_mmph": 10.0, "visibility_m": 2000.0}))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "street"])
def test_kind(benchmark, street, kind) -> None:
    _second(benchmark, street.changed(scene={"kind": kind}))


def test_embree_alone(benchmark, street, monkeypatch) -> None:
    simulation = Simulation(street)
    world = simulation._scene.world
    cast, asked = world.cast, []

    def keep(origins, directions, max_range_m):
        asked.append((origins.copy(), directions.copy(), np.full(len(origins), max_range_m, dtype=np.float32)))
        return cast(origins, directions, max_range_m)

    monkeypatch.setattr(world, "cast", keep)
    for _ in simulation.records():
        pass
    benchmark.extra_info["rays"] = sum(len(origins) for origins, _, _ in asked)
    benchmark.pedantic(
        lambda: [world._scene.run(o, d, dists=limit, output=True) for o, d, limit in asked], rounds=ROUNDS
    )
