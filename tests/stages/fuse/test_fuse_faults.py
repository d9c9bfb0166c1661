"""Every input of the fusion missing, late or false, over simulated flights, as a table of results.

    pytest -m slow tests/stages/fuse/test_fuse_faults.py -s

The flights are made first, in closed loop; without images, so rotations are made from the truth, of any branch. GRD_FLIGHTS='some/*.mcap' takes recordings with images instead, replayed through configs/vision.yaml.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from links.runs.request import RunRequest
from links.runs.truth import TruthLog
from links.simulated.matrix.flights import Cell
from links.simulated.matrix.matrix import Conditions, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop
from links.simulated.rig.run import Simulation
from stages.messages import PoseState
from tests.stages.fuse.flown import InputTap, RecordedFlight, Row, flown, judge, recorded_inputs, with_rotations
from tests.stages.fuse.fuse_inputs import Fault, late, outliers, without

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
CELLS = (
    Cell("manhattan", 20, "fast", "driving"),
    Cell("campus", 30, "climb", "driving"),
    Cell("manhattan", 10, "climb", "turning"),
)
AT_S, FOR_S = 7.0, 3.0
INPUTS = {
    "LiDAR fixes": ("fix",),
    "relative rotation": ("rotation",),
    "drone motion (IMU)": ("drone_motion",),
    "vehicle odometry": ("motion",),
}
FAULTS: dict[str, Callable[[tuple[str, ...]], Fault]] = {
    "gone for 3 s": lambda ports: without(ports, AT_S, AT_S + FOR_S),
    "gone": without,
    "300 ms late": lambda ports: late(ports, 0.3),
    "20 % false": lambda ports: outliers(ports, 0.2),
}
UNDETECTED = ("drone motion (IMU)", "20 % false")  # gross errors of single IMU intervals: in the table only
WITH_ROTATION = (PoseState.FULL, PoseState.COASTING)


def made(cell: Cell, seed: int = 1) -> RecordedFlight:
    """A flight of the matrix, simulated for this test."""
    scenario = scenario_of(cell, seed, Conditions(calibrated=True, odometry=True, autopilot=True))
    graph = RunRequest(CONFIGS / "estimate.yaml", sets=("viewer.file=null",)).graph(scenario.rig_yaml(), cell.name)
    tap, truth = InputTap(graph, "fuse"), TruthLog()
    truth.add_all(Simulation(scenario, loop=ClosedLoop(graph, scenario.closed_loop, {}, (tap,))).records())
    return with_rotations(flown(cell.name, tap, truth))


def flights() -> list[RecordedFlight]:
    recordings = sorted(glob.glob(os.environ.get("GRD_FLIGHTS", "")))
    return [recorded_inputs(Path(r), CONFIGS / "vision.yaml") for r in recordings] or [made(cell) for cell in CELLS]


def rows(flights: list[RecordedFlight]) -> Iterator[tuple[str, str, Row]]:
    """Each input with each fault, all flights together."""
    faults = [("nothing", "wrong", None)]
    faults += [(name, what, fault(ports)) for name, ports in INPUTS.items() for what, fault in FAULTS.items()]
    for name, what, fault in faults:
        row = Row()
        for flight in flights:
            judge(flight, flight.fuse(fault=fault), row)
        yield name, what, row


def line(row: Row) -> str:
    """A row of the table: of all positions, and of those with a rotation."""
    total = sum(row.states.values())
    shares = " ".join(f"{100 * row.states[state] / total:3.0f}" for state in reversed(PoseState))
    error_m = np.array(row.error_m)
    turned = np.array([state in WITH_ROTATION for state in row.state_of], dtype=bool)
    parts = []
    for e in (error_m, error_m[turned]):
        parts.append(f"{np.sqrt((e**2).mean()):6.3f} {e.max():5.2f}" if len(e) else f"{'-':>6s} {'-':>5s}")
    angle = f"{np.sqrt(np.mean(np.square(row.angle_deg))):5.2f}" if row.angle_deg else f"{'-':>5s}"
    inside = f"{row.inside():4.0f}" if row.nees3 else f"{'-':>4s}"
    return f"{1000 * row.longest_gap_s:4.0f} | {shares} | {parts[0]} | {parts[1]} {angle} | {inside} | {row.wrong_quarter_full}"


@pytest.mark.slow
def test_no_fault_of_an_input_causes_a_gap_or_a_wrong_branch() -> None:
    flown_ = flights()
    print(f"\n{len(flown_)} flights: {', '.join(f.name for f in flown_)}")  # noqa: T201
    print(  # noqa: T201
        f"{'input':25s} {'fault':12s} | gap  | COAST FULL AMB. POS. LOST % | all: RMSE, max [m] | with rotation: RMSE, "
        "max [m], RMS [deg] | in 95 % | wrong quarter"
    )
    found = {}
    for name, what, row in rows(flown_):
        print(f"{name:25s} {what:12s} | {line(row)}")  # noqa: T201
        found[name, what] = row
    whole = found["nothing", "wrong"]
    assert whole.states[PoseState.FULL] > 0.4 * sum(whole.states.values())
    for fault, row in found.items():
        if fault == UNDETECTED:
            continue
        assert row.wrong_quarter_full == 0, fault
        assert row.longest_gap_s < 0.2, fault
        assert not row.nees3 or row.inside() > 85, fault
    for what in FAULTS:  # other inputs than the LiDAR cost no positions
        for name in list(INPUTS)[1:]:
            if (name, what) == UNDETECTED:
                continue
            lost = found[name, what].states[PoseState.LOST]
            assert lost <= 1.3 * whole.states[PoseState.LOST] + 50, (name, what)
