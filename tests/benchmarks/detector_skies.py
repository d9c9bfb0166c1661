"""Drones that the detector accepts, and other objects, in skies of another physics: tests/stages/caster.py.

    python -m tests.benchmarks.detector_skies [FLIGHTS of each kind]

Flights of 4 s of one object at 8 to 30 m under a beam that stays on its middle, with the drone's telemetry and without;
where the object is not the drone, the drone flies elsewhere. The shipped model was not trained on them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from tests.stages.caster import Ball, Drone, Thing, Trajectory, Wire, flying, still
from tests.stages.detect.test_evidence_detect import accepted_after_s, run, telemetry_of

ACCEPT_PROBABILITIES = (0.95, 0.5)
SECONDS = 4.0
OF_A_DRONE = ("hovers", "slow", "climbs", "fast", "wanders")
OTHERS = ("bird", "circling bird", "lamp", "wire", "twigs", "balloon")
Sky = tuple[list[Thing], Trajectory]


def main(flights: int) -> None:
    """Print the table."""
    print(f"accepted of {flights} after [s], at {ACCEPT_PROBABILITIES}; with telemetry | without")  # noqa: T201
    for kind in (*OF_A_DRONE, *OTHERS):
        cells: list[str] = []
        for with_telemetry in (True, False):
            found = [_accepted(kind, flights, with_telemetry, p) for p in ACCEPT_PROBABILITIES]
            cells.append(" / ".join(f"{len(s)} ({np.median(s):.1f})" if s else "0" for s in found))
        print(f"{kind}: {' | '.join(cells)}", flush=True)  # noqa: T201


def _accepted(kind: str, flights: int, with_telemetry: bool, accept_probability: float) -> list[float]:
    """Times of acceptance."""
    times: list[float] = []
    for flight in range(flights):
        things, path = _sky(np.random.default_rng([flight, (*OF_A_DRONE, *OTHERS).index(kind)]), kind)
        publish = telemetry_of(path if kind in OF_A_DRONE else _elsewhere) if with_telemetry else None
        times.append(accepted_after_s(run(things, SECONDS, publish=publish, accept_probability=accept_probability)[1]))
    return [s for s in times if math.isfinite(s)]


def _elsewhere(t_s: np.ndarray) -> np.ndarray:
    return np.array([6.0, -9.0, 12.0]) + np.outer(np.sin(0.8 * np.asarray(t_s)), [1.5, 1.0, 0.5])


def _sky(rng: Generator, kind: str) -> Sky:
    """The object, and its path (n, 3) [m]."""
    range_m, elevation = rng.uniform(8.0, 30.0), rng.uniform(math.radians(25.0), math.radians(70.0))
    place_m = np.array([0.0, range_m * math.cos(elevation), range_m * math.sin(elevation)])
    span_m, seed = (0.35, 0.8) if kind in OF_A_DRONE else (0.25, 0.6), int(rng.integers(1_000_000))
    paths: dict[str, Callable[[], Trajectory]] = {
        "hovers": lambda: still(*place_m),
        "slow": lambda: _straight(rng, place_m, rng.uniform(0.5, 2.0), rng.normal(0.0, 0.3)),
        "climbs": lambda: _straight(rng, place_m, rng.uniform(0.0, 0.3), rng.choice([-1, 1]) * rng.uniform(0.6, 1.5)),
        "fast": lambda: _straight(rng, place_m, rng.uniform(3.0, 6.0), rng.normal(0.0, 0.3)),
        "wanders": lambda: _wandering(rng, place_m),
        "bird": lambda: _straight(rng, place_m, rng.uniform(3.0, 8.0), rng.normal(0.0, 0.3)),
        "circling bird": lambda: _circling(rng, place_m),
    }
    if kind in paths:
        path = paths[kind]()
        return [Drone(path, rng.uniform(*span_m), seed)], path
    if kind == "balloon":
        path = _straight(rng, place_m, rng.uniform(0.0, 1.5), rng.uniform(0.0, 0.8))
        return [Ball(path, rng.uniform(0.14, 0.3))], path
    return _static(rng, kind, place_m), still(*place_m)


def _static(rng: Generator, kind: str, place_m: np.ndarray) -> list[Thing]:
    x, y, z = place_m.tolist()
    if kind == "lamp":
        arm_x = x + rng.choice([-1, 1]) * 1.2
        arm = Wire((x, y, z), (arm_x, y, z + 0.05), 0.04)
        return [Ball(still(x, y, z), rng.uniform(0.08, 0.2)), arm, Wire((arm_x, y, z), (arm_x, y, -1.5), 0.07)]
    if kind == "wire":
        return [Wire((-15.0, y, z), (15.0, y, z + rng.normal(0.0, 0.5)), rng.uniform(0.006, 0.015))]
    return [Ball(still(*(place_m + rng.normal(0.0, 0.5, 3))), rng.uniform(0.05, 0.15)) for _ in range(6)]


def _straight(rng: Generator, place_m: np.ndarray, level_mps: float, up_mps: float) -> Trajectory:
    """Mostly along the swing of the beam."""
    azimuth = rng.uniform(0.0, math.tau)
    velocity = np.array([level_mps * math.cos(azimuth), 0.3 * level_mps * math.sin(azimuth), up_mps])
    return flying(place_m - 0.5 * SECONDS * velocity, velocity)


def _wandering(rng: Generator, place_m: np.ndarray) -> Trajectory:
    amplitude_m, radps = rng.uniform(0.3, 2.0, 3) * [1.0, 0.4, 0.5], rng.uniform(0.6, 1.6, 3)
    phase = rng.uniform(0.0, math.tau, 3)
    return lambda t_s: place_m + amplitude_m * np.sin(np.outer(t_s, radps) + phase)


def _circling(rng: Generator, place_m: np.ndarray) -> Trajectory:
    radius_m, speed_mps, azimuth = rng.uniform(4.0, 9.0), rng.uniform(4.0, 8.0), rng.uniform(0.0, math.tau)
    centre_m = place_m + radius_m * np.array([math.cos(azimuth), 0.2 * math.sin(azimuth), 0.0])

    def path(t_s: np.ndarray) -> np.ndarray:
        angle = speed_mps / radius_m * (np.asarray(t_s) - 0.5 * SECONDS)
        return centre_m + radius_m * np.stack([-np.cos(angle), 0.3 * np.sin(angle), np.zeros(len(angle))], axis=1)

    return path


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)
